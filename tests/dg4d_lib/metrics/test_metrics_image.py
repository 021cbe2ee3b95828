"""Image metrics: closed forms."""

import math

import numpy as np
import pytest
import torch
from PIL import Image

from dg4d_lib.errors import BadInput
from dg4d_lib.metrics.image import as_float, iou, psnr, resize_square


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


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_psnr_in_half_precision_is_that_in_float32(dtype: torch.dtype) -> None:
    first, second = (noise(seed, 1, 256, 256, 3).to(dtype) for seed in (0, 1))
    torch.testing.assert_close(psnr(first, second), psnr(first.float(), second.float()))


def test_integers_are_refused() -> None:
    with pytest.raises(BadInput, match=r"given torch\.uint8; divide uint8 by 255"):
        as_float(torch.zeros(1, 2, 2, 3, dtype=torch.uint8))


def test_iou_of_two_shifted_squares() -> None:
    first, second = torch.zeros(1, 8, 8, 1), torch.zeros(1, 8, 8, 1)
    first[:, 0:4, 0:4], second[:, 0:4, 2:6] = 0.9, 0.51
    assert iou(first, second).item() == pytest.approx(8 / 24)


def test_coverage_at_or_below_the_threshold_does_not_count() -> None:
    assert iou(torch.full((1, 2, 2, 1), 0.5), torch.ones(1, 2, 2, 1)).item() == 0


def test_two_empty_silhouettes_are_alike() -> None:
    assert iou(torch.zeros(2, 3, 3, 1), torch.zeros(2, 3, 3, 1)).tolist() == [1, 1]


def test_a_batch_is_judged_picture_by_picture() -> None:
    x, y = noise(3, 3, 16, 16, 3), noise(4, 3, 16, 16, 3)
    alone = torch.cat([psnr(x[i : i + 1], y[i : i + 1]) for i in range(3)])
    torch.testing.assert_close(psnr(x, y), alone)


def test_resizing_is_pillows() -> None:
    coarse = torch.rand(1, 3, 5, 5, generator=torch.Generator().manual_seed(0))
    smooth = torch.nn.functional.interpolate(coarse, (40, 40), mode="bilinear").movedim(1, -1)
    levels = (smooth * 255).round().to(torch.uint8)
    for size in (16, 96):
        expected = np.asarray(Image.fromarray(levels[0].numpy()).resize((size, size), Image.BICUBIC)) / 255
        difference = resize_square(levels / 255, size)[0].numpy() - expected
        assert np.abs(difference).max() < 2 / 255  # Pillow rounds after either axis
