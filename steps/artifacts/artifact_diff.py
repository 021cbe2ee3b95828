"""How far two artifacts of one kind are apart, in numbers."""

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

Arrays = dict[str, NDArray[Any]]


def difference(one: Path, two: Path) -> float | None:
    """How far two files of one suffix are apart.

    Everything that a file holds is compared array by array: pixels, frames, vertices, texture, the columns of a cloud,
    tensors, numbers in JSON, and the entries of a zip. The difference of two arrays is the root mean square of the
    differences of their values, as a share of the range of values: full scale for pictures, else what the values of
    `one` and zero span.

    Returns:
        The largest of these; infinite where shapes, whole numbers or texts differ; None where nothing is known about
        the format.

    Raises:
        BadInput: a file is broken.
    """
    if one.suffix == ".zip":
        return _zips(one, two)
    read = READERS.get(one.suffix)
    if read is None:
        return None
    first, second = read(one), read(two)
    if first.keys() != second.keys():
        return math.inf
    return max((_distance(first[name], second[name]) for name in first), default=0.0)


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
    """The largest difference of the entries; None if it would be of an entry about which nothing is known."""
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


def _pixels(path: Path) -> Arrays:
    """Every frame of a picture, animated or not."""
    return _decoded(path.read_bytes(), path.name)


def _decoded(content: bytes, name: str) -> Arrays:
    try:
        with Image.open(BytesIO(content)) as picture:
            frames = [np.asarray(frame.convert("RGBA")) for frame in ImageSequence.Iterator(picture)]
    except (OSError, SyntaxError, ValueError) as error:
        raise BadInput(f"{name} is no picture that can be read: {error}") from error
    return {f"frame {number}": frame for number, frame in enumerate(frames)}


def _film(path: Path) -> Arrays:
    try:
        with av.open(str(path)) as film:
            frames = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    except (av.FFmpegError, IndexError) as error:
        raise BadInput(f"{path.name} is no film that can be read: {error}") from error
    return {f"frame {number}": frame for number, frame in enumerate(frames)}


def _cloud(path: Path) -> Arrays:
    cloud = read_ply(path)
    fields = ("means", "log_scales", "quats", "opacity_logits", "harmonics")
    return {name: getattr(cloud, name).numpy() for name in fields}


def _tensors(path: Path) -> Arrays:
    try:
        return dict(load(path.read_bytes()))
    except SafetensorError as error:
        raise BadInput(f"{path.name} holds no tensors that can be read: {error}") from error


def _asset(path: Path) -> Arrays:
    """The rows of numbers of a GLB, all of one type together, and its pictures; places in the file do not count."""
    parsed = GlbReader(path.read_bytes())
    rows = [parsed.accessor(i) for i in range(len(parsed.tree.get("accessors", ())))]
    types = dict.fromkeys((values.dtype, values.shape[1]) for values in rows)
    arrays: Arrays = {
        f"{dtype} x {width}": np.concatenate([r for r in rows if (r.dtype, r.shape[1]) == (dtype, width)])
        for dtype, width in types
    }
    for number, image in enumerate(parsed.tree.get("images", ())):
        pixels = _decoded(parsed.view(image["bufferView"]), path.name)
        arrays |= {f"image {number}, {frame}": values for frame, values in pixels.items()}
    return arrays


def _numbers(path: Path) -> Arrays:
    """The broken numbers of a JSON file, and all the rest as one text."""
    numbers: list[float] = []

    def keep(digits: str) -> str:
        numbers.append(float(digits))
        return "number"

    try:
        rest = json.loads(path.read_bytes(), parse_float=keep)
    except ValueError as error:
        raise BadInput(f"{path.name} is no JSON: {error}") from error
    return {"numbers": np.array(numbers), "rest": np.array([json.dumps(rest, sort_keys=True)])}


READERS: dict[str, Callable[[Path], Arrays]] = {
    ".png": _pixels,
    ".webp": _pixels,
    ".mp4": _film,
    ".ply": _cloud,
    ".safetensors": _tensors,
    ".glb": _asset,
    ".json": _numbers,
}
