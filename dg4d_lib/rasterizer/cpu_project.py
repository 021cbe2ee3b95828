"""Projection of Gaussians to screen-space records, and its backward pass.

The inverse 2D covariance (conic) is factored, Sigma'^-1 = 2 ln2 W^T W with W = [[a, b], [0, c]], and pixels are mapped
to the whitened frame (u, v) = W (pixel - mean2d): alpha = 2^(log2 o - u^2 - v^2). This avoids cancellation, so needles
keep their digits. With s = alpha dL/dalpha and the moments M of s over (u, v), dL/dmean2d = 2 ln2 W^T M_1 and
dL/dSigma' = 2 ln2^2 W^T M_2 W.
"""

from math import log
from typing import no_type_check

import numpy as np

from dg4d_lib.geometry.spherical_harmonics import C0
from dg4d_lib.kernels.compiling import njit
from dg4d_lib.kernels.simd import INLINE, KERNEL
from dg4d_lib.rasterizer.interface import BLUR, MIN_ALPHA, NEAR

# Record of a projected Gaussian, the input of blending: 16 floats, one cache line.
RECORD = 16
MEAN2D_X, MEAN2D_Y = 0, 1  # pixels
WHITEN_A, WHITEN_B, WHITEN_C = 2, 3, 4
LOG_OPACITY = 5  # to base 2
RED, GREEN, BLUE, DEPTH = 6, 7, 8, 9
ROW_SLOPE, ROW_REACH, ROW_LOSS = 10, 11, 12  # a row's span has half-width sqrt(reach - loss dy^2), center slope dy
EXTENT_X, EXTENT_Y = 13, 14  # pixels, half of the bounding box (gsplat's radii)
KEY = 15  # camera z or HIDDEN
# Gradient of a record: moments of s over the whitened frame, then dL/dcolor and dL/ddepth.
MOMENT, MOMENT_U, MOMENT_V, MOMENT_UU, MOMENT_UV, MOMENT_VV = 0, 1, 2, 3, 4, 5
GRAD_FIELDS = DEPTH + 1

CAMERA = 17  # floats: rotation by rows, translation, focal, principal point, limits of |x/z| and |y/z|
HIDDEN = np.float32(-1)  # key of a Gaussian that is not drawn

_STATE = 13  # floats of a Gaussian: mean, quaternion, scale, degree-0 color coefficients
_BLOCK = 64  # Gaussians per block, stored field by field; a constant size, so that the compiler vectorizes the loops

_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
_LOG2_E, _LN_2 = np.float32(1 / log(2)), np.float32(log(2))
_MIN_LOG_ALPHA = np.float32(log(MIN_ALPHA) / log(2))
_BLUR, _NEAR = np.float32(BLUR), np.float32(NEAR)
_C0 = np.float32(C0)
_ROUNDING = np.float32(1e-6)  # tolerance of the color clamp: values this close to a bound count as inside
_MAX_DETERMINANT = np.float32(1e30)  # larger ones count as overflow


@njit(**KERNEL)
@no_type_check
def project(means, quats, scales, log_opacities, sh0, camera, height, width, records, keys, start, stop):
    """Fill the records of Gaussians start..stop, and their keys with camera z or HIDDEN.

    The radius at which alpha falls to MIN_ALPHA is below MAX_SIGMA for every opacity up to one, so it alone is used.
    `sh0` are the color coefficients of degree 0.
    """
    rotation, translation, focal, principal_x, principal_y, limit_x, limit_y = _unpack_camera(camera)
    right, bottom = np.float32(width) - _HALF, np.float32(height) - _HALF
    state, record = np.empty((_STATE, _BLOCK), np.float32), np.empty((RECORD, _BLOCK), np.float32)
    for first in range(start, stop, _BLOCK):
        count = min(_BLOCK, stop - first)
        _gather(means, quats, scales, sh0, first, count, state)
        for k in range(count):
            record[LOG_OPACITY, k] = _LOG2_E * log_opacities[first + k]
        for k in range(_BLOCK):
            x, y, z = _to_camera(rotation, translation, state[0, k], state[1, k], state[2, k])
            axes, _, _ = _rotation_matrix(state[3, k], state[4, k], state[5, k], state[6, k])
            scaled = _scale_columns(axes, state[7, k], state[8, k], state[9, k])
            half = _half(_world_jacobian(_projection_jacobian(x, y, z, focal, limit_x, limit_y), rotation), scaled)
            xx, xy, yy, determinant = _covariance(half)
            a, b, c = _whitening(xy, yy, determinant)
            reach = record[LOG_OPACITY, k] - _MIN_LOG_ALPHA
            squared_radius = max(reach, _ZERO) * _TWO * _LN_2
            extent_x, extent_y = np.sqrt(squared_radius * xx), np.sqrt(squared_radius * yy)
            u, v = focal * x / z + principal_x, focal * y / z + principal_y
            inverse_a2 = _ONE / (a * a)
            visible = (z > _NEAR) & (reach > _ZERO) & (determinant > _ZERO) & (determinant < _MAX_DETERMINANT)
            visible &= (u + extent_x > _HALF) & (u - extent_x < right)
            visible &= (v + extent_y > _HALF) & (v - extent_y < bottom)
            record[MEAN2D_X, k] = u
            record[MEAN2D_Y, k] = v
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
            record[KEY, k] = z if visible else HIDDEN
        for k in range(count):
            for field in range(RECORD):
                records[first + k, field] = record[field, k]
            keys[first + k] = record[KEY, k]


