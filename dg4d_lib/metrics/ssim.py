"""SSIM and its gradient, compiled, in one pass over the rows of every image."""

from functools import partial
from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from dg4d_lib.errors import BadInput
from dg4d_lib.kernels.compiling import njit
from dg4d_lib.kernels.workers import run_parallel
from dg4d_lib.metrics.image import as_float

WINDOW, SIGMA = 11, 1.5  # pixels, Gaussian window (Wang et al. 2004)
C1, C2 = 0.01**2, 0.03**2  # stabilizers of luminance and contrast for images in [0, 1] (Wang et al. 2004)
CHUNK = 32  # floats; rows are padded to multiples of it, so that vectorized loops have no remainder
# No reassociation of sums: in another order, variances of flat regions are off by 1e-5
EXACT = {"fastmath": {"contract"}, "nogil": True, "cache": True, "error_model": "numpy"}


def ssim(images: Float[Tensor, "b h w c"], ground_truth: Float[Tensor, "b h w c"]) -> Float[Tensor, " b"]:
    """Return the structural similarity of images in [0, 1] (Wang et al. 2004): 11 x 11 Gaussian window, sigma 1.5.

    Population covariances; mean over channels and all positions of the window inside the image. 1 is equal. Computed on
    the CPU in the precision of the images, at least float32 (accurate to 2e-6); differentiable once, in the images.

    Raises:
        BadInput: images with fewer than 11 pixels on a side, or of integers.
        ValueError: the ground truth requires a gradient.
    """
    if min(images.shape[1:3]) < WINDOW:
        raise BadInput(f"SSIM needs images of at least {WINDOW} x {WINDOW} pixels; given {tuple(images.shape[1:3])}")
    if ground_truth.requires_grad:
        raise ValueError("SSIM has no gradient in the ground truth; detach it")
    images = as_float(images)
    pair = (images, as_float(ground_truth).to(images.dtype))
    similarity: Tensor = _Ssim.apply(*(planes.movedim(-1, 1).cpu() for planes in pair))
    return similarity.to(images)


class _Ssim(torch.autograd.Function):
    """Autograd function; the forward pass computes the gradient too, and the backward pass scales it."""

    @staticmethod
    def forward(ctx: Any, images: Tensor, ground_truth: Tensor) -> Tensor:
        batch, channels, height, width = images.shape
        needed = ctx.needs_input_grad[0]
        pair = (images, ground_truth)
        planes = [batch.detach().contiguous().numpy().reshape(-1, height, width) for batch in pair]
        gradient = torch.empty(images.shape if needed else (batch, channels, 0, 0), dtype=images.dtype)
        gradients = gradient.numpy().reshape(batch * channels, *gradient.shape[2:])
        sums = np.empty(batch * channels)
        steps = np.arange(WINDOW) - WINDOW // 2
        weights = np.exp(-np.square(steps) / (2 * SIGMA**2))
        weights = (weights / weights.sum()).astype(gradients.dtype)
        jobs = zip(*planes, gradients, sums.reshape(-1, 1), strict=True)
        run_parallel([partial(_compare, *job, weights) for job in jobs])
        ctx.gradient, ctx.count = gradient, channels * (height - WINDOW + 1) * (width - WINDOW + 1)
        return torch.from_numpy(sums.reshape(batch, channels).sum(1) / ctx.count).to(images.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, incoming: Tensor) -> tuple[Tensor, None]:
        return ctx.gradient * (incoming / ctx.count)[:, None, None, None], None


