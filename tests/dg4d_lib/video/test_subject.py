import numpy as np
import pytest
import torch
from scipy import ndimage
from skimage import data
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.input_settings import SubjectSettings
from dg4d_lib.video.framing import bounding_box
from dg4d_lib.video.subject import COARSE, Segmenter, prepare_subject


def cutout(size: int = 96, top: int = 20, left: int = 30, height: int = 50, width: int = 30) -> torch.Tensor:
    frame = torch.zeros(1, size, size, 4)
    random = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(0))
    frame[0, top : top + height, left : left + width, :3] = random
    frame[0, top : top + height, left : left + width, 3] = 1
    return frame


def test_auto_keeps_a_square_cutout_bit_for_bit():
    frame = cutout()
    prepared = prepare_subject(frame, True, SubjectSettings(size=96))
    result = prepared.frames
    assert prepared.notes == () and prepared.estimate is None
    visible = frame[..., 3] > 0
    assert torch.equal(result[..., 3], frame[..., 3]) and torch.equal(result[visible], frame[visible])


def test_center_puts_the_same_cutout_into_the_middle():
    result = prepare_subject(cutout(), True, SubjectSettings(size=96, framing="center", border=0.2)).frames
    left, top, right, bottom = bounding_box(result[..., 3])
    assert bottom - top == pytest.approx(0.8 * 96, abs=2)
    assert abs(left - (96 - right)) <= 2 and abs(top - (96 - bottom)) <= 2


def test_auto_centers_what_touches_the_edge():
    result = prepare_subject(cutout(top=0), True, SubjectSettings(size=96)).frames
    left, top, right, bottom = bounding_box(result[..., 3])
    assert min(left, top, 96 - right, 96 - bottom) >= 8


def test_keep_pads_to_a_square_only():
    frame = cutout()[:, :80]
    result = prepare_subject(frame, True, SubjectSettings(size=96, framing="keep")).frames
    assert bounding_box(result[..., 3]) == (30, 28, 60, 78)


def test_all_frames_share_one_crop():
    frames = torch.cat([cutout(left=2 + 8 * i) for i in range(5)])
    result = prepare_subject(frames, True, SubjectSettings(size=96, framing="center")).frames
    lefts = [bounding_box(frame[None, ..., 3])[0] for frame in result]
    steps = torch.tensor(lefts).diff()
    assert (steps > 0).all() and steps.max() - steps.min() <= 2


def test_opaque_pictures_are_cut_out_and_centered():
    frame = cutout()
    opaque = torch.cat([frame[..., :3] * frame[..., 3:] + 1 - frame[..., 3:], torch.ones_like(frame[..., 3:])], -1)
    opaque[0, 20:70, 30:60, :3] *= 0.5
    prepared = prepare_subject(opaque, False, SubjectSettings(size=96))
    result, notes = prepared.frames, prepared.notes
    assert any("background was removed" in note for note in notes)
    left, top, right, bottom = bounding_box(result[..., 3])
    assert bottom - top == pytest.approx(0.8 * 96, abs=3)
    assert abs(left - (96 - right)) <= 3 and abs(top - (96 - bottom)) <= 3


def test_a_fully_transparent_picture_is_refused():
    with pytest.raises(BadInput, match="fully transparent"):
        prepare_subject(torch.zeros(1, 64, 64, 4), True, SubjectSettings())


@pytest.mark.parametrize(
    ("empty", "named"),
    [
        ([1], "frame 1 of 12 shows no subject; trim the video"),
        ([3, 4], "frames 3 and 4 of 12 show no subject"),
        (range(2, 12), "frames 2, 3, 4, 5, 6, 7, 8, 9 and 2 more of 12 show no subject"),
    ],
)
def test_frames_without_a_subject_are_refused(empty, named):
    frames = torch.cat([torch.zeros(1, 96, 96, 4) if number in empty else cutout() for number in range(1, 13)])
    with pytest.raises(BadInput, match=named):
        prepare_subject(frames, True, SubjectSettings())


def test_a_subject_of_a_few_pixels_is_refused():
    with pytest.raises(BadInput, match="10 x 8 pixels"):
        prepare_subject(cutout(height=8, width=10), True, SubjectSettings())


def test_a_filled_frame_says_that_it_has_no_outline():
    full = torch.ones(1, 64, 64, 4)
    full[..., 3] = 0.9
    notes = prepare_subject(full, True, SubjectSettings(size=64, framing="keep")).notes
    assert any("no outline" in note for note in notes)


