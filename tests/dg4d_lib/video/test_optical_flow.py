"""Optical flow: the results of scikit-image, and nothing outside of the pictures is read."""

import numpy as np
import pytest
from scipy import ndimage
from skimage.registration import optical_flow_tvl1

from dg4d_lib.errors import BadInput
from dg4d_lib.video.optical_flow import optical_flow

TOLERANCE_PIXELS = 0.01  # rounding, which the alternation amplifies; the flow has some pixels


def pictures(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a smooth pattern and the same one turned and shifted by some pixels."""
    noise = np.random.default_rng(0).random((height + 20, width + 20)).astype(np.float32)
    pattern = ndimage.gaussian_filter(noise, 3)
    pattern = (pattern - pattern.min()) / np.ptp(pattern)
    moved = ndimage.shift(ndimage.rotate(pattern, 2, reshape=False, mode="nearest"), (1.7, -2.3), mode="nearest")
    return pattern[10:-10, 10:-10], moved[10:-10, 10:-10]


@pytest.mark.parametrize("warps", [1, 3, 5])
@pytest.mark.parametrize("size", [(20, 31), (71, 96), (128, 128)])
def test_the_flow_is_that_of_scikit_image(size: tuple[int, int], warps: int) -> None:
    first, second = pictures(*size)
    found = optical_flow(first, second, warps)
    expected = optical_flow_tvl1(first, second, num_warp=warps)
    assert np.abs(expected).mean() > 0.5
    np.testing.assert_allclose(found, expected, atol=TOLERANCE_PIXELS)


def test_outlines_before_a_bright_backdrop_move_as_those_of_scikit_image() -> None:
    first, second = (np.full((64, 80), 1.5) for _ in range(2))  # float64, above 1 as in `first_frame`
    first[20:40, 20:50] = second[23:43, 25:55] = np.linspace(0, 1, 30)
    np.testing.assert_allclose(optical_flow(first, second), optical_flow_tvl1(first, second), atol=TOLERANCE_PIXELS)


@pytest.mark.parametrize("size", [(2, 2), (2, 40), (64, 64)])
def test_equal_pictures_have_no_flow(size: tuple[int, int]) -> None:
    picture = np.random.default_rng(0).random(size).astype(np.float32)
    assert not optical_flow(picture, picture).any()
    assert not optical_flow(np.ones(size), np.ones(size)).any()  # no gradient anywhere


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30])
def test_gray_values_out_of_range_read_nothing_outside_of_the_pictures(value: float) -> None:
    first, second = pictures(40, 48)
    second[10:20, 10:20] = value
    with np.errstate(all="ignore"):
        assert optical_flow(first, second).shape == (2, 40, 48)


@pytest.mark.parametrize("size", [(1, 20), (0, 0)])
def test_sizes_that_have_no_flow_are_refused(size: tuple[int, int]) -> None:
    with pytest.raises(BadInput, match="at least 2 x 2 pixels"):
        optical_flow(np.zeros(size), np.zeros(size))