@njit(**KERNEL)
@no_type_check
def unproject(
    means, quats, scales, sh0, camera, keys, grad_records,
    grad_means, grad_quats, grad_log_scales, grad_log_opacities, grad_sh0, grad_means2d, start, stop,
):  # fmt: skip
    """Add the gradients of Gaussians start..stop, given those of their records in one view."""
    rotation, translation, focal, _, _, limit_x, limit_y = _unpack_camera(camera)
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation
    state, grad_record = np.empty((_STATE, _BLOCK), np.float32), np.empty((GRAD_FIELDS, _BLOCK), np.float32)
    mean2d_gradient, gradient = np.empty((2, _BLOCK), np.float32), np.empty((_STATE, _BLOCK), np.float32)
    for first in range(start, stop, _BLOCK):
        count = min(_BLOCK, stop - first)
        _gather(means, quats, scales, sh0, first, count, state)
        for k in range(count):
            for field in range(GRAD_FIELDS):
                grad_record[field, k] = grad_records[first + k, field]
        for k in range(_BLOCK):
            s0, s1, s2 = state[7, k], state[8, k], state[9, k]
            x, y, z = _to_camera(rotation, translation, state[0, k], state[1, k], state[2, k])
            axes, unit, inverse_norm = _rotation_matrix(state[3, k], state[4, k], state[5, k], state[6, k])
            scaled = _scale_columns(axes, s0, s1, s2)
            projection = _projection_jacobian(x, y, z, focal, limit_x, limit_y)
            jacobian = _world_jacobian(projection, rotation)
            half = _half(jacobian, scaled)
            _, xy, yy, determinant = _covariance(half)
            whitening = _whitening(xy, yy, determinant)
            d_mean2d_x, d_mean2d_y = _mean2d_gradient(whitening, grad_record[MOMENT_U, k], grad_record[MOMENT_V, k])
            whitened = _whitened(half, whitening, yy)
            d_whitened = _whitened_gradient(
                whitened, grad_record[MOMENT_UU, k], grad_record[MOMENT_UV, k], grad_record[MOMENT_VV, k]
            )
            d_half = _half_gradient(whitening, d_whitened)
            d_projection = _projection_gradient(d_half, scaled, rotation)
            d_x, d_y, d_z = _camera_mean_gradient(
                x, y, z, focal, limit_x, limit_y, projection, d_projection, d_mean2d_x, d_mean2d_y
            )
            d_z += grad_record[DEPTH, k]
            d_axes = _scale_columns(_scaled_gradient(jacobian, d_half), s0, s1, s2)
            d_qw, d_qx, d_qy, d_qz = _quat_gradient(unit, inverse_norm, d_axes)
            mean2d_gradient[0, k] = d_mean2d_x
            mean2d_gradient[1, k] = d_mean2d_y
            gradient[0, k] = r00 * d_x + r10 * d_y + r20 * d_z
            gradient[1, k] = r01 * d_x + r11 * d_y + r21 * d_z
            gradient[2, k] = r02 * d_x + r12 * d_y + r22 * d_z
            gradient[3, k] = d_qw
            gradient[4, k] = d_qx
            gradient[5, k] = d_qy
            gradient[6, k] = d_qz
            # dL/d log s_k = (column k of P) . (column k of dL/dP), in the whitened frame
            gradient[7, k] = whitened[0] * d_whitened[0] + whitened[3] * d_whitened[3]
            gradient[8, k] = whitened[1] * d_whitened[1] + whitened[4] * d_whitened[4]
            gradient[9, k] = whitened[2] * d_whitened[2] + whitened[5] * d_whitened[5]
            gradient[10, k] = _color_gradient(state[10, k], grad_record[RED, k])
            gradient[11, k] = _color_gradient(state[11, k], grad_record[GREEN, k])
            gradient[12, k] = _color_gradient(state[12, k], grad_record[BLUE, k])
        for k in range(count):
            i = first + k
            if keys[i] > _ZERO:
                for axis in range(3):
                    grad_means[i, axis] += gradient[axis, k]
                    grad_log_scales[i, axis] += gradient[7 + axis, k]
                    grad_sh0[i, axis] += gradient[10 + axis, k]
                for axis in range(4):
                    grad_quats[i, axis] += gradient[3 + axis, k]
                for axis in range(2):
                    grad_means2d[i, axis] += mean2d_gradient[axis, k]
                grad_log_opacities[i] += grad_record[MOMENT, k]


