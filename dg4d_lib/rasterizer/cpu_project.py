"""Gaussians to records on the screen, and gradients of records back to Gaussians.

The inverse covariance on the screen is factored, Sigma'^-1 = 2 ln2 W^T W with W = [[a, b], [0, c]], and a pixel is seen
in the whitened frame (u, v) = W (pixel - center): alpha = 2^(log2 o - u^2 - v^2). Nothing cancels there, so needles
keep their digits: with s = alpha dL/dalpha and the moments M of s over (u, v), dL/dcenter = 2 ln2 W^T M_1 and
dL/dSigma' = 2 ln2^2 W^T M_2 W.
"""

from math import log
from typing import no_type_check

import numpy as np
from numba import njit

from dg4d_lib.geometry.spherical_harmonics import C0
from dg4d_lib.kernels.simd import INLINE, KERNEL
from dg4d_lib.rasterizer.interface import BLUR, MIN_ALPHA, NEAR

# A record is what blending needs of one Gaussian: 16 floats, one cache line.
RECORD = 16
CENTER_X, CENTER_Y = 0, 1  # pixels
WHITEN_A, WHITEN_B, WHITEN_C = 2, 3, 4
LOG_OPACITY = 5  # to base 2
RED, GREEN, BLUE, DEPTH = 6, 7, 8, 9
ROW_SLOPE, ROW_REACH, ROW_LOSS = 10, 11, 12  # half a row's span is sqrt(reach - loss dy^2), its middle slope dy
EXTENT_X, EXTENT_Y = 13, 14  # pixels, half the bounding box
KEY = 15  # camera z or HIDDEN
# Its gradient: moments of s over the whitened frame, then dL/dcolor and dL/ddepth.
MOMENT, MOMENT_U, MOMENT_V, MOMENT_UU, MOMENT_UV, MOMENT_VV = 0, 1, 2, 3, 4, 5
MOMENTS = DEPTH + 1

CAMERA = 17  # floats: rotation by rows, translation, focal, center x and y, limit of |x/z| and of |y/z|
HIDDEN = np.float32(-1)  # key of a Gaussian that touches no pixel

_STATE = 13  # floats of a Gaussian: place, quaternion, scale, the coefficients of its constant color
_BLOCK = 64  # Gaussians computed together, always as many: their fields lie side by side, so the compiler makes vectors

_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
_LOG2_E, _LN_2 = np.float32(1 / log(2)), np.float32(log(2))
_LEAST_LOG_ALPHA = np.float32(log(MIN_ALPHA) / log(2))
_BLUR, _NEAR = np.float32(BLUR), np.float32(NEAR)
_C0 = np.float32(C0)
_ROUNDING = np.float32(1e-6)  # of colors: what lies so close to a bound of the clamp counts as inside
_LARGEST = np.float32(1e30)  # a determinant beyond is an overflow


