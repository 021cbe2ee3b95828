"""Splats of other programs: 3DGS PLY with color of any degree, SuperSplat's compressed PLY, and SPZ of versions 2 to 4.

Color of higher degrees is dropped: it would have to turn with the moving Gaussians.
"""

import gzip
import io
import struct
import zlib
from typing import Any

import numpy as np
import torch
import zstandard
from numpy.typing import NDArray

from dg4d_lib.assets.formats.spz import LARGEST, MAGIC, SPZ4_HEADER
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.ply import (
    COLORS,
    MAX_HEADER,
    MEANS,
    OPACITY,
    QUATS,
    SCALES,
    header_text,
    parse_elements,
    parse_header,
)
from dg4d_lib.geometry.spherical_harmonics import C0

SPZ_HEADER = 16  # bytes, of the versions 2 and 3
HIGHEST_DEGREE = 4  # of color in an SPZ
MOST = 2_000_000  # splats that are read
MIN_LOG_SCALE, MAX_LOGIT = -20.0, 20.0  # limits of splats; larger values look the same
CHUNK = 256  # splats of a compressed PLY that share bounds
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
HIGHER = "color of higher degrees was dropped: the splats keep their base color"


def read_foreign_ply(content: bytes, most: int = MOST) -> tuple[Gaussians, tuple[str, ...]]:
    """Read splats; return them with notes.

    Raises:
        BadInput: the file is not a splat PLY, lacks color, has too many splats or numbers that are not finite.
    """
    header = header_text(content)
    if b"\nelement chunk " in header:
        return _read_compressed_ply(content, most)
    if header and not {name.encode() for name in COLORS} <= set(header.split()):
        raise BadInput(
            "the PLY has no faces and no splat colors (f_dc_0, f_dc_1, f_dc_2), and points alone cannot be animated; "
            "give splats with color, or a mesh"
        )
    count, dtype, start = parse_header("the model", content[:MAX_HEADER])
    names = dtype.names or ()
    if missing := [name for name in (*MEANS, *OPACITY, *SCALES, *QUATS) if name not in names]:
        raise BadInput(f"the PLY holds no splats: it lacks {', '.join(missing)}; give splats, or a mesh with faces")
    _check_count(count, most)
    if len(content) < start + count * dtype.itemsize:
        raise BadInput("the PLY is truncated; export it again")
    rows = np.frombuffer(content, dtype, count, start)

    def columns(fields: tuple[str, ...]) -> NDArray[np.float32]:
        return np.stack([rows[name] for name in fields], 1).astype(np.float32)

    notes = (HIGHER,) if any(name.startswith("f_rest_") for name in names) else ()
    return _cloud(columns(MEANS), columns(SCALES), columns(QUATS), columns(OPACITY), columns(COLORS), notes)


def read_spz(content: bytes, most: int = MOST) -> tuple[Gaussians, tuple[str, ...]]:
    """Read splats; return them with notes.

    Raises:
        BadInput: the file is not an SPZ of the versions 2 to 4, is truncated, or has too many splats.
    """
    try:
        with io.BytesIO(content) if content.startswith(MAGIC) else gzip.GzipFile(fileobj=io.BytesIO(content)) as stream:
            magic, version, count, degree, bits, _, streams = struct.unpack("<4sIIBBBB", stream.read(SPZ_HEADER))
            if magic != MAGIC or version not in (2, 3, 4) or degree > HIGHEST_DEGREE:
                raise BadInput("the file is not an SPZ of version 2, 3 or 4; export the splats as PLY")
            _check_count(count, most)
            sizes = (9, 1, 3, 3, 3 if version == 2 else 4)
            sections = (
                _spz4_sections(content, streams, [size * count for size in sizes])
                if version == 4
                else [stream.read(size * count) for size in sizes]
            )
            parts = [
                np.frombuffer(section, np.uint8).reshape(count, size)
                for section, size in zip(sections, sizes, strict=True)
            ]
    except (OSError, EOFError, zlib.error, zstandard.ZstdError, struct.error, ValueError) as error:
        raise BadInput(f"the SPZ is broken ({error}); export the splats again") from error
    places, alphas, colors, scales, turns = parts
    words = np.zeros((count, 3, 4), np.uint8)
    words[..., 1:] = places.reshape(count, 3, 3)  # the sign is in the highest byte
    means = (words.view("<i4")[..., 0] >> 8) / 2**bits
    quats = _first_three(turns) if version == 2 else _smallest_three(turns)
    notes = (HIGHER,) if degree else ()
    return _cloud(means, scales / 16 - 10.0, quats, _logits(alphas / 255), (colors / 255 - 0.5) / 0.15, notes)


