"""SSIM: closed forms, its definition by convolutions in float64, and scikit-image."""

import pytest
import torch
from skimage.metrics import structural_similarity
from torch.nn.functional import conv2d, interpolate

from dg4d_lib.errors import BadInput
from dg4d_lib.metrics.ssim import ssim


def noise(seed: int, *shape: int) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def pictures(height: int, width: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Smooth colors, half of them under noise, beside a white background."""
    truth = interpolate(noise(5, 2, 3, 4, 4), (height, width), mode="bilinear").movedim(1, -1)
    images = truth.clone()
    images[:, : height // 2] += 0.1 * (noise(6, 2, height // 2, width, 3) - 0.5)
    for picture in (images, truth):
        picture[:, :, : width // 3] = 1
    return images, truth


def by_convolution(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    line = torch.exp(-(torch.arange(-5, 6, dtype=x.dtype) ** 2) / 4.5)
    window = (line[:, None] * line / line.sum() ** 2).expand(x.shape[-1], 1, 11, 11)

    def mean(values):
        return conv2d(values.movedim(-1, 1), window, groups=len(window))

    mean_x, mean_y = mean(x), mean(y)
    variances = mean(x * x) - mean_x**2 + mean(y * y) - mean_y**2
    covariance = mean(x * y) - mean_x * mean_y
    light = (2 * mean_x * mean_y + 1e-4) / (mean_x**2 + mean_y**2 + 1e-4)
    return (light * (2 * covariance + 9e-4) / (variances + 9e-4)).mean((1, 2, 3))


@pytest.mark.parametrize(("height", "width"), [(11, 11), (12, 43), (64, 50), (130, 128)])
@pytest.mark.parametrize(
    ("dtype", "value_error", "gradient_error"), [(torch.float32, 1e-6, 2e-5), (torch.float64, 1e-13, 1e-11)]
)
def test_value_and_gradient_are_those_of_the_definition(height, width, dtype, value_error, gradient_error) -> None:  # type: ignore[no-untyped-def]
    images, truth = pictures(height, width)
    exact = images.requires_grad_()
    given = images.detach().to(dtype).requires_grad_()
    found, expected = ssim(given, truth.to(dtype)), by_convolution(exact, truth)
    assert (found - expected).abs().max() < value_error
    weights = torch.tensor([1.0, -2.0], dtype=dtype)
    (gradient,) = torch.autograd.grad(found, given, weights)
    (expected_gradient,) = torch.autograd.grad(expected, exact, weights.double())
    assert (gradient - expected_gradient).norm() / expected_gradient.norm() < gradient_error


def test_half_precision_is_computed_in_float32() -> None:
    images, truth = (value.half() for value in pictures(20, 30))
    torch.testing.assert_close(ssim(images, truth), ssim(images.float(), truth.float()))


def test_equal_pictures_have_one_and_no_gradient() -> None:
    images = pictures(20, 30)[0].float().requires_grad_()
    found = ssim(images, images.detach())
    torch.testing.assert_close(found, torch.ones(2), atol=1e-6, rtol=0)
    (gradient,) = torch.autograd.grad(found.sum(), images)
    assert gradient.abs().max() < 1e-5


def test_flat_pictures_have_the_luminance_term() -> None:
    a, b = 0.25, 0.75
    expected = (2 * a * b + 1e-4) / (a * a + b * b + 1e-4)
    found = ssim(torch.full((1, 12, 12, 1), a), torch.full((1, 12, 12, 1), b)).item()
    assert found == pytest.approx(expected, abs=1e-5)


def test_scikit_image_agrees_where_the_window_lies_inside() -> None:
    x, y = noise(1, 1, 24, 31, 3), noise(2, 1, 24, 31, 3)
    y = 0.7 * x + 0.3 * y
    _, theirs = structural_similarity(
        x[0].numpy(), y[0].numpy(), channel_axis=-1, data_range=1, gaussian_weights=True,
        use_sample_covariance=False, full=True,
    )  # fmt: skip
    assert ssim(x, y).item() == pytest.approx(theirs[5:-5, 5:-5].mean(), abs=1e-9)


def test_a_batch_is_judged_picture_by_picture() -> None:
    x, y = pictures(16, 18)
    alone = torch.cat([ssim(x[i : i + 1], y[i : i + 1]) for i in range(2)])
    assert torch.equal(ssim(x, y), alone)


def test_the_number_of_threads_does_not_change_a_byte() -> None:
    images, truth = (value.float() for value in pictures(40, 50))
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            given = images.clone().requires_grad_()
            found = ssim(given, truth)
            results.append((found, *torch.autograd.grad(found.sum(), given)))
    finally:
        torch.set_num_threads(before)
    assert all(a.equal(b) for a, b in zip(*results, strict=True))


def test_pictures_smaller_than_the_window_are_refused() -> None:
    with pytest.raises(BadInput, match="at least 11 x 11 pixels; given \\(10, 20\\)"):
        ssim(torch.zeros(1, 10, 20, 3), torch.zeros(1, 10, 20, 3))


def test_a_gradient_in_the_truth_is_refused() -> None:
    with pytest.raises(ValueError, match="detach"):
        ssim(torch.zeros(1, 11, 11, 1), torch.zeros(1, 11, 11, 1, requires_grad=True))


def test_a_pixel_that_is_no_number_makes_its_picture_none() -> None:
    images, truth = pictures(30, 30)
    images[1, 15, 15, 0] = torch.nan
    assert ssim(images, truth).isnan().tolist() == [False, True]