@njit(**KERNEL)
@no_type_check
def project(means, quats, scales, log_opacities, coefficients, camera, height, width, records, keys, start, stop):
    """Fill records, and keys with camera z or HIDDEN, of Gaussians start..stop; coefficients are of the constant color.

    The bound where alpha falls to MIN_ALPHA lies within MAX_SIGMA for every opacity up to one, so it alone counts.
    """
    rotation, translation, focal, center_x, center_y, limit_x, limit_y = _lens(camera)
    right, bottom = np.float32(width) - _HALF, np.float32(height) - _HALF
    state, record = np.empty((_STATE, _BLOCK), np.float32), np.empty((RECORD, _BLOCK), np.float32)
    for first in range(start, stop, _BLOCK):
        count = min(_BLOCK, stop - first)
        _gather(means, quats, scales, coefficients, first, count, state)
        for k in range(count):
            record[LOG_OPACITY, k] = _LOG2_E * log_opacities[first + k]
        for k in range(_BLOCK):
            x, y, z = _to_camera(rotation, translation, state[0, k], state[1, k], state[2, k])
            turn, _, _ = _turn(state[3, k], state[4, k], state[5, k], state[6, k])
            stretch = _stretch(turn, state[7, k], state[8, k], state[9, k])
            half = _half(_jacobian(_slant(x, y, z, focal, limit_x, limit_y), rotation), stretch)
            xx, xy, yy, determinant = _covariance(half)
            a, b, c = _whitening(xx, xy, yy, determinant)
            reach = record[LOG_OPACITY, k] - _LEAST_LOG_ALPHA
            spread = max(reach, _ZERO) * _TWO * _LN_2
            extent_x, extent_y = np.sqrt(spread * xx), np.sqrt(spread * yy)
            u, v = focal * x / z + center_x, focal * y / z + center_y
            inverse_a2 = _ONE / (a * a)
            shown = (z > _NEAR) & (reach > _ZERO) & (determinant > _ZERO) & (determinant < _LARGEST)
            shown &= (u + extent_x > _HALF) & (u - extent_x < right)
            shown &= (v + extent_y > _HALF) & (v - extent_y < bottom)
            record[CENTER_X, k] = u
            record[CENTER_Y, k] = v
            record[WHITEN_A, k] = a
            record[WHITEN_B, k] = b
            record[WHITEN_C, k] = c
            record[RED, k] = min(max(_color(state[10, k]), _ZERO), _ONE)
            record[GREEN, k] = min(max(_color(state[11, k]), _ZERO), _ONE)
            record[BLUE, k] = min(max(_color(state[12, k]), _ZERO), _ONE)
            record[DEPTH, k] = z
            record[ROW_SLOPE, k] = xy / yy
            record[ROW_REACH, k] = reach * inverse_a2
            record[ROW_LOSS, k] = c * c * inverse_a2
            record[EXTENT_X, k] = extent_x
            record[EXTENT_Y, k] = extent_y
            record[KEY, k] = z if shown else HIDDEN
        for k in range(count):
            for field in range(RECORD):
                records[first + k, field] = record[field, k]
            keys[first + k] = record[KEY, k]


@njit(**KERNEL)
@no_type_check
def unproject(
    means, quats, scales, coefficients, camera, keys, moments,
    grad_means, grad_quats, grad_log_scales, grad_log_opacities, grad_coefficients, grad_centers, start, stop,
):  # fmt: skip
    """Add what Gaussians start..stop get from the gradients of their records in one view."""
    rotation, translation, focal, _, _, limit_x, limit_y = _lens(camera)
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation
    state, moment = np.empty((_STATE, _BLOCK), np.float32), np.empty((MOMENTS, _BLOCK), np.float32)
    center, gradient = np.empty((2, _BLOCK), np.float32), np.empty((_STATE, _BLOCK), np.float32)
    for first in range(start, stop, _BLOCK):
        count = min(_BLOCK, stop - first)
        _gather(means, quats, scales, coefficients, first, count, state)
        for k in range(count):
            for field in range(MOMENTS):
                moment[field, k] = moments[first + k, field]
        for k in range(_BLOCK):
            s0, s1, s2 = state[7, k], state[8, k], state[9, k]
            x, y, z = _to_camera(rotation, translation, state[0, k], state[1, k], state[2, k])
            turn, unit, inverse_norm = _turn(state[3, k], state[4, k], state[5, k], state[6, k])
            stretch = _stretch(turn, s0, s1, s2)
            slant = _slant(x, y, z, focal, limit_x, limit_y)
            jacobian = _jacobian(slant, rotation)
            half = _half(jacobian, stretch)
            xx, xy, yy, determinant = _covariance(half)
            whitening = _whitening(xx, xy, yy, determinant)
            d_center_x, d_center_y = _center_gradient(whitening, moment[MOMENT_U, k], moment[MOMENT_V, k])
            whitened = _whitened(half, whitening, yy)
            d_whitened = _whitened_gradient(whitened, moment[MOMENT_UU, k], moment[MOMENT_UV, k], moment[MOMENT_VV, k])
            d_half = _half_gradient(whitening, d_whitened)
            d_slant = _slant_gradient(d_half, stretch, rotation)
            d_x, d_y, d_z = _place_gradient(x, y, z, focal, limit_x, limit_y, slant, d_slant, d_center_x, d_center_y)
            d_z += moment[DEPTH, k]
            d_turn = _stretch(_stretch_gradient(jacobian, d_half), s0, s1, s2)
            d_qw, d_qx, d_qy, d_qz = _quat_gradient(unit, inverse_norm, d_turn)
            center[0, k] = d_center_x
            center[1, k] = d_center_y
            gradient[0, k] = r00 * d_x + r10 * d_y + r20 * d_z
            gradient[1, k] = r01 * d_x + r11 * d_y + r21 * d_z
            gradient[2, k] = r02 * d_x + r12 * d_y + r22 * d_z
            gradient[3, k] = d_qw
            gradient[4, k] = d_qx
            gradient[5, k] = d_qy
            gradient[6, k] = d_qz
            # dL/d log s_k = (column k of P) . (column k of dL/dP), taken in the whitened frame
            gradient[7, k] = whitened[0] * d_whitened[0] + whitened[3] * d_whitened[3]
            gradient[8, k] = whitened[1] * d_whitened[1] + whitened[4] * d_whitened[4]
            gradient[9, k] = whitened[2] * d_whitened[2] + whitened[5] * d_whitened[5]
            gradient[10, k] = _color_gradient(state[10, k], moment[RED, k])
            gradient[11, k] = _color_gradient(state[11, k], moment[GREEN, k])
            gradient[12, k] = _color_gradient(state[12, k], moment[BLUE, k])
        for k in range(count):
            i = first + k
            if keys[i] > _ZERO:
                for axis in range(3):
                    grad_means[i, axis] += gradient[axis, k]
                    grad_log_scales[i, axis] += gradient[7 + axis, k]
                    grad_coefficients[i, axis] += gradient[10 + axis, k]
                for axis in range(4):
                    grad_quats[i, axis] += gradient[3 + axis, k]
                for axis in range(2):
                    grad_centers[i, axis] += center[axis, k]
                grad_log_opacities[i] += moment[MOMENT, k]


