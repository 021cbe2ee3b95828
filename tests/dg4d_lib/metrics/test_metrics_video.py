"""Videos with known flicker and motion; SciPy's filter as a twin."""

import pytest
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from dg4d_lib.metrics.video import _blurred, flicker, motion_amount, temporal_error

SIZE = 64


def dot(columns: list[int], height: float = 1.0) -> Tensor:
    """A square of four pixels that is at these columns, one per frame."""
    film = torch.zeros(len(columns), SIZE, SIZE, 3)
    for frame, column in enumerate(columns):
        film[frame, 30:34, column : column + 4] = height
    return film


WALK = dot([10, 20, 30, 40])
EVERYWHERE = torch.ones(4, SIZE, SIZE, 1)


def test_a_film_is_exactly_itself() -> None:
    assert flicker(WALK, WALK, EVERYWHERE) == 0
    assert temporal_error(WALK, WALK) == 0
    assert motion_amount(WALK, WALK) == 1


def test_a_still_film_has_no_motion_and_an_error_of_one() -> None:
    still = WALK[:1].expand_as(WALK)
    assert motion_amount(still, WALK) == 0
    assert temporal_error(still, WALK) == pytest.approx(1)


def test_half_as_much_change_is_half_the_motion_and_half_the_error() -> None:
    faint = dot([10, 20, 30, 40], 0.5)
    assert motion_amount(faint, WALK) == pytest.approx(0.5)
    assert temporal_error(faint, WALK) == pytest.approx(0.5)


def test_flicker_is_the_difference_of_changes_where_the_subject_is() -> None:
    """Every frame a level brighter than the one before, in a subject of one pixel that is seen in the first frame."""
    brighter = torch.arange(3.0)[:, None, None, None].expand(3, 8, 8, 3) / 255
    region = torch.zeros(3, 8, 8, 1)
    region[0, 2, 5] = 1
    assert flicker(brighter, torch.zeros_like(brighter), region) == pytest.approx(1)
    assert flicker(brighter, torch.zeros_like(brighter), torch.zeros_like(region)) == 0


def test_half_precision_gives_the_values_of_float32() -> None:
    """The sum of all changes is beyond what float16 holds, and the least one is below."""
    frames = torch.rand(3, 160, 160, 3, generator=torch.Generator().manual_seed(0)).half()
    region = torch.ones(3, 160, 160, 1).half()
    assert motion_amount(frames, frames) == 1
    assert temporal_error(frames[:1].expand_as(frames), frames) == pytest.approx(1)
    assert temporal_error(WALK[:1].expand_as(WALK).half(), WALK[:1].expand_as(WALK).half()) == 0
    found = flicker(frames, 0 * frames, region)
    torch.testing.assert_close(found, flicker(frames.float(), 0 * frames.float(), region.float()))


def test_a_small_misplacement_is_forgiven_and_a_large_one_is_not() -> None:
    near, far = (temporal_error(dot([10 + off, 20 + off, 30 + off, 40 + off]), WALK) for off in (1, 20))
    assert near < 0.45
    assert far > 1.2


def test_jitter_is_worse_than_standing_still() -> None:
    still = WALK[:1].expand_as(WALK)
    jitter = still + 0.3 * torch.randn(WALK.shape, generator=torch.Generator().manual_seed(0))
    assert temporal_error(jitter, WALK) > temporal_error(still, WALK)


@pytest.mark.parametrize("shape", [(2, 64, 64), (1, 40, 96), (1, 33, 7)])
def test_the_blur_is_scipys(shape: tuple[int, int, int]) -> None:
    planes = torch.rand(shape, generator=torch.Generator().manual_seed(1))
    sigma = shape[1] / 32
    expected = torch.from_numpy(gaussian_filter(planes.numpy(), (0, sigma, sigma)))
    torch.testing.assert_close(_blurred(planes), expected, atol=1e-6, rtol=1e-5)
