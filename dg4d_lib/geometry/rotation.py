"""Rotations nearest to matrices, for kernels."""

from typing import no_type_check

import numpy as np
from numba import njit

from dg4d_lib.kernels.compiling import configure_numba

configure_numba()

SWEEPS = 6  # Jacobi sweeps; a 4 x 4 matrix needs five for full precision


@njit(cache=True, nogil=True)
@no_type_check
def nearest_rotation(m, rotation):
    """Write the proper rotation nearest to a matrix: an eigenvector (Horn 1987), found by Jacobi sweeps."""
    n = np.zeros((4, 4))
    n[0, 0], n[1, 1] = m[0, 0] + m[1, 1] + m[2, 2], m[0, 0] - m[1, 1] - m[2, 2]
    n[2, 2], n[3, 3] = m[1, 1] - m[0, 0] - m[2, 2], m[2, 2] - m[0, 0] - m[1, 1]
    n[0, 1], n[0, 2], n[0, 3] = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    n[1, 2], n[1, 3], n[2, 3] = m[1, 0] + m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2]
    vectors = np.eye(4)
    for _ in range(SWEEPS):
        for p in range(3):
            for q in range(p + 1, 4):
                if abs(n[p, q]) < 1e-300:
                    continue
                tau = (n[q, q] - n[p, p]) / (2 * n[p, q])
                t = (1.0 if tau >= 0 else -1.0) / (abs(tau) + np.sqrt(1 + tau * tau))
                c = 1 / np.sqrt(1 + t * t)
                s = t * c
                n[p, p] -= t * n[p, q]
                n[q, q] += t * n[p, q]
                n[p, q] = 0.0
                for r in range(4):
                    if r not in (p, q):
                        pr, qr = (min(p, r), max(p, r)), (min(q, r), max(q, r))
                        x, y = n[pr], n[qr]
                        n[pr], n[qr] = c * x - s * y, s * x + c * y
                    x, y = vectors[r, p], vectors[r, q]
                    vectors[r, p], vectors[r, q] = c * x - s * y, s * x + c * y
    best = 0
    for p in range(1, 4):
        if n[p, p] > n[best, best]:
            best = p
    w, x, y, z = vectors[0, best], vectors[1, best], vectors[2, best], vectors[3, best]
    rotation[0, 0], rotation[1, 1] = 1 - 2 * (y * y + z * z), 1 - 2 * (x * x + z * z)
    rotation[2, 2] = 1 - 2 * (x * x + y * y)
    rotation[0, 1], rotation[1, 0] = 2 * (x * y - w * z), 2 * (x * y + w * z)
    rotation[0, 2], rotation[2, 0] = 2 * (x * z + w * y), 2 * (x * z - w * y)
    rotation[1, 2], rotation[2, 1] = 2 * (y * z - w * x), 2 * (y * z + w * x)
