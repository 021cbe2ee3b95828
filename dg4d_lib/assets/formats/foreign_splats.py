"""Splats of other programs: 3DGS PLY with color of any degree, and SPZ of the versions 2 and 3.

Color of higher degrees is dropped: it would have to turn with the moving Gaussians.
"""

import gzip
import io
import struct
import zlib

import numpy as np
import torch
from numpy.typing import NDArray

from dg4d_lib.assets.formats.spz import LARGEST, MAGIC
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.ply import COLORS, MAX_HEADER, MEANS, OPACITY, QUATS, SCALES, parse_header

SPZ_HEADER = 16  # bytes
SH_COUNT = {0: 0, 1: 3, 2: 8, 3: 15}  # coefficients per channel beyond degree 0
HIGHER = "color of higher degrees was dropped: the splats keep their base color"


def read_foreign_ply(content: bytes, max_splats: int) -> tuple[Gaussians, tuple[str, ...]]:
    """Read splats; return them with notes.

    Raises:
        BadInput: the file is no splat PLY, lacks color, has too many splats or numbers that are not finite.
    """
    count, dtype, start = parse_header("the model", content[:MAX_HEADER])
    names = dtype.names or ()
    if not set(COLORS) <= set(names):
        raise BadInput(
            "the PLY has no splat colors (f_dc_0, f_dc_1, f_dc_2); give splats with color, or a mesh as GLB, OBJ or "
            "USDZ"
        )
    if missing := [name for name in (*MEANS, *OPACITY, *SCALES, *QUATS) if name not in names]:
        raise BadInput(f"the PLY holds no splats: it lacks {', '.join(missing)}; give a mesh as GLB, OBJ or USDZ")
    _check_count(count, max_splats)
    if len(content) < start + count * dtype.itemsize:
        raise BadInput("the PLY is truncated; export it again")
    rows = np.frombuffer(content, dtype, count, start)

    def columns(fields: tuple[str, ...]) -> NDArray[np.float32]:
        return np.stack([rows[name] for name in fields], 1).astype(np.float32)

    notes = (HIGHER,) if any(name.startswith("f_rest_") for name in names) else ()
    return _cloud(*map(columns, (MEANS, SCALES, QUATS, OPACITY, COLORS))), notes


def read_spz(content: bytes, max_splats: int) -> tuple[Gaussians, tuple[str, ...]]:
    """Read splats; return them with notes.

    Raises:
        BadInput: the file is no SPZ of version 2 or 3, is truncated, or has too many splats.
    """
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(content)) as stream:
            header = stream.read(SPZ_HEADER)
            magic, version, count, degree, bits, _, _ = struct.unpack("<4sIIBBBB", header)
            if magic != MAGIC or version not in (2, 3) or degree not in SH_COUNT:
                raise BadInput("the file is no SPZ of version 2 or 3; export the splats as PLY")
            _check_count(count, max_splats)
            sizes = (9, 1, 3, 3, 4 if version == 3 else 3)
            parts = [np.frombuffer(stream.read(size * count), np.uint8).reshape(count, size) for size in sizes]
    except (OSError, EOFError, zlib.error, struct.error, ValueError) as error:
        raise BadInput(f"the SPZ is broken ({error}); export the splats again") from error
    places, alphas, colors, scales, turns = parts
    words = np.zeros((count, 3, 4), np.uint8)
    words[..., 1:] = places.reshape(count, 3, 3)  # the sign is in the highest byte
    means = (words.view("<i4")[..., 0] >> 8) / 2**bits
    share = (alphas.astype(np.float64) / 255).clip(1e-4, 1 - 1e-4)
    quats = _smallest_three(turns) if version == 3 else _first_three(turns)
    cloud = _cloud(means, scales / 16 - 10.0, quats, np.log(share / (1 - share)), (colors / 255 - 0.5) / 0.15)
    return cloud, (HIGHER,) if degree else ()


def _check_count(count: int, max_splats: int) -> None:
    if count < 4:
        raise BadInput(f"the file holds {count} splats; at least 4 are needed")
    if count > max_splats:
        raise BadInput(
            f"the file holds {count} splats; asset.max_splats allows {max_splats}: reduce them, or raise the limit "
            f"with --set asset.max_splats={count}"
        )


def _cloud(
    means: NDArray[np.floating],
    log_scales: NDArray[np.floating],
    quats: NDArray[np.floating],
    opacity: NDArray[np.floating],
    colors: NDArray[np.floating],
) -> Gaussians:
    parts = [torch.from_numpy(np.array(values, np.float32)) for values in (means, log_scales, quats, opacity, colors)]
    if not all(part.isfinite().all() for part in parts):
        raise BadInput("the splats have numbers that are not finite (NaN or infinity); export them again")
    if not (parts[2].norm(dim=1) > 0).all():
        raise BadInput("some splats have a rotation of length 0; export them again")
    return Gaussians(parts[0], parts[1], parts[2], parts[3][:, 0], parts[4][:, None])


def _smallest_three(packed: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Decode rotations of version 3 (`dg4d_lib.assets.formats.spz`); return wxyz."""
    values = np.ascontiguousarray(packed).view("<u4")[:, 0].astype(np.int64)
    largest = values >> 30
    fields = np.stack([values >> shift & 0x3FF for shift in (20, 10, 0)], 1)
    small = (fields & 0x1FF) / LARGEST / np.sqrt(2) * np.where(fields & 0x200, -1, 1)
    quats = np.zeros((len(values), 4))
    quats[np.arange(4) != largest[:, None]] = small.ravel()
    quats[np.arange(len(values)), largest] = np.sqrt((1 - np.square(small).sum(1)).clip(0))
    return np.roll(quats, 1, axis=1)


def _first_three(packed: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Decode rotations of version 2, x y z in 8 bits with w positive; return wxyz."""
    xyz = packed / 127.5 - 1
    return np.concatenate([np.sqrt((1 - np.square(xyz).sum(1, keepdims=True)).clip(1e-12)), xyz], 1)