@njit(**INLINE)
@no_type_check
def _gather(means, quats, scales, sh0, first, count, state):
    """Copy mean, quaternion, scale and color coefficients of a block of Gaussians, field by field."""
    for k in range(count):
        for axis in range(3):
            state[axis, k] = means[first + k, axis]
            state[7 + axis, k] = scales[first + k, axis]
            state[10 + axis, k] = sh0[first + k, axis]
        for axis in range(4):
            state[3 + axis, k] = quats[first + k, axis]


@njit(**INLINE)
@no_type_check
def _color(sh0):
    """Evaluate the color of degree 0, before the clamp to [0, 1]."""
    return _C0 * sh0 + _HALF


@njit(**INLINE)
@no_type_check
def _color_gradient(sh0, d_color):
    """Propagate through the clamp, which passes the gradient at its bounds."""
    return _C0 * d_color if abs(_color(sh0) - _HALF) <= _HALF + _ROUNDING else _ZERO


@njit(**INLINE)
@no_type_check
def _unpack_camera(camera):
    """Return the parts of a camera as scalars, so that loops do not read the array again."""
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
def _rotation_matrix(w, x, y, z):
    """Return the rotation matrix by rows, the unit quaternion and the inverse norm of the given one."""
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
def _scale_columns(axes, s0, s1, s2):
    t00, t01, t02, t10, t11, t12, t20, t21, t22 = axes
    return t00 * s0, t01 * s1, t02 * s2, t10 * s0, t11 * s1, t12 * s2, t20 * s0, t21 * s1, t22 * s2


@njit(**INLINE)
@no_type_check
def _projection_jacobian(x, y, z, focal, limit_x, limit_y):
    """Return the nonzero entries of the projection's Jacobian J: du/dx, du/dz, dv/dy, dv/dz."""
    near = focal / z
    return near, -near * min(max(x / z, -limit_x), limit_x), near, -near * min(max(y / z, -limit_y), limit_y)


@njit(**INLINE)
@no_type_check
def _world_jacobian(projection, rotation):
    """Return J W by rows: the Jacobian from world space to the screen."""
    a0, a2, b1, b2 = projection
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation
    return (
        a0 * r00 + a2 * r20, a0 * r01 + a2 * r21, a0 * r02 + a2 * r22,
        b1 * r10 + b2 * r20, b1 * r11 + b2 * r21, b1 * r12 + b2 * r22,
    )  # fmt: skip


@njit(**INLINE)
@no_type_check
def _half(jacobian, scaled):
    """Return P = J W R S, two rows; P P^T is the 2D covariance before the blur."""
    j00, j01, j02, j10, j11, j12 = jacobian
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = scaled
    return (
        j00 * m00 + j01 * m10 + j02 * m20, j00 * m01 + j01 * m11 + j02 * m21, j00 * m02 + j01 * m12 + j02 * m22,
        j10 * m00 + j11 * m10 + j12 * m20, j10 * m01 + j11 * m11 + j12 * m21, j10 * m02 + j11 * m12 + j12 * m22,
    )  # fmt: skip