@njit(**INLINE)
@no_type_check
def _gather(means, quats, scales, coefficients, first, count, state):
    """Place, quaternion, scale and coefficients of some Gaussians, by fields."""
    for k in range(count):
        for axis in range(3):
            state[axis, k] = means[first + k, axis]
            state[7 + axis, k] = scales[first + k, axis]
            state[10 + axis, k] = coefficients[first + k, axis]
        for axis in range(4):
            state[3 + axis, k] = quats[first + k, axis]


@njit(**INLINE)
@no_type_check
def _color(coefficient):
    """The constant basis, before it is clamped to [0, 1]."""
    return _C0 * coefficient + _HALF


@njit(**INLINE)
@no_type_check
def _color_gradient(coefficient, d_color):
    """Through the clamp, which holds nothing back at its bounds."""
    return _C0 * d_color if abs(_color(coefficient) - _HALF) <= _HALF + _ROUNDING else _ZERO


@njit(**INLINE)
@no_type_check
def _lens(camera):
    """The parts of a camera as scalars, so that loops do not read it again."""
    rotation = (
        camera[0], camera[1], camera[2], camera[3], camera[4], camera[5], camera[6], camera[7], camera[8],
    )  # fmt: skip
    return rotation, (camera[9], camera[10], camera[11]), camera[12], camera[13], camera[14], camera[15], camera[16]


@njit(**INLINE)
@no_type_check
def _to_camera(rotation, translation, x, y, z):
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation
    return (
        r00 * x + r01 * y + r02 * z + translation[0],
        r10 * x + r11 * y + r12 * z + translation[1],
        r20 * x + r21 * y + r22 * z + translation[2],
    )


@njit(**INLINE)
@no_type_check
def _turn(w, x, y, z):
    """The rotation matrix by rows, the unit quaternion, and one over the given one's length."""
    inverse = _ONE / np.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    matrix = (
        _ONE - _TWO * (y * y + z * z), _TWO * (x * y - w * z), _TWO * (x * z + w * y),
        _TWO * (x * y + w * z), _ONE - _TWO * (x * x + z * z), _TWO * (y * z - w * x),
        _TWO * (x * z - w * y), _TWO * (y * z + w * x), _ONE - _TWO * (x * x + y * y),
    )  # fmt: skip
    return matrix, (w, x, y, z), inverse


@njit(**INLINE)
@no_type_check
def _stretch(turn, s0, s1, s2):
    t00, t01, t02, t10, t11, t12, t20, t21, t22 = turn
    return t00 * s0, t01 * s1, t02 * s2, t10 * s0, t11 * s1, t12 * s2, t20 * s0, t21 * s1, t22 * s2


