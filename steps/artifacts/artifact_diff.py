"""Numerical difference of two artifacts of the same format."""

import json
import math
import zipfile
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageSequence
from safetensors import SafetensorError
from safetensors.numpy import load

from dg4d_lib.assets.formats.gltf import GlbReader
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.ply import read_ply

TOLERANCE = 0.01  # of the range of values: 40 dB for pictures
FULL_SCALE = 255.0
FIELDS = ("means", "log_scales", "quats", "opacity_logits", "harmonics")  # of Gaussians
UNREADABLE = (OSError, SyntaxError, ValueError, IndexError, av.FFmpegError, SafetensorError)

Arrays = dict[str, NDArray[Any]]


def difference(one: Path, two: Path) -> float | None:
    """Return the largest difference of two files with the same suffix.

    All content is compared array by array: pixels, frames, vertices, textures, columns of Gaussians, tensors, numbers
    in JSON, and the entries of a zip. The difference of two arrays is the root mean square error of their values
    relative to the range of values: full scale for pictures, else the interval that the values of `one` and zero span.

    Returns:
        The largest difference; infinite if shapes, integers or texts differ; None for an unknown format.

    Raises:
        BadInput: a file is broken.
    """
    if one.suffix == ".zip":
        return _zips(one, two)
    if one.suffix not in READERS:
        return None
    first, second = _read(one), _read(two)
    if first.keys() != second.keys():
        return math.inf
    return max((_distance(first[name], second[name]) for name in first), default=0.0)


def _read(path: Path) -> Arrays:
    try:
        return READERS[path.suffix](path)
    except UNREADABLE as error:
        raise BadInput(f"{path.name} cannot be read: {error}") from error


def _distance(one: NDArray[Any], two: NDArray[Any]) -> float:
    if one.shape != two.shape or one.dtype != two.dtype:
        return math.inf
    if np.array_equal(one, two):
        return 0.0
    if one.dtype == np.uint8:
        scale = FULL_SCALE
    elif np.issubdtype(one.dtype, np.floating):
        scale = float(max(one.max(), 0) - min(one.min(), 0))
    else:
        return math.inf
    error = math.sqrt(float(np.mean((one.astype(np.float64) - two.astype(np.float64)) ** 2)))
    return error / scale if scale and math.isfinite(error) else math.inf


def _zips(one: Path, two: Path) -> float | None:
    """Return the largest difference of two zips' entries; None if entries of an unknown format differ."""
    known = [0.0]
    with zipfile.ZipFile(one) as first, zipfile.ZipFile(two) as second, TemporaryDirectory() as scratch:
        if sorted(first.namelist()) != sorted(second.namelist()):
            return math.inf
        for name in first.namelist():
            contents = first.read(name), second.read(name)
            if contents[0] == contents[1]:
                continue
            paths = [Path(scratch) / f"{which}{Path(name).suffix}" for which in ("one", "two")]
            for path, content in zip(paths, contents, strict=True):
                path.write_bytes(content)
            found = difference(*paths)
            if found is None:
                return None
            known.append(found)
    return max(known)


def _numbered(frames: list[NDArray[Any]]) -> Arrays:
    return {f"frame {number}": frame for number, frame in enumerate(frames)}


def _pixels(content: bytes) -> Arrays:
    """Decode every frame of a picture."""
    with Image.open(BytesIO(content)) as picture:
        return _numbered([np.asarray(frame.convert("RGBA")) for frame in ImageSequence.Iterator(picture)])


def _video(path: Path) -> Arrays:
    with av.open(str(path)) as video:
        return _numbered([frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)])


def _gaussians(path: Path) -> Arrays:
    gaussians = read_ply(path)
    return {name: getattr(gaussians, name).numpy() for name in FIELDS}


def _glb(path: Path) -> Arrays:
    """Return the accessors of a GLB, joined by type, and its pictures; their offsets in the file do not count."""
    parsed = GlbReader(path.read_bytes())
    rows = [parsed.accessor(i) for i in range(len(parsed.tree.get("accessors", ())))]
    types = dict.fromkeys((values.dtype, values.shape[1]) for values in rows)
    arrays: Arrays = {
        f"{dtype} x {width}": np.concatenate([r for r in rows if (r.dtype, r.shape[1]) == (dtype, width)])
        for dtype, width in types
    }
    for number, image in enumerate(parsed.tree.get("images", ())):
        pixels = _pixels(parsed.view(image["bufferView"]))
        arrays |= {f"image {number}, {frame}": values for frame, values in pixels.items()}
    return arrays


def _json(path: Path) -> Arrays:
    """Return the decimal fractions of a JSON file, and the rest as one text."""
    numbers: list[float] = []

    def keep(digits: str) -> str:
        numbers.append(float(digits))
        return "number"

    rest = json.loads(path.read_bytes(), parse_float=keep)
    return {"numbers": np.array(numbers), "rest": np.array([json.dumps(rest, sort_keys=True)])}


READERS: dict[str, Callable[[Path], Arrays]] = {
    ".png": lambda path: _pixels(path.read_bytes()),
    ".webp": lambda path: _pixels(path.read_bytes()),
    ".mp4": _video,
    ".ply": _gaussians,
    ".safetensors": lambda path: dict(load(path.read_bytes())),
    ".glb": _glb,
    ".json": _json,
}
