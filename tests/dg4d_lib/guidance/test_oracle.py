import pytest
import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.guidance.oracle import Bank, perturb
from dg4d_lib.settings import OraclePriorSettings

CAMERAS = (OrbitCamera(0, 0, width=4, height=4), OrbitCamera(20, 337.5, width=4, height=4))


def bank() -> Bank:
    pictures = torch.zeros(2, 2, 4, 4, 4, dtype=torch.uint8)
    pictures[..., 3] = 255
    for row in range(2):
        for column in range(2):
            pictures[row, column, ..., 0] = 100 * row + 50 * column
    return Bank(CAMERAS, (0, 2), pictures)


def test_it_finds_the_pose_and_the_frame():
    views = [GuidanceView(CAMERAS[1], 2), GuidanceView(OrbitCamera(20, -22.5, width=4, height=4), 0)]
    color, coverage = bank().clean(views)
    assert (color[:, 0, 0, 0] * 255).round().tolist() == [150, 100]
    rounded = GuidanceView(OrbitCamera(0, -1e-14, width=4, height=4), 2)  # a turntable closes with such an azimuth
    assert (bank().clean([rounded])[0] * 255).round()[0, 0, 0, 0] == 50
    assert (coverage == 1).all()


def test_transparent_pixels_are_white():
    empty = Bank(CAMERAS[:1], (0,), torch.zeros(1, 1, 4, 4, 4, dtype=torch.uint8))
    assert (empty.clean([GuidanceView(CAMERAS[0])])[0] == 1).all()


def test_pictures_come_at_the_size_of_the_camera():
    color, _ = bank().clean([GuidanceView(OrbitCamera(0, 0, width=8, height=8))])
    assert color.shape == (1, 8, 8, 3)


@pytest.mark.parametrize("view", [GuidanceView(OrbitCamera(1, 0)), GuidanceView(CAMERAS[0], 1)])
def test_a_view_it_does_not_have_is_refused(view: GuidanceView):
    with pytest.raises(BadInput, match="the bank has no view"):
        bank().clean([view])


def spotted() -> Bank:
    """One red pixel on nothing, 33 by 33."""
    pictures = torch.zeros(2, 3, 33, 33, 4, dtype=torch.uint8)
    pictures[:, :, 16, 16] = torch.tensor([200, 40, 0, 255])
    return Bank(tuple(OrbitCamera(0, 90 * i, width=33, height=33) for i in range(2)), (0, 1, 2), pictures)


def spoiled(**flaws: float) -> Bank:
    return perturb(spotted(), OraclePriorSettings(**flaws), torch.Generator().manual_seed(0))


def test_an_oracle_without_flaws_tells_the_truth():
    same = spoiled()
    assert torch.equal(same.pictures, spotted().pictures) and same.cameras == spotted().cameras


def test_a_blurred_point_is_a_gaussian_of_that_width_and_keeps_its_color():
    picture = spoiled(blur=2.0).pictures[0, 0].double()
    alpha = picture[..., 3] / picture[..., 3].sum()
    variance = (alpha.sum(0) * (torch.arange(33) - 16).square()).sum()
    assert variance.sqrt() == pytest.approx(2.0, rel=0.15)  # what rounds to zero is missing at the ends
    color = picture[picture[..., 3] > 3][:, :3]
    assert (color - torch.tensor([200.0, 40.0, 0.0])).abs().max() <= 1


def test_gains_differ_between_views_and_frames_and_spare_the_outline():
    found = spoiled(color_gain=0.1).pictures[:, :, 16, 16]
    assert len(found[..., 0].unique()) == 6
    assert (found[..., 0].float() / 200).log().abs().mean() == pytest.approx(0.08, abs=0.05)  # sigma sqrt(2 / pi)
    assert torch.equal(spoiled(color_gain=0.1).pictures[..., 3], spotted().pictures[..., 3])


def test_brighter_than_white_is_white_under_any_gain():
    """Of 250 and 5: gains of at least 1.02 make 255 of the first, others keep the order of the two."""
    pictures = torch.full((2, 3, 2, 2, 4), 255, dtype=torch.uint8)
    pictures[..., :3] = torch.tensor([[250], [5]], dtype=torch.uint8)
    tinted = perturb(Bank(CAMERAS, (0, 1, 2), pictures), OraclePriorSettings(color_gain=0.5), torch.Generator())
    bright, dark = tinted.pictures[..., 0, :3], tinted.pictures[..., 1, :3]
    assert (bright == 255).any() and (bright > dark).all()


def test_shifts_differ_between_views_and_frames_and_keep_what_is_seen():
    alpha = spoiled(shift=2.0).pictures[..., 3].double()
    rows, columns = alpha.sum(-1), alpha.sum(-2)
    places = torch.stack([(sums * torch.arange(33)).sum(-1) / sums.sum(-1) for sums in (rows, columns)], -1) - 16
    assert len(places[..., 0].unique()) == 6
    assert 1 < places.std() < 3
    assert (alpha.sum((-1, -2)) - 255).abs().max() <= 2  # four pixels are rounded


def test_a_wrong_pose_moves_the_cameras_and_leaves_the_pictures():
    wrong = spoiled(pose_deg=3.0)
    assert torch.equal(wrong.pictures, spotted().pictures)
    for camera, true_camera in zip(wrong.cameras, spotted().cameras, strict=True):
        assert 0 < abs(camera.azimuth_deg - true_camera.azimuth_deg) < 12
        assert 0 < abs(camera.elevation_deg - true_camera.elevation_deg) < 12
    wrong.clean([GuidanceView(wrong.cameras[1], 2)])  # it knows its own views


def test_flaws_are_the_same_for_the_same_seed():
    flaws = {"blur": 1.0, "color_gain": 0.2, "pose_deg": 4.0, "shift": 1.0}
    first, second = spoiled(**flaws), spoiled(**flaws)
    assert torch.equal(first.pictures, second.pictures) and first.cameras == second.cameras
