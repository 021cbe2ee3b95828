"""Splats in a sixth of the bytes: SPZ, the quantized format of Niantic (version 3: one gzip stream).

A header of 16 bytes, then all positions, opacities, colors, scales and rotations, each as whole numbers. Its axes are
ours (x right, y up, z towards the viewer), so nothing is turned.
"""

import gzip
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray

from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.ply import check_storable

MAGIC, VERSION = b"NGSP", 3
FRACTION_BITS = 12  # of positions, as other writers choose; with more, the steps of the scales decide the error
FARTHEST = (2**23 - 1) / 2**FRACTION_BITS  # world units: 24 bits with a sign
LEVEL = 9  # of gzip
LARGEST = 2**9 - 1  # the size of a small component of a rotation, without its sign


def write_spz(path: Path, gaussians: Gaussians) -> None:
    """Write one cloud (no leading batch, color of degree 0); equal clouds give equal bytes.

    What comes back differs by no more than 1/8192 world units in positions, 1/32 in the logarithms of scales (3 %;
    they end at -10 and 5.94), 1/510 in opacities, 1/76 in harmonics (0.4 % of the full range of color, which ends at
    -0.44 and 1.44) and a rotation of 0.3 degrees.

    Raises:
        BadInput: a batch, color of a higher degree, numbers that are not finite, or a center 2048 units away.
        OSError: the file could not be written.
    """
    check_storable(gaussians, "an SPZ")
    means, log_scales, harmonics = (_array(x) for x in (gaussians.means, gaussians.log_scales, gaussians.harmonics))
    if np.abs(means).max(initial=0.0) > FARTHEST:
        raise BadInput(f"an SPZ holds centers within {FARTHEST:.0f} world units; given {np.abs(means).max():.4g}")
    sections = (
        np.rint(means * 2**FRACTION_BITS).astype("<i4")[..., None].view(np.uint8)[..., :3],
        _bytes(255 * _array(gaussians.opacities)),
        _bytes(255 * (0.15 * harmonics + 0.5)),
        _bytes(16 * (log_scales + 10)),
        _smallest_three(_array(gaussians.quats)),
    )
    header = struct.pack("<4sIIBBBB", MAGIC, VERSION, len(gaussians), 0, FRACTION_BITS, 0, 0)
    content = header + b"".join(section.tobytes() for section in sections)
    path.write_bytes(gzip.compress(content, LEVEL, mtime=0))


def _array(values: torch.Tensor) -> NDArray[Any]:
    return values.detach().cpu().double().numpy()


def _bytes(values: NDArray[Any]) -> NDArray[np.uint8]:
    return np.rint(values).clip(0, 255).astype(np.uint8)


def _smallest_three(quats: Float[np.ndarray, "n 4"]) -> UInt8[np.ndarray, "n 4"]:
    """Rotations as 32 bits: which of x, y, z, w is the largest (2), then the others as a sign and a size (1 + 9).

    The largest is made positive and left out: the length of the quaternion gives it.
    """
    unit = np.roll(quats, -1, axis=1) / np.linalg.norm(quats, axis=1, keepdims=True)
    rows, largest = np.arange(len(unit)), np.abs(unit).argmax(1)
    unit *= np.where(unit[rows, largest] < 0, -1, 1)[:, None]
    small = unit[np.arange(4) != largest[:, None]].reshape(-1, 3)
    sizes = np.rint(np.abs(small) * math.sqrt(2) * LARGEST).clip(max=LARGEST).astype("<u4")
    first, second, third = ((sizes | np.where(small < 0, 1 << 9, 0)).astype("<u4")).T
    packed = largest.astype("<u4") << 30 | first << 20 | second << 10 | third
    return packed.astype("<u4")[:, None].view(np.uint8)