def _spz4_sections(content: bytes, streams: int, sizes: list[int]) -> list[bytes]:
    """Return the first sections of version 4, each a Zstandard frame; a table has their sizes."""
    (table,) = struct.unpack_from("<I", content, SPZ_HEADER)
    if streams < len(sizes) or table < SPZ4_HEADER:
        raise ValueError(f"{streams} streams, with a table at byte {table}")
    start, sections = table + 16 * streams, []
    for number, size in enumerate(sizes):
        packed, unpacked = struct.unpack_from("<QQ", content, table + 16 * number)
        if unpacked != size or start + packed > len(content):
            raise ValueError(f"stream {number} has {unpacked} bytes, expected {size}")
        frame = content[start : start + packed]
        if zstandard.frame_content_size(frame) not in (-1, size):  # -1: not said, and bounded by the next line
            raise ValueError(f"stream {number} unpacks to more bytes than expected")
        sections.append(zstandard.ZstdDecompressor().decompress(frame, max_output_size=size))
        start += packed
    return sections


def _read_compressed_ply(content: bytes, most: int) -> tuple[Gaussians, tuple[str, ...]]:
    """Read SuperSplat's compressed PLY: integers between the bounds of each 256 splats."""
    elements, start = parse_elements("the model", content[:MAX_HEADER])
    rows: dict[str, NDArray[Any]] = {}
    for kind, count, dtype in elements:
        if len(content) < start + count * dtype.itemsize:
            raise BadInput("the PLY is truncated; export it again")
        rows[kind] = np.frombuffer(content, dtype, count, start)
        start += count * dtype.itemsize
    nothing: NDArray[Any] = np.empty(0)
    bounds, splats = rows.get("chunk", nothing), rows.get("vertex", nothing)
    if not set(PACKED) <= set(splats.dtype.names or ()):
        raise BadInput(f"the compressed PLY lacks {', '.join(PACKED)}; export the splats as an uncompressed PLY")
    _check_count(len(splats), most)
    chunk = np.arange(len(splats)) // CHUNK
    if chunk[-1] >= len(bounds):
        raise BadInput(f"the PLY has {len(bounds)} chunks of {CHUNK} for {len(splats)} splats; export it again")

    def between(names: tuple[str, ...], share: NDArray[np.float64]) -> NDArray[np.float64]:
        low, high = (np.stack([bounds[f"{end}_{name}"] for name in names], 1)[chunk] for end in ("min", "max"))
        return low + (high - low) * share

    place, turn, size, color = (splats[name].astype(np.int64) for name in PACKED)
    rgba = _fields(color, (24, 16, 8, 0), 8)
    try:
        means = between(("x", "y", "z"), _thirds(place))
        scales = between(("scale_x", "scale_y", "scale_z"), _thirds(size))
        colors = between(("r", "g", "b"), rgba[:, :3]) if "min_r" in (bounds.dtype.names or ()) else rgba[:, :3]
    except (IndexError, ValueError) as error:
        raise BadInput(f"the chunks of the compressed PLY lack bounds: {error}; export it again") from error
    small = (_fields(turn, (20, 10, 0), 10) - 0.5) * np.sqrt(2)
    quats = _with_largest(small, turn >> 30)
    notes = (HIGHER,) if "sh" in rows else ()
    return _cloud(means, scales, quats, _logits(rgba[:, 3:]), (colors - 0.5) / C0, notes)