@njit(**INLINE)
@no_type_check
def _slant(x, y, z, focal, limit_x, limit_y):
    """The four entries of the projection's Jacobian that are not zero: du/dx, du/dz, dv/dy, dv/dz."""
    near = focal / z
    return near, -near * min(max(x / z, -limit_x), limit_x), near, -near * min(max(y / z, -limit_y), limit_y)


@njit(**INLINE)
@no_type_check
def _jacobian(slant, rotation):
    """J W: from the world to the screen, by rows."""
    a0, a2, b1, b2 = slant
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation
    return (
        a0 * r00 + a2 * r20, a0 * r01 + a2 * r21, a0 * r02 + a2 * r22,
        b1 * r10 + b2 * r20, b1 * r11 + b2 * r21, b1 * r12 + b2 * r22,
    )  # fmt: skip


@njit(**INLINE)
@no_type_check
def _half(jacobian, stretch):
    """J W R S, two rows; times its transpose it is the covariance on the screen before the blur."""
    j00, j01, j02, j10, j11, j12 = jacobian
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = stretch
    return (
        j00 * m00 + j01 * m10 + j02 * m20, j00 * m01 + j01 * m11 + j02 * m21, j00 * m02 + j01 * m12 + j02 * m22,
        j10 * m00 + j11 * m10 + j12 * m20, j10 * m01 + j11 * m11 + j12 * m21, j10 * m02 + j11 * m12 + j12 * m22,
    )  # fmt: skip


@njit(**INLINE)
@no_type_check
def _covariance(half):
    """xx, xy, yy and the determinant of the covariance on the screen, blur included, pixels squared.

    det(P P^T + blur) as a sum of positive terms, the first by Cauchy-Binet: xx yy - xy^2 would cancel for needles.
    """
    p00, p01, p02, p10, p11, p12 = half
    sharp_xx = p00 * p00 + p01 * p01 + p02 * p02
    sharp_yy = p10 * p10 + p11 * p11 + p12 * p12
    minor0, minor1, minor2 = _minors(half)
    minors = minor0 * minor0 + minor1 * minor1 + minor2 * minor2
    determinant = minors + _BLUR * (sharp_xx + sharp_yy) + _BLUR * _BLUR
    return sharp_xx + _BLUR, p00 * p10 + p01 * p11 + p02 * p12, sharp_yy + _BLUR, determinant


@njit(**INLINE)
@no_type_check
def _minors(half):
    """The cross product of the two rows."""
    p00, p01, p02, p10, p11, p12 = half
    return p01 * p12 - p02 * p11, p02 * p10 - p00 * p12, p00 * p11 - p01 * p10


@njit(**INLINE)
@no_type_check
def _whitening(xx, xy, yy, determinant):
    """W = [[a, b], [0, c]] of a covariance."""
    half_log2_e = _HALF * _LOG2_E
    a = np.sqrt(half_log2_e * yy / determinant)
    return a, -half_log2_e * xy / (determinant * a), np.sqrt(half_log2_e / yy)


@njit(**INLINE)
@no_type_check
def _center_gradient(whitening, mu, mv):
    a, b, c = whitening
    return _TWO * _LN_2 * a * mu, _TWO * _LN_2 * (b * mu + c * mv)


@njit(**INLINE)
@no_type_check
def _whitened(half, whitening, yy):
    """W P, two rows: the Gaussian's own axes in the whitened frame, again without cancellation.

    a (p0 - xy / yy p1) = a / yy (p1 x (p0 x p1) + blur p0), rows p0 and p1 of P.
    """
    a, _, c = whitening
    p00, p01, p02, p10, p11, p12 = half
    n0, n1, n2 = _minors(half)
    k = a / yy
    return (
        k * (p11 * n2 - p12 * n1 + _BLUR * p00), k * (p12 * n0 - p10 * n2 + _BLUR * p01),
        k * (p10 * n1 - p11 * n0 + _BLUR * p02), c * p10, c * p11, c * p12,
    )  # fmt: skip


@njit(**INLINE)
@no_type_check
def _whitened_gradient(whitened, muu, muv, mvv):
    """4 ln2^2 M_2 W P, two rows."""
    u0, u1, u2, v0, v1, v2 = whitened
    k = _TWO * _TWO * _LN_2 * _LN_2
    muu, muv, mvv = k * muu, k * muv, k * mvv
    return (
        muu * u0 + muv * v0, muu * u1 + muv * v1, muu * u2 + muv * v2,
        muv * u0 + mvv * v0, muv * u1 + mvv * v1, muv * u2 + mvv * v2,
    )  # fmt: skip


