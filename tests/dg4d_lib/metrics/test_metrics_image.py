"""Image metrics: closed forms, and the library that everyone compares with."""

import math

import pytest
import torch
from skimage.metrics import structural_similarity

from dg4d_lib.metrics.image import iou, psnr, ssim


def noise(seed: int, *shape: int) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("error", [0.5, 0.1, 0.01])
def test_psnr_of_a_constant_error_is_its_decibels(error: float) -> None:
    dark = torch.zeros(2, 4, 5, 3)
    torch.testing.assert_close(psnr(dark + error, dark), torch.full((2,), -20 * math.log10(error)))


def test_psnr_of_equal_pictures_is_60() -> None:
    assert psnr(noise(0, 3, 4, 4, 3), noise(0, 3, 4, 4, 3)).tolist() == [60.0] * 3


def test_psnr_in_a_region_ignores_what_lies_outside() -> None:
    truth = torch.zeros(1, 2, 2, 3)
    image, region = truth.clone(), torch.zeros(1, 2, 2, 1)
    image[0, 0, 0], image[0, 1, 1], region[0, 0, 0] = 0.1, 1.0, 1.0
    torch.testing.assert_close(psnr(image, truth, region), torch.tensor([20.0]))


def test_psnr_of_an_empty_region_is_60() -> None:
    assert psnr(torch.zeros(1, 2, 2, 3), torch.ones(1, 2, 2, 3), torch.zeros(1, 2, 2, 1)).item() == 60


def test_ssim_of_equal_pictures_is_one() -> None:
    torch.testing.assert_close(ssim(noise(0, 2, 16, 20, 3), noise(0, 2, 16, 20, 3)), torch.ones(2, dtype=torch.float64))


def test_ssim_of_flat_pictures_is_the_luminance_term() -> None:
    a, b = 0.25, 0.75
    expected = (2 * a * b + 1e-4) / (a * a + b * b + 1e-4)
    assert ssim(torch.full((1, 12, 12, 1), a), torch.full((1, 12, 12, 1), b)).item() == pytest.approx(
        expected, abs=1e-5
    )


def test_ssim_agrees_with_scikit_image_where_the_window_lies_inside() -> None:
    x, y = noise(1, 1, 24, 31, 3), noise(2, 1, 24, 31, 3)
    y = 0.7 * x + 0.3 * y
    _, theirs = structural_similarity(
        x[0].numpy(), y[0].numpy(), channel_axis=-1, data_range=1, gaussian_weights=True,
        use_sample_covariance=False, full=True,
    )  # fmt: skip
    assert ssim(x, y).item() == pytest.approx(theirs[5:-5, 5:-5].mean(), abs=1e-9)


def test_iou_of_two_shifted_squares() -> None:
    first, second = torch.zeros(1, 8, 8, 1), torch.zeros(1, 8, 8, 1)
    first[:, 0:4, 0:4], second[:, 0:4, 2:6] = 0.9, 0.6
    assert iou(first, second).item() == pytest.approx(8 / 24)


def test_coverage_at_or_below_the_threshold_does_not_count() -> None:
    assert iou(torch.full((1, 2, 2, 1), 0.5), torch.ones(1, 2, 2, 1)).item() == 0


def test_two_empty_silhouettes_are_alike() -> None:
    assert iou(torch.zeros(2, 3, 3, 1), torch.zeros(2, 3, 3, 1)).tolist() == [1, 1]


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_a_batch_is_judged_picture_by_picture(metric) -> None:  # type: ignore[no-untyped-def]
    x, y = noise(3, 3, 16, 16, 3), noise(4, 3, 16, 16, 3)
    alone = torch.cat([metric(x[i : i + 1], y[i : i + 1]) for i in range(3)])
    torch.testing.assert_close(metric(x, y), alone)
