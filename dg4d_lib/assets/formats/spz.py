"""SPZ writer: Niantic's quantized splat format, in version 3 a sixth of the size of a PLY.

All positions, opacities, colors, scales and rotations are integers, in this order. Version 3 is one gzip stream of a
header of 16 bytes and these sections. Version 4 has a header of 32 bytes, a table of the sizes of its streams, and a
Zstandard frame per section. The axes equal ours (x right, y up, z towards the viewer).
"""

import gzip
import math
import struct
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import zstandard
from jaxtyping import Float, UInt8
from numpy.typing import NDArray

from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.ply import check_storable

SpzVersion = Literal[3, 4]

MAGIC = b"NGSP"
FRACTION_BITS = 12  # of positions, as in other writers; with more bits, the error of the scales dominates
SMALL = 0.5  # meters; smaller clouds get more bits, so that positions remain as exact relative to their size
MAX_BITS = 20
LARGEST_POSITION = 2**23 - 1  # positions are signed 24-bit integers
SPZ4_HEADER = 32  # bytes
LEVEL, ZSTD_LEVEL = 9, 19  # of gzip and of Zstandard
MIN_LOG_SCALE = -10  # smaller scales become this, 0.045 mm
THICKENED, MANY = 0.1, 0.01  # growth of a splat, relative to its largest scale, and share of such splats worth a note
LARGEST = 2**9 - 1  # largest magnitude of a quantized quaternion component, without its sign


def write_spz(path: Path, gaussians: Gaussians, version: SpzVersion = 3) -> None:
    """Write one cloud (no leading batch, color of degree 0); equal clouds give equal bytes.

    Quantization errors are at most 1/8192 meters in positions (less in small clouds), 1/32 in log scales (3 %; range
    -10 to 5.94), 1/510 in opacities, 1/76 in harmonics (0.4 % of the range of colors, -0.44 to 1.44) and 0.3 degrees in
    rotations.

    Raises:
        BadInput: a batch, color of a higher degree, numbers that are not finite, or a mean 2048 meters away.
        OSError: the file could not be written.
    """
    check_storable(gaussians, "an SPZ")
    means, log_scales, harmonics = (_array(x) for x in (gaussians.means, gaussians.log_scales, gaussians.harmonics))
    farthest = float(np.abs(means).max(initial=0.0))
    bits = FRACTION_BITS + max(0, math.ceil(math.log2(SMALL / farthest))) if farthest > 0 else FRACTION_BITS
    bits = min(bits, MAX_BITS)
    if farthest * 2**bits > LARGEST_POSITION:
        raise BadInput(
            f"an SPZ stores means within {LARGEST_POSITION / 2**bits:.0f} meters; given {farthest:.4g}: "
            "lower pack.height_m, or set pack.spz=false"
        )
    sections = (
        np.rint(means * 2**bits).astype("<i4")[..., None].view(np.uint8)[..., :3],
        _bytes(255 * _array(gaussians.opacities)),
        _bytes(255 * (0.15 * harmonics + 0.5)),
        _bytes(16 * (log_scales - MIN_LOG_SCALE)),
        _smallest_three(_array(gaussians.quats)),
    )
    streams = [section.tobytes() for section in sections]
    common = struct.pack("<4sIIBBB", MAGIC, version, len(gaussians), 0, bits, 0)
    if version == 3:
        path.write_bytes(gzip.compress(common + bytes(1) + b"".join(streams), LEVEL, mtime=0))
        return
    frames = [zstandard.ZstdCompressor(ZSTD_LEVEL).compress(stream) for stream in streams]
    table = b"".join(struct.pack("<QQ", len(frame), len(stream)) for frame, stream in zip(frames, streams, strict=True))
    header = common + struct.pack("<BI12x", len(streams), SPZ4_HEADER)
    path.write_bytes(header + table + b"".join(frames))


def scale_notes(states: Gaussians) -> tuple[str, ...]:
    """Return a note if many splats are too small for SPZ; thin axes of large splats do not count."""
    scales = states.scales
    growth = (math.exp(MIN_LOG_SCALE) - scales).amax(-1) / scales.amax(-1)
    share = float((growth > THICKENED).double().mean())
    if share < MANY:
        return ()
    return (
        f"{share:.0%} of the splats are more than {THICKENED:.0%} too thick in the SPZ files, whose smallest scale is "
        f"{1000 * math.exp(MIN_LOG_SCALE):.2g} mm; raise pack.height_m, or set pack.spz=false",
    )


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