@njit(**INLINE)
@no_type_check
def _half_gradient(whitening, d_whitened):
    """dL/dP = 2 dL/dSigma' P = W^T (4 ln2^2 M_2 W P), two rows."""
    a, b, c = whitening
    d0, d1, d2, e0, e1, e2 = d_whitened
    return a * d0, a * d1, a * d2, b * d0 + c * e0, b * d1 + c * e1, b * d2 + c * e2


@njit(**INLINE)
@no_type_check
def _slant_gradient(d_half, stretch, rotation):
    """From P = J W R S to the four entries of J."""
    d00, d01, d02, d10, d11, d12 = d_half
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = stretch
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation
    e00 = d00 * m00 + d01 * m01 + d02 * m02
    e01 = d00 * m10 + d01 * m11 + d02 * m12
    e02 = d00 * m20 + d01 * m21 + d02 * m22
    e10 = d10 * m00 + d11 * m01 + d12 * m02
    e11 = d10 * m10 + d11 * m11 + d12 * m12
    e12 = d10 * m20 + d11 * m21 + d12 * m22
    return (
        e00 * r00 + e01 * r01 + e02 * r02, e00 * r20 + e01 * r21 + e02 * r22,
        e10 * r10 + e11 * r11 + e12 * r12, e10 * r20 + e11 * r21 + e12 * r22,
    )  # fmt: skip


@njit(**INLINE)
@no_type_check
def _place_gradient(x, y, z, focal, limit_x, limit_y, slant, d_slant, d_center_x, d_center_y):
    """dL/d(x, y, z) in the camera's frame; a clamped ratio stands still in J, while the center always moves."""
    a0, a2, b1, b2 = slant
    d_a0, d_a2, d_b1, d_b2 = d_slant
    inverse = _ONE / z
    ratio_x, ratio_y = x * inverse, y * inverse
    d_ratio_x = focal * d_center_x - (a0 * d_a2 if abs(ratio_x) < limit_x else _ZERO)
    d_ratio_y = focal * d_center_y - (b1 * d_b2 if abs(ratio_y) < limit_y else _ZERO)
    d_z = a0 * d_a0 + a2 * d_a2 + b1 * d_b1 + b2 * d_b2 + d_ratio_x * ratio_x + d_ratio_y * ratio_y
    return d_ratio_x * inverse, d_ratio_y * inverse, -d_z * inverse


@njit(**INLINE)
@no_type_check
def _stretch_gradient(jacobian, d_half):
    """(J W)^T dL/dP: the gradient of R S."""
    j00, j01, j02, j10, j11, j12 = jacobian
    d00, d01, d02, d10, d11, d12 = d_half
    return (
        j00 * d00 + j10 * d10, j00 * d01 + j10 * d11, j00 * d02 + j10 * d12,
        j01 * d00 + j11 * d10, j01 * d01 + j11 * d11, j01 * d02 + j11 * d12,
        j02 * d00 + j12 * d10, j02 * d01 + j12 * d11, j02 * d02 + j12 * d12,
    )  # fmt: skip


@njit(**INLINE)
@no_type_check
def _quat_gradient(unit, inverse_norm, d_turn):
    """Through the rotation matrix and the normalization."""
    w, x, y, z = unit
    n00, n01, n02, n10, n11, n12, n20, n21, n22 = d_turn
    d_w = _TWO * (x * (n21 - n12) + y * (n02 - n20) + z * (n10 - n01))
    d_x = _TWO * (w * (n21 - n12) - _TWO * x * (n11 + n22) + y * (n01 + n10) + z * (n02 + n20))
    d_y = _TWO * (w * (n02 - n20) + x * (n01 + n10) - _TWO * y * (n00 + n22) + z * (n12 + n21))
    d_z = _TWO * (w * (n10 - n01) + x * (n02 + n20) + y * (n12 + n21) - _TWO * z * (n00 + n11))
    along = w * d_w + x * d_x + y * d_y + z * d_z
    return (
        (d_w - w * along) * inverse_norm, (d_x - x * along) * inverse_norm,
        (d_y - y * along) * inverse_norm, (d_z - z * along) * inverse_norm,
    )  # fmt: skip
