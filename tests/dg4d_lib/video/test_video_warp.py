import math

import numpy as np
import pytest
import torch

from dg4d_lib.errors import BadInput
from dg4d_lib.input_settings import WarpSettings
from dg4d_lib.video.arap import ArapMesh
from dg4d_lib.video.limbs import waving_limbs
from dg4d_lib.video.puppet import Puppet
from dg4d_lib.video.puppet_motions import bounce, breathe, lean, squash
from dg4d_lib.video.warp import Warp

SIZE = 96
Y, X = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")
MOTIONS = ("sway", "bend", "breathe", "bounce", "wave", "turn")


def picture(alpha: torch.Tensor) -> torch.Tensor:
    colors = torch.stack([0.5 + 0.4 * torch.sin(X / 5), Y / SIZE, 0.5 + 0.4 * torch.cos(Y / 4)], -1)
    return torch.cat([colors, alpha.clamp(0, 1)[..., None]], -1)


def capsule(x0: float, y0: float, x1: float, y1: float, radius: float) -> torch.Tensor:
    dx, dy = x1 - x0, y1 - y0
    along = (((X - x0) * dx + (Y - y0) * dy) / (dx * dx + dy * dy)).clamp(0, 1)
    return radius + 0.5 - ((X - x0 - along * dx) ** 2 + (Y - y0 - along * dy) ** 2).sqrt()


FIGURE = picture(
    torch.stack(
        [
            capsule(48, 42, 48, 62, 11),
            capsule(48, 28, 48, 30, 8),
            capsule(42, 60, 42, 80, 4),
            capsule(54, 60, 54, 80, 4),
            capsule(40, 42, 20, 34, 3.5),
            capsule(56, 42, 76, 34, 3.5),
        ]
    ).amax(0)
)
BLOB = picture(18 - ((X - 48) ** 2 + (Y - 55) ** 2).sqrt())
BUST = picture(torch.maximum(14 - ((X - 48) ** 2 + (Y - 40) ** 2).sqrt(), capsule(48, 80, 48, 140, 24)))


def video(subject: torch.Tensor, motion: str, strength: float = 1.0, frames: int = 8):
    warp = Warp(WarpSettings(motion=motion, frames=frames, strength=strength))
    return warp.generate(subject, torch.Generator()), warp.notes


def mean_place(alpha: torch.Tensor) -> tuple[float, float]:
    total = alpha.sum()
    return ((alpha[..., 0] * X).sum() / total).item(), ((alpha[..., 0] * Y).sum() / total).item()


@pytest.mark.parametrize("motion", MOTIONS)
def test_every_motion_is_a_video_that_moves(motion):
    moving, notes = video(FIGURE, motion)
    assert notes == ()
    assert moving.frames.shape == (8, SIZE, SIZE, 3)
    assert moving.fps == 7
    for values in (moving.frames, moving.alpha):
        assert values.isfinite().all() and values.min() >= 0 and values.max() <= 1
    assert (moving.alpha[3] - moving.alpha[0]).abs().mean() > 0.002


@pytest.mark.parametrize("motion", MOTIONS)
def test_the_shortest_video_moves(motion):
    fewest = WarpSettings.model_json_schema()["properties"]["frames"]["minimum"]
    moving, notes = video(FIGURE, motion, frames=fewest)
    assert notes == ()
    assert (moving.frames[1] - moving.frames[0]).abs().max() > 0.1


@pytest.mark.parametrize("motion", [m for m in MOTIONS if m != "turn"])
@pytest.mark.parametrize("subject", [FIGURE, BUST])
def test_the_first_frame_is_the_picture(motion, subject):
    moving, _ = video(subject, motion, frames=3)
    white = torch.ones(3)
    expected = subject[..., :3] * subject[..., 3:] + 1 - subject[..., 3:]
    torch.testing.assert_close(moving.over(white)[0], expected, atol=0.012, rtol=0)


