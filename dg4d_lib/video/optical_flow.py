"""TV-L1 optical flow between two pictures (Zach et al. 2007, Sánchez Pérez et al. 2013), compiled.

The pyramid, the constants and the stopping rule are those of ``skimage.registration.optical_flow_tvl1``, and so are the
results, up to rounding. Notation of Sánchez Pérez et al. (name here -> symbol there): ``flow`` -> u, ``relaxed`` -> v,
``residual`` -> rho, ``dual`` -> p, ``ATTACHMENT`` -> lambda, ``TIGHTNESS`` -> theta, ``TIME_STEP`` -> tau.
"""

from typing import no_type_check

import numpy as np
from jaxtyping import Float, Float32
from scipy import ndimage
from skimage.transform import pyramid_reduce

from dg4d_lib.errors import BadInput
from dg4d_lib.kernels.compiling import njit

KERNEL = {"fastmath": {"contract"}, "nogil": True, "cache": True, "error_model": "numpy"}
LEVELS, SMALLEST = 10, 16  # of the pyramid: largest number of levels, and least side in pixels
WARPS = 5  # linearizations at every level, at most
STEPS, DUAL_STEPS = 10, 2  # iterations per linearization, and dual steps per iteration
ATTACHMENT, TIGHTNESS, TIME_STEP = 15.0, 0.3, 0.25
TOLERANCE = 1e-4  # square pixels, mean over the picture; steps after the first one that change less are the last ones
LIMIT = np.float32(ATTACHMENT * TIGHTNESS)  # of the step along the gradient
DUAL_RATE, DUAL_NORM = np.float32(TIME_STEP), np.float32(TIME_STEP / TIGHTNESS)


def optical_flow(
    first: Float[np.ndarray, "h w"], second: Float[np.ndarray, "h w"], warps: int = WARPS
) -> Float32[np.ndarray, "2 h w"]:
    """Return rows and columns by which every pixel of the first picture moves to where the second one shows it.

    Args:
        first: finite gray values, about [0, 1]; at least 2 x 2 pixels.
        second: likewise.
        warps: linearizations at every level of the pyramid, at most; fewer are faster and less exact.

    Raises:
        BadInput: the pictures differ in size, or have fewer than 2 pixels on a side.
    """
    if first.shape != second.shape or min(first.shape) < 2:
        raise BadInput(
            "optical flow needs two pictures of one size, at least 2 x 2 pixels; "
            f"given {first.shape} and {second.shape}"
        )
    flow = np.zeros((2, 1, 1), np.float32)
    for one, other in zip(_pyramid(first), _pyramid(second), strict=True):
        flow = _solve(one, other, _enlarged(flow, one.shape), warps)
    return flow


def _pyramid(picture: Float[np.ndarray, "h w"]) -> list[Float32[np.ndarray, "h_ w_"]]:
    """Return the picture at all levels, the smallest first."""
    levels = [np.ascontiguousarray(picture, np.float32)]
    while len(levels) < LEVELS and min(levels[-1].shape) > 2 * SMALLEST:
        levels.append(np.ascontiguousarray(pyramid_reduce(levels[-1]), np.float32))
    return levels[::-1]


def _enlarged(flow: Float32[np.ndarray, "2 h_ w_"], shape: tuple[int, int]) -> Float32[np.ndarray, "2 h w"]:
    """Return the flow of a level for the next larger one."""
    factors = [large / small for large, small in zip(shape, flow.shape[1:], strict=True)]
    nearest = ndimage.zoom(flow, [1, *factors], order=0, mode="nearest", prefilter=False)
    return np.ascontiguousarray(nearest * np.array(factors, np.float32)[:, None, None])


def _solve(
    first: Float32[np.ndarray, "h w"],
    second: Float32[np.ndarray, "h w"],
    start: Float32[np.ndarray, "2 h w"],
    warps: int,
) -> Float32[np.ndarray, "2 h w"]:
    """Return the flow of a level."""
    flow = np.pad(start, ((0, 0), (0, 1), (0, 1)))  # the last row and column repeat those before them
    dual = np.zeros((2, *flow.shape), np.float32)  # the first row and column stay 0
    warped, norm, residual = (np.empty_like(first) for _ in range(3))
    gradient, relaxed, after_first = (np.empty_like(start) for _ in range(3))
    inside = flow[:, :-1, :-1]
    for _ in range(warps):
        _warp(second, flow, warped)
        _linearize(first, warped, flow, gradient, norm, residual)
        _relax(flow, gradient, norm, residual, after_first)
        _iterate(gradient, norm, residual, relaxed, dual, flow)
        if np.square(after_first - inside).sum() < TOLERANCE * first.size:
            break
    return np.ascontiguousarray(inside)