def _fields(words: NDArray[np.int64], shifts: tuple[int, ...], bits: int) -> NDArray[np.float64]:
    """Return bit fields of the words as shares of their largest value, in [0, 1]."""
    largest = (1 << bits) - 1
    shares: NDArray[np.float64] = np.stack([words >> shift & largest for shift in shifts], 1) / largest
    return shares


def _thirds(words: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return three fields of 11, 10 and 11 bits, in [0, 1]."""
    return np.concatenate([_fields(words, (21,), 11), _fields(words, (11,), 10), _fields(words, (0,), 11)], 1)


def _logits(opacities: NDArray[np.floating]) -> NDArray[np.float64]:
    share = opacities.astype(np.float64).clip(1e-4, 1 - 1e-4)
    logits: NDArray[np.float64] = np.log(share / (1 - share))
    return logits


def _check_count(count: int, most: int) -> None:
    if count < 4:
        raise BadInput(f"the file holds {count} splats; at least 4 are needed")
    if count > most:
        raise BadInput(f"the file holds {count} splats; at most {most} can be read: reduce them")


def _cloud(
    means: NDArray[np.floating],
    log_scales: NDArray[np.floating],
    quats: NDArray[np.floating],
    opacity: NDArray[np.floating],
    colors: NDArray[np.floating],
    notes: tuple[str, ...],
) -> tuple[Gaussians, tuple[str, ...]]:
    """Return splats and notes; opacities and scales are limited, and rotations of length 0 become the identity.

    Programs write opacities of 0 and 1 as infinite logits, and flat splats with a scale of 0.
    """
    parts = [torch.from_numpy(np.array(values, np.float32)) for values in (means, log_scales, quats, opacity, colors)]
    unturned = parts[2].norm(dim=1) == 0
    changed = (parts[1] < MIN_LOG_SCALE).any(1) | (parts[3][:, 0].abs() > MAX_LOGIT) | unturned
    parts[1].clamp_(min=MIN_LOG_SCALE)
    parts[2][unturned] = torch.tensor((1.0, 0.0, 0.0, 0.0))
    parts[3].clamp_(-MAX_LOGIT, MAX_LOGIT)
    if not all(part.isfinite().all() for part in parts):
        raise BadInput("the splats have numbers that are not finite (NaN or infinity); export them again")
    if changed.any():
        notes += (
            f"{int(changed.sum())} splats had an extreme opacity or size, or no rotation; these values were replaced",
        )
    return Gaussians(parts[0], parts[1], parts[2], parts[3][:, 0], parts[4][:, None]), notes


def _smallest_three(packed: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Decode rotations of version 3 (`dg4d_lib.assets.formats.spz`); return wxyz."""
    values = np.ascontiguousarray(packed).view("<u4")[:, 0].astype(np.int64)
    largest = values >> 30
    fields = np.stack([values >> shift & 0x3FF for shift in (20, 10, 0)], 1)
    small = (fields & 0x1FF) / LARGEST / np.sqrt(2) * np.where(fields & 0x200, -1, 1)
    return np.roll(_with_largest(small, largest), 1, axis=1)


def _with_largest(small: NDArray[np.float64], largest: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return unit quaternions with their largest component, which the unit norm determines, put in at its index."""
    quats = np.zeros((len(small), 4))
    quats[np.arange(4) != largest[:, None]] = small.ravel()
    quats[np.arange(len(small)), largest] = np.sqrt((1 - np.square(small).sum(1)).clip(0))
    return quats


def _first_three(packed: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Decode rotations of version 2, x y z in 8 bits with w positive; return wxyz."""
    xyz = packed / 127.5 - 1
    return np.concatenate([np.sqrt((1 - np.square(xyz).sum(1, keepdims=True)).clip(1e-12)), xyz], 1)