def test_the_first_frame_of_a_turn_has_the_pictures_outline():
    moving, _ = video(FIGURE, "turn", frames=3)
    assert (moving.alpha[0] - FIGURE[..., 3:]).abs().mean() < 0.01


@pytest.mark.parametrize("motion", MOTIONS)
def test_the_area_changes_little(motion):
    moving, _ = video(FIGURE, motion)
    area = moving.alpha.sum((1, 2, 3)) / FIGURE[..., 3].sum()
    assert area.min() > (0.85 if motion == "turn" else 0.93)
    assert area.max() < 1.07


@pytest.mark.parametrize("motion", ["sway", "bend", "breathe", "wave", "turn"])
def test_the_second_half_of_the_loop_goes_to_the_other_side(motion):
    moving, _ = video(FIGURE, motion, frames=8)
    still = moving.alpha[0]
    torch.testing.assert_close(moving.alpha[4], still, atol=0.02, rtol=0)
    assert (moving.alpha[2] - moving.alpha[6]).abs().mean() > 0.002


@pytest.mark.parametrize("move", [lambda *a: lean(*a, 9.0), lambda *a: breathe(*a, 1.0), lambda *a: bounce(*a, 1.0)])
def test_the_loop_closes(move):
    puppet = Puppet(FIGURE.double().numpy())
    np.testing.assert_allclose(move(puppet.nodes, puppet.bounds, 0.0), puppet.nodes, atol=1e-9)
    np.testing.assert_allclose(move(puppet.nodes, puppet.bounds, 1 - 1e-6), puppet.nodes, atol=1e-3)


@pytest.mark.parametrize("motion", ["sway", "bend"])
def test_the_feet_stay_where_they_are(motion):
    moving, _ = video(FIGURE, motion)
    feet = moving.alpha[:, 80:]
    assert (feet - feet[:1]).abs().mean() < 0.02
    tops = [X[frame[..., 0] > 0.5][:40].mean().item() for frame in moving.alpha]  # the highest pixels
    assert max(tops) - min(tops) > 5


def test_leaning_keeps_the_length_of_the_spine_and_turns_the_top():
    puppet = Puppet(FIGURE.double().numpy())
    bounds = puppet.bounds
    spine = np.stack([np.full(200, bounds.foot), np.linspace(bounds.bottom, bounds.top, 200)], -1)
    bent = lean(spine, bounds, 0.25, 30.0)
    steps = np.linalg.norm(np.diff(bent, axis=0), axis=1)
    assert steps.sum() == pytest.approx(bounds.height, rel=1e-4)
    last = bent[-1] - bent[-2]
    assert math.degrees(math.atan2(last[0], -last[1])) == pytest.approx(30, abs=0.2)


def test_squashing_keeps_the_feet_and_changes_the_height():
    bounds = Puppet(FIGURE.double().numpy()).bounds
    corners = np.array([[bounds.foot, bounds.bottom], [bounds.foot, bounds.top]])
    taller = squash(corners, bounds, 0.1)
    np.testing.assert_allclose(taller[0], corners[0])
    assert taller[0, 1] - taller[1, 1] == pytest.approx(1.1 * bounds.height)


def test_a_bounce_leaves_the_ground_and_stays_in_the_picture():
    moving, notes = video(BLOB, "bounce", frames=16)
    assert notes == ()
    assert mean_place(BLOB[..., 3:])[1] - min(mean_place(frame)[1] for frame in moving.alpha) > 4
    assert (moving.alpha[:, 0] == 0).all()


def test_without_room_above_the_jump_is_small_and_the_user_is_told():
    tall = picture(capsule(48, 22, 48, 70, 20))
    moving, notes = video(tall, "bounce", frames=16)
    assert "room" in notes[0]
    area = moving.alpha.sum((1, 2, 3)) / tall[..., 3].sum()
    assert area.min() > 0.9


def test_waving_moves_the_arms_and_not_the_body():
    moving, notes = video(FIGURE, "wave")
    assert notes == ()
    change = (moving.alpha[2] - moving.alpha[6]).abs()[..., 0]
    arms = (X < 34) | (X > 62)
    assert change[arms].sum() > 8 * change[~arms].sum()