@njit(**INLINE)
@no_type_check
def _covariance(half):
    """Return xx, xy, yy and the determinant of the 2D covariance with blur, pixels squared.

    det(P P^T + blur) is a sum of positive terms, the first by Cauchy-Binet: xx yy - xy^2 would cancel for needles.
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
    """Return the cross product of the two rows of P."""
    p00, p01, p02, p10, p11, p12 = half
    return p01 * p12 - p02 * p11, p02 * p10 - p00 * p12, p00 * p11 - p01 * p10


@njit(**INLINE)
@no_type_check
def _whitening(xy, yy, determinant):
    """Return W = [[a, b], [0, c]] of a covariance."""
    half_log2_e = _HALF * _LOG2_E
    a = np.sqrt(half_log2_e * yy / determinant)
    return a, -half_log2_e * xy / (determinant * a), np.sqrt(half_log2_e / yy)


@njit(**INLINE)
@no_type_check
def _mean2d_gradient(whitening, mu, mv):
    a, b, c = whitening
    return _TWO * _LN_2 * a * mu, _TWO * _LN_2 * (b * mu + c * mv)


@njit(**INLINE)
@no_type_check
def _whitened(half, whitening, yy):
    """Return W P, two rows: the Gaussian's axes in the whitened frame, without cancellation.

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
    """Return 4 ln2^2 M_2 W P, two rows."""
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
    """Return dL/dP = 2 dL/dSigma' P = W^T (4 ln2^2 M_2 W P), two rows."""
    a, b, c = whitening
    d0, d1, d2, e0, e1, e2 = d_whitened
    return a * d0, a * d1, a * d2, b * d0 + c * e0, b * d1 + c * e1, b * d2 + c * e2


@njit(**INLINE)
@no_type_check
def _projection_gradient(d_half, scaled, rotation):
    """Propagate from P = J W R S to the four entries of J."""
    d00, d01, d02, d10, d11, d12 = d_half
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = scaled
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
def _camera_mean_gradient(x, y, z, focal, limit_x, limit_y, projection, d_projection, d_mean2d_x, d_mean2d_y):
    """Return dL/d(x, y, z) in the camera frame; a clamped ratio has no gradient in J, but always one in mean2d."""
    a0, a2, b1, b2 = projection
    d_a0, d_a2, d_b1, d_b2 = d_projection
    inverse = _ONE / z
    ratio_x, ratio_y = x * inverse, y * inverse
    d_ratio_x = focal * d_mean2d_x - (a0 * d_a2 if abs(ratio_x) < limit_x else _ZERO)
    d_ratio_y = focal * d_mean2d_y - (b1 * d_b2 if abs(ratio_y) < limit_y else _ZERO)
    d_z = a0 * d_a0 + a2 * d_a2 + b1 * d_b1 + b2 * d_b2 + d_ratio_x * ratio_x + d_ratio_y * ratio_y
    return d_ratio_x * inverse, d_ratio_y * inverse, -d_z * inverse


@njit(**INLINE)
@no_type_check
def _scaled_gradient(jacobian, d_half):
    """Return (J W)^T dL/dP: the gradient of R S."""
    j00, j01, j02, j10, j11, j12 = jacobian
    d00, d01, d02, d10, d11, d12 = d_half
    return (
        j00 * d00 + j10 * d10, j00 * d01 + j10 * d11, j00 * d02 + j10 * d12,
        j01 * d00 + j11 * d10, j01 * d01 + j11 * d11, j01 * d02 + j11 * d12,
        j02 * d00 + j12 * d10, j02 * d01 + j12 * d11, j02 * d02 + j12 * d12,
    )  # fmt: skip


@njit(**INLINE)
@no_type_check
def _quat_gradient(unit, inverse_norm, d_axes):
    """Propagate through the rotation matrix and the normalization of the quaternion."""
    w, x, y, z = unit
    n00, n01, n02, n10, n11, n12, n20, n21, n22 = d_axes
    d_w = _TWO * (x * (n21 - n12) + y * (n02 - n20) + z * (n10 - n01))
    d_x = _TWO * (w * (n21 - n12) - _TWO * x * (n11 + n22) + y * (n01 + n10) + z * (n02 + n20))
    d_y = _TWO * (w * (n02 - n20) + x * (n01 + n10) - _TWO * y * (n00 + n22) + z * (n12 + n21))
    d_z = _TWO * (w * (n10 - n01) + x * (n02 + n20) + y * (n12 + n21) - _TWO * z * (n00 + n11))
    along = w * d_w + x * d_x + y * d_y + z * d_z
    return (
        (d_w - w * along) * inverse_norm, (d_x - x * along) * inverse_norm,
        (d_y - y * along) * inverse_norm, (d_z - z * along) * inverse_norm,
    )  # fmt: skip
