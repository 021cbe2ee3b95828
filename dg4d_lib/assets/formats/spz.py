"""SPZ writer: Niantic's quantized splat format (version 3, one gzip stream), a sixth of the size of a PLY.

A header of 16 bytes is followed by all positions, opacities, colors, scales and rotations as integers. The axes equal
ours (x right, y up, z towards the viewer).
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
FRACTION_BITS = 12  # of positions, as in other writers; with more bits, the error of the scales dominates
FARTHEST = (2**23 - 1) / 2**FRACTION_BITS  # world units; positions are signed 24-bit integers
LEVEL = 9  # of gzip
LARGEST = 2**9 - 1  # largest magnitude of a quantized quaternion component, without its sign


def write_spz(path: Path, gaussians: Gaussians) -> None:
    """Write one cloud (no leading batch, color of degree 0); equal clouds give equal bytes.

    Quantization errors are at most 1/8192 world units in positions, 1/32 in log scales (3 %; range -10 to 5.94), 1/510
    in opacities, 1/76 in harmonics (0.4 % of the range of colors, -0.44 to 1.44) and 0.3 degrees in rotations.

    Raises:
        BadInput: a batch, color of a higher degree, numbers that are not finite, or a mean 2048 units away.
        OSError: the file could not be written.
    """
    check_storable(gaussians, "an SPZ")
    means, log_scales, harmonics = (_array(x) for x in (gaussians.means, gaussians.log_scales, gaussians.harmonics))
    if np.abs(means).max(initial=0.0) > FARTHEST:
        raise BadInput(
            f"an SPZ stores means within {FARTHEST:.0f} world units; given {np.abs(means).max():.4g}: "
            "scale the cloud down, or set pack.spz=false"
        )
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
    """Encode rotations in 32 bits: index of the largest of x, y, z, w (2), sign and magnitude of the others (1 + 9).

    The largest component is made positive and omitted; the unit norm determines it.
    """
    unit = np.roll(quats, -1, axis=1) / np.linalg.norm(quats, axis=1, keepdims=True)
    rows, largest = np.arange(len(unit)), np.abs(unit).argmax(1)
    unit *= np.where(unit[rows, largest] < 0, -1, 1)[:, None]
    small = unit[np.arange(4) != largest[:, None]].reshape(-1, 3)
    sizes = np.rint(np.abs(small) * math.sqrt(2) * LARGEST).clip(max=LARGEST).astype("<u4")
    first, second, third = ((sizes | np.where(small < 0, 1 << 9, 0)).astype("<u4")).T
    packed = largest.astype("<u4") << 30 | first << 20 | second << 10 | third
    return packed.astype("<u4")[:, None].view(np.uint8)