def test_arms_are_found_and_legs_do_not_wave():
    limbs = waving_limbs(Puppet(FIGURE.double().numpy()))
    tips = sorted(limb.tip[0] for limb in limbs)
    assert len(tips) == 2 and tips[0] < 25 and tips[1] > 70
    assert all(limb.tip[1] < 45 for limb in limbs)


def test_what_has_no_limbs_bends_instead_of_waving_and_the_user_is_told():
    waved, notes = video(BLOB, "wave")
    assert "bends" in notes[0]
    assert torch.equal(waved.alpha, video(BLOB, "bend")[0].alpha)


@pytest.mark.parametrize("motion", ["bend", "bounce", "wave"])
def test_a_cropped_bust_sways_instead_and_the_user_is_told(motion):
    moving, notes = video(BUST, motion)
    assert "sways" in notes[0]
    assert torch.equal(moving.alpha, video(BUST, "sway")[0].alpha)


@pytest.mark.parametrize("motion", ["sway", "breathe"])
def test_a_cropped_bust_stays_on_the_border(motion):
    moving, notes = video(BUST, motion)
    assert notes == ()
    torch.testing.assert_close(moving.alpha[:, -1, 30:66], torch.ones(8, 36, 1), atol=0.01, rtol=0)


@pytest.mark.parametrize("motion", MOTIONS)
def test_strength_scales_the_motion(motion):
    weak, strong = (video(FIGURE, motion, strength=s)[0].alpha for s in (0.4, 1.0))
    assert (strong[3] - strong[0]).abs().mean() > 1.4 * (weak[3] - weak[0]).abs().mean() > 0


@pytest.mark.parametrize("subject", ["thin", "two parts", "translucent", "huge"])
@pytest.mark.parametrize("motion", MOTIONS)
def test_odd_subjects_move_too(motion, subject):
    odd = {
        "thin": picture((X - 48).abs() < 1),
        "two parts": picture(torch.maximum(12 - (X - 25).abs() - (Y - 30).abs(), capsule(60, 60, 80, 80, 5))),
        "translucent": torch.cat([FIGURE[..., :3], 0.3 * FIGURE[..., 3:]], -1),
        "huge": picture(torch.ones(SIZE, SIZE)),
    }[subject]
    moving, _ = video(odd, motion, strength=3.0, frames=4)
    assert moving.frames.isfinite().all()
    assert (moving.alpha.sum((1, 2, 3)) > 0.3 * odd[..., 3].sum()).all()


def test_an_empty_picture_is_refused():
    with pytest.raises(BadInput, match="no subject"):
        video(torch.zeros(SIZE, SIZE, 4), "sway")


def test_the_same_request_gives_the_same_bytes():
    first, second = (video(FIGURE, "wave", frames=3)[0] for _ in range(2))
    assert torch.equal(first.frames, second.frames) and torch.equal(first.alpha, second.alpha)


def test_a_rigid_sheet_follows_a_rotation_exactly():
    y, x = np.mgrid[:6, :6]
    nodes = np.stack([x.ravel(), y.ravel()], -1).astype(float)
    index = np.arange(36).reshape(6, 6)
    edges = np.concatenate(
        [
            np.stack([index[:, :-1].ravel(), index[:, 1:].ravel()], -1),
            np.stack([index[:-1].ravel(), index[1:].ravel()], -1),
        ]
    )
    handles = np.flatnonzero(nodes[:, 0] < 2)
    c, s = math.cos(0.5), math.sin(0.5)
    turned = nodes @ np.array([[c, s], [-s, c]])
    sheet = ArapMesh(nodes, edges, handles)
    start = np.abs(nodes - turned).max()
    assert np.abs(sheet.pose(turned[handles]) - turned).max() < 0.1 * start
    np.testing.assert_allclose(sheet.pose(nodes[handles]), nodes, atol=1e-9)