def small_disc(side: int, radius: int, column: int, blur: float = 0.0) -> Tensor:
    """Opaque picture of a disc with a pattern of 3 x 3 pixels before white, "1 side side 4"."""
    rows, columns = np.mgrid[:side, :side]
    dark = ((columns // 3 + rows // 3) % 2)[..., None]
    pattern = np.where(dark, (0.1, 0.1, 0.5), (0.9, 0.1, 0.1))
    inside = np.hypot(rows - side // 2, columns - column) < radius
    picture = ndimage.gaussian_filter(np.where(inside[..., None], pattern, 1.0), (blur, blur, 0))
    return torch.from_numpy(np.dstack([picture, np.ones((side, side))])[None]).float()


def contrast(cutout: Tensor) -> float:
    inside = (cutout[:, 1:, 3] > 0.99) & (cutout[:, :-1, 3] > 0.99)
    return float(cutout[..., :3].diff(dim=1).abs().mean(-1)[inside].mean())


@pytest.mark.parametrize("box", [(), (20, 20, 470, 470)])
def test_a_small_subject_keeps_the_resolution_of_its_picture(box):
    opaque = small_disc(512, 28, 300)
    known = opaque.clone()
    known[..., 3] = (opaque[..., :3] < 0.95).any(-1).float()
    settings = SubjectSettings(size=64, matting="backdrop", framing="center", box=box)
    prepared = prepare_subject(opaque, False, settings)
    true = prepare_subject(known, True, settings.model_copy(update={"matting": "none"}))
    assert prepared.crop.side >= 64 and prepared.frame == true.frame == (512, 512)
    assert abs(prepared.crop.left - true.crop.left) <= 2 and abs(prepared.crop.top - true.crop.top) <= 2
    assert contrast(prepared.frames[0]) > 0.9 * contrast(true.frames[0])
    assert COARSE not in prepared.notes
    longest = 512 if box else 128
    estimate = prepared.estimate.frames[0, ..., 3]
    assert estimate.shape == (longest, longest)
    assert float(estimate.mean()) == pytest.approx(float(known[..., 3].mean()), rel=0.1)


def test_the_crop_of_a_small_subject_that_moves_holds_it_in_all_frames():
    frames = torch.cat([small_disc(512, 24, column) for column in (180, 200, 230)])
    prepared = prepare_subject(frames, False, SubjectSettings(size=128, matting="backdrop"))
    crop = prepared.crop
    assert crop.side >= 120 and prepared.frame == (512, 512)
    assert crop.left < 156 and crop.left + crop.side > 254
    shown = (prepared.frames[..., 3] > 0.5).float().mean((1, 2)) * crop.side**2
    assert shown.numpy() == pytest.approx(np.pi * 24**2, rel=0.1)


def test_a_small_cup_in_a_photograph_keeps_the_resolution():
    photo = np.pad(data.coffee()[::4, ::4], ((100, 100), (100, 100), (0, 0)), "edge")
    opaque = torch.from_numpy(np.dstack([photo, np.full(photo.shape[:2], 255, np.uint8)])[None]).float() / 255
    prepared = prepare_subject(opaque, False, SubjectSettings(size=64))
    assert prepared.frame == photo.shape[:2] and prepared.crop.side >= 100
    assert prepared.estimate.method == "network" and COARSE not in prepared.notes
    left, _, right, _ = bounding_box(prepared.frames[..., 3])
    assert right - left == pytest.approx(0.8 * 64, abs=3)


class Forgetful:
    """Network that finds what is dark in the three pictures of its first estimate, and nothing afterwards."""

    def __init__(self) -> None:
        self.calls = 0

    def probability(self, picture: Tensor) -> Tensor:
        self.calls += 1
        found = (picture.mean(-1) < 0.9).float()
        return found if self.calls <= 3 else torch.zeros_like(found)


def test_a_subject_that_is_not_found_again_from_close_is_kept_with_a_note():
    """Its outline is blurred, so that its colors do not give it away either."""
    network = Forgetful()
    settings = SubjectSettings(size=64, matting="u2netp")
    prepared = prepare_subject(
        small_disc(512, 32, 300, 14), False, settings, segmenter=Segmenter("dark", lambda: network)
    )
    assert network.calls > 3 and COARSE in prepared.notes
    assert prepared.frame == (128, 128)