@njit(**KERNEL)
@no_type_check
def _warp(picture, flow, warped):
    """Write the picture at the places that pixels move to, bilinear; pixels at the border continue outwards."""
    height, width = picture.shape
    for y in range(height):
        for x in range(width):
            row, column = np.float64(np.float32(y) + flow[0, y, x]), np.float64(np.float32(x) + flow[1, y, x])
            row = min(row, height - 1.0) if row > 0 else 0.0  # of NaN, too
            column = min(column, width - 1.0) if column > 0 else 0.0
            top, left = min(int(row), height - 2), min(int(column), width - 2)
            down, right = row - top, column - left
            upper = (1 - right) * picture[top, left] + right * picture[top, left + 1]
            lower = (1 - right) * picture[top + 1, left] + right * picture[top + 1, left + 1]
            warped[y, x] = (1 - down) * upper + down * lower


@njit(**KERNEL)
@no_type_check
def _linearize(first, warped, flow, gradient, norm, residual):
    """Write gradient, its squared norm (1 for 0), and the difference of the pictures without the flow."""
    height, width = warped.shape
    for y in range(height):
        above, below = max(y - 1, 0), min(y + 1, height - 1)
        for x in range(width):
            left, right = max(x - 1, 0), min(x + 1, width - 1)
            down = (warped[below, x] - warped[above, x]) / np.float32(below - above)
            across = (warped[y, right] - warped[y, left]) / np.float32(right - left)
            square = down * down + across * across
            gradient[0, y, x], gradient[1, y, x] = down, across
            norm[y, x] = square if square > 0 else np.float32(1)
            residual[y, x] = warped[y, x] - first[y, x] - (down * flow[0, y, x] + across * flow[1, y, x])


@njit(**KERNEL)
@no_type_check
def _iterate(gradient, norm, residual, relaxed, dual, flow):
    """Alternate between equal gray values and a smooth flow, in place."""
    for _ in range(STEPS):
        _relax(flow, gradient, norm, residual, relaxed)
        _denoise(relaxed, dual, flow)


@njit(**KERNEL)
@no_type_check
def _relax(flow, gradient, norm, residual, relaxed):
    """Write the flow after a step along the gradient of the picture towards equal gray values."""
    height, width = norm.shape
    for y in range(height):
        for x in range(width):
            down, across = gradient[0, y, x], gradient[1, y, x]
            difference = residual[y, x] + (down * flow[0, y, x] + across * flow[1, y, x])
            step = min(max(difference / norm[y, x], -LIMIT), LIMIT)
            relaxed[0, y, x] = flow[0, y, x] - step * down
            relaxed[1, y, x] = flow[1, y, x] - step * across


@njit(**KERNEL)
@no_type_check
def _denoise(relaxed, dual, flow):
    """Write the flow of less total variation that is near the relaxed one, by steps of the dual variable."""
    height, width = relaxed.shape[1:]
    one = np.float32(1)
    for axis in range(2):
        for y in range(height):
            for x in range(width):
                flow[axis, y, x] = relaxed[axis, y, x]
        for _ in range(DUAL_STEPS):
            for y in range(height):
                flow[axis, y, width] = flow[axis, y, width - 1]
            for x in range(width):
                flow[axis, height, x] = flow[axis, height - 1, x]
            for y in range(height):
                for x in range(width):
                    down = flow[axis, y + 1, x] - flow[axis, y, x]
                    across = flow[axis, y, x + 1] - flow[axis, y, x]
                    size = one / (one + DUAL_NORM * np.sqrt(down * down + across * across))
                    dual[axis, 0, y + 1, x + 1] = (dual[axis, 0, y + 1, x + 1] - DUAL_RATE * down) * size
                    dual[axis, 1, y + 1, x + 1] = (dual[axis, 1, y + 1, x + 1] - DUAL_RATE * across) * size
            for y in range(height):
                for x in range(width):
                    down = dual[axis, 0, y, x + 1] - dual[axis, 0, y + 1, x + 1]
                    across = dual[axis, 1, y + 1, x] - dual[axis, 1, y + 1, x + 1]
                    flow[axis, y, x] = relaxed[axis, y, x] + (down + across)