@njit(**EXACT)
@no_type_check
def _compare(image, ground_truth, gradient, total, weights):
    """Sum the similarities of one channel; compute the gradient in the image unless `gradient` is empty.

    Every row is read once. A ring buffer keeps the last eleven rows of five moments, filtered horizontally, for the
    vertical filter. A row of similarities gives three derivatives, which pass through the same filters, because the
    window is symmetric. Rows are zero-padded, so that loops have no remainder.
    """
    height, width = image.shape
    size = len(weights)
    across, down, needed = width - size + 1, height - size + 1, gradient.size > 0
    padded = -(-across // CHUNK) * CHUNK
    padded_width = -(-width // CHUNK) * CHUNK
    moments = np.zeros((5, padded + size - 1), image.dtype)
    rows = np.zeros((size, 5, padded), image.dtype)
    means = np.empty((5, padded), image.dtype)
    similarity = np.empty(padded, image.dtype)
    slopes = np.zeros((3, size - 1 + max(padded, padded_width)), image.dtype)
    slope_rows = np.zeros((size, 3, padded_width), image.dtype)
    back = np.empty((3, padded_width), image.dtype)
    sum_of_similarities = 0.0
    for row in range(height + size - 1):
        if row < height:
            _moments(image[row], ground_truth[row], moments)
            for k in range(5):
                _along(moments[k], weights, rows[row % size, k])
        first = row - size + 1  # first row of the window; its gradient is complete after this row
        if first < 0:
            continue
        if first < down:
            _across(rows, weights, row + 1, means)
            _similarity(means, similarity, slopes[:, size - 1 :])
            for column in range(across):
                sum_of_similarities += similarity[column]
            slopes[:, size - 1 + across :] = 0
        else:
            slopes[:] = 0
        if needed:
            for k in range(3):
                _along(slopes[k], weights, slope_rows[first % size, k])
            _across(slope_rows, weights, first + 1, back)
            _gradient(image[first], ground_truth[first], back, gradient[first])
    total[0] = sum_of_similarities


@njit(**EXACT, forceinline=True)
@no_type_check
def _moments(x, y, moments):
    """Compute moments of values minus 1/2, so that variances are differences of smaller numbers."""
    half = x.dtype.type(0.5)
    for i in range(len(x)):
        a, b = x[i] - half, y[i] - half
        moments[0, i] = a
        moments[1, i] = b
        moments[2, i] = a * a
        moments[3, i] = b * b
        moments[4, i] = a * b


@njit(**EXACT, forceinline=True)
@no_type_check
def _along(values, weights, sums):
    """Filter a row horizontally."""
    a, b, c, d, e, f = weights[0], weights[1], weights[2], weights[3], weights[4], weights[5]
    v1, v2, v3, v4, v5 = values[1:], values[2:], values[3:], values[4:], values[5:]
    v6, v7, v8, v9, v10 = values[6:], values[7:], values[8:], values[9:], values[10:]
    for i in range(len(sums)):
        outer = a * (values[i] + v10[i]) + b * (v1[i] + v9[i]) + c * (v2[i] + v8[i])
        sums[i] = outer + d * (v3[i] + v7[i]) + e * (v4[i] + v6[i]) + f * v5[i]


@njit(**EXACT, forceinline=True)
@no_type_check
def _across(rows, weights, oldest, sums):
    """Filter the rows of a ring buffer vertically."""
    size, flat = len(weights), sums.reshape(-1)
    weight, middle = weights[size // 2], rows[(oldest + size // 2) % size].reshape(-1)
    for i in range(len(flat)):
        flat[i] = weight * middle[i]
    for k in range(size // 2):
        weight = weights[k]
        above, below = rows[(oldest + k) % size].reshape(-1), rows[(oldest - 1 - k) % size].reshape(-1)
        for i in range(len(flat)):
            flat[i] += weight * (above[i] + below[i])


@njit(**EXACT, forceinline=True)
@no_type_check
def _similarity(means, similarity, slopes):
    """Compute the similarities of a row and their derivatives in the mean, mean square and mean product."""
    kind = means.dtype.type
    half, one, two, c1, c2 = kind(0.5), kind(1), kind(2), kind(C1), kind(C2)
    for i in range(len(similarity)):
        x, y = means[0, i], means[1, i]
        variances = (means[2, i] - x * x) + (means[3, i] - y * y)
        covariance = means[4, i] - x * y
        bright_x, bright_y = x + half, y + half
        light, per_light = two * bright_x * bright_y + c1, one / (bright_x * bright_x + bright_y * bright_y + c1)
        contrast, per_contrast = two * covariance + c2, one / (variances + c2)
        value = light * contrast * per_light * per_contrast
        by_light = two * per_light * (bright_y * contrast * per_contrast - value * bright_x)
        by_square = -value * per_contrast
        by_product = two * light * per_light * per_contrast
        similarity[i] = value
        slopes[0, i] = by_light - two * x * by_square - y * by_product
        slopes[1, i] = by_square
        slopes[2, i] = by_product


@njit(**EXACT, forceinline=True)
@no_type_check
def _gradient(x, y, back, gradient):
    """Propagate from the moments to the pixels of a row."""
    half, two = x.dtype.type(0.5), x.dtype.type(2)
    for i in range(len(gradient)):
        gradient[i] = back[0, i] + two * (x[i] - half) * back[1, i] + (y[i] - half) * back[2, i]
