import pytest
import torch

from dg4d_lib.errors import BadInput
from dg4d_lib.video.framing import (
    Crop,
    bounding_box,
    crop_around_subject,
    crop_whole_frame,
    downscale,
    extend_color,
    is_well_framed,
    reframe,
    resample,
)


def box(height: int, width: int, top: int, left: int, bottom: int, right: int) -> torch.Tensor:
    """A red opaque box before transparent green."""
    frame = torch.zeros(1, height, width, 4)
    frame[..., 1] = 1
    frame[:, top:bottom, left:right] = torch.tensor([1.0, 0, 0, 1])
    return frame


def test_the_extent_is_that_of_all_frames_together():
    alpha = torch.cat([box(40, 50, 5, 6, 10, 12), box(40, 50, 8, 20, 30, 26)])[..., 3]
    assert bounding_box(alpha) == (6, 5, 26, 30)


def test_an_invisible_subject_is_refused():
    with pytest.raises(BadInput, match="fully transparent"):
        bounding_box(torch.full((1, 8, 8), 0.04))


@pytest.mark.parametrize("border", [0.0, 0.2, 0.5])
def test_a_centered_subject_leaves_the_border_free(border):
    frame = box(60, 200, 10, 120, 30, 160)
    out = reframe(frame, crop_around_subject(frame[..., 3], border), 50)
    left, top, right, bottom = bounding_box(out[..., 3])
    assert right - left == pytest.approx(50 * (1 - border), abs=2)
    assert bottom - top == pytest.approx(25 * (1 - border), abs=2)
    assert left == pytest.approx(50 - right, abs=1) and top == pytest.approx(50 - bottom, abs=1)


def test_a_crop_may_reach_beyond_the_picture():
    frame = box(20, 20, 0, 0, 20, 20)
    out = reframe(frame, Crop(-10, -10, 40), 40)
    assert bounding_box(out[..., 3]) == (10, 10, 30, 30)


def test_the_whole_frame_is_padded_to_a_square_around_its_middle():
    out = reframe(box(20, 40, 0, 0, 20, 40), crop_whole_frame(20, 40), 40)
    assert bounding_box(out[..., 3]) == (0, 10, 40, 30)


def test_a_crop_of_the_whole_square_changes_nothing():
    frame = torch.rand(2, 32, 32, 4, generator=torch.Generator().manual_seed(0)).clamp(0.1, 1)
    assert torch.equal(reframe(frame, crop_whole_frame(32, 32), 32), frame)


@pytest.mark.parametrize(
    ("frame", "well"),
    [
        (box(64, 64, 10, 10, 50, 50), True),
        (box(64, 64, 0, 10, 50, 50), False),  # touches the edge
        (box(64, 64, 10, 10, 50, 64), False),
        (box(64, 64, 20, 20, 30, 30), False),  # tiny
        (box(64, 80, 10, 10, 50, 50), False),  # no square
    ],
)
def test_a_frame_is_kept_when_its_subject_lies_well(frame, well):
    assert is_well_framed(frame[..., 3]) is well


def test_hidden_colors_do_not_bleed_when_a_picture_shrinks():
    small = resample(box(64, 64, 17, 17, 43, 43), 16, 16)
    partly = (small[..., 3] > 0.01) & (small[..., 3] < 0.99)
    assert partly.any()
    torch.testing.assert_close(small[partly][:, :3], torch.tensor([1.0, 0, 0]).expand(int(partly.sum()), 3))


def test_shrinking_keeps_the_area_of_alpha():
    frame = box(96, 96, 20, 30, 50, 70)
    assert resample(frame, 24, 24)[..., 3].sum() * 16 == pytest.approx(float(frame[..., 3].sum()), rel=0.02)


def test_shrinking_keeps_small_frames_and_proportions():
    assert downscale(torch.zeros(1, 30, 40, 4), 40).shape == (1, 30, 40, 4)
    assert downscale(torch.zeros(1, 300, 400, 4), 40).shape == (1, 30, 40, 4)


def test_hidden_pixels_take_the_nearest_opaque_color():
    cutout = extend_color(box(32, 32, 10, 10, 20, 20)[0])
    assert torch.equal(cutout[..., :3], torch.tensor([1.0, 0, 0]).expand(32, 32, 3))
    assert torch.equal(cutout[..., 3], box(32, 32, 10, 10, 20, 20)[0, ..., 3])


def test_a_translucent_subject_keeps_its_alpha_and_color():
    frame = box(32, 32, 10, 10, 20, 20)[0]
    frame[..., 3] *= 0.4
    cutout = extend_color(frame)
    assert torch.equal(cutout[..., 3], frame[..., 3]) and torch.equal(cutout[0, 0, :3], torch.tensor([1.0, 0, 0]))
