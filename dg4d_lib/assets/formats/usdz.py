"""USDZ container: an uncompressed zip with fixed dates, the layer first, and files aligned to 64 bytes."""

import io
import struct
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from pxr import Sdf, Tf, Usd

from dg4d_lib.errors import BadInput

ALIGNMENT = 64  # bytes; alignment of every file's content (USDZ specification)
HEADER = 30  # bytes of a local file header before the name
EXTRA_HEADER = 4  # bytes of an extra field before its content
PADDING = 0x1986  # id of the extra field that OpenUSD uses for padding
MAX_ENTRIES = 1000
SAME_KEY = 0.01  # time codes, below the distance of any two keys; times of a GLB have single precision
UNIX = 3  # "created by" system of the zip, fixed so that all platforms write equal bytes


def write_usdz_package(path: Path, stage: Usd.Stage, layer: str, files: Mapping[str, bytes]) -> None:
    """Write a stage's root layer and its files as USDZ; equal input gives equal bytes.

    Args:
        path: output file, `.usdz`.
        stage: stage whose root layer refers to `files` by paths relative to the package.
        layer: name of the root layer in the package, `.usdc`.
        files: contents by name in the package.

    Raises:
        OSError: the file could not be written.
    """
    with TemporaryDirectory() as scratch:
        entries = {layer: _encode(stage.GetRootLayer(), Path(scratch), layer), **files}
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_STORED) as package:
        for name, data in entries.items():
            entry = zipfile.ZipInfo(name)
            entry.create_system = UNIX
            free = -(content.tell() + HEADER + len(name.encode()) + EXTRA_HEADER) % ALIGNMENT
            entry.extra = struct.pack(f"<HH{free}x", PADDING, free)
            package.writestr(entry, data)
    path.write_bytes(content.getvalue())


class UsdzPackage:
    """USDZ file in memory.

    Attributes:
        files: contents by name; the first is the root layer.
        layer: name of the root layer.
        fps: time codes per second.
        duration_s: time of the last time code, seconds.
    """

    def __init__(self, path: Path, hold_s: float | None = None) -> None:
        """Read a USDZ.

        Args:
            path: of the file.
            hold_s: time of the last key that is kept, seconds; readers hold its pose afterwards. None: all keys.

        Raises:
            BadInput: the file is missing, not a USDZ, has entries that `check_entries` refuses or names that lead
                outside of it, or has no default prim.
        """
        try:
            with zipfile.ZipFile(path) as package:
                check_entries(package.infolist(), path.stat().st_size, str(path))
                _check_names(path, package.namelist())
                self.files = {name: package.read(name) for name in package.namelist()}
            stage = Usd.Stage.Open(str(path))
        except OSError as error:
            raise BadInput(f"{path} cannot be read: {error.strerror}") from error
        except (zipfile.BadZipFile, Tf.ErrorException) as error:
            raise BadInput(f"{path} is not a USDZ; give a file that dg4d wrote: {error}".strip()) from error
        if not stage.HasDefaultPrim():
            raise BadInput(f"{path} has no default prim, so a scene cannot refer to it; give a file that dg4d wrote")
        self.layer = next(iter(self.files))
        self.fps: float = stage.GetTimeCodesPerSecond()
        self.duration_s: float = stage.GetEndTimeCode() / self.fps
        if hold_s is not None:
            self.files[self.layer] = _layer_until(stage.GetRootLayer(), hold_s * self.fps, self.layer)


def check_entries(entries: Sequence[zipfile.ZipInfo], size: int, what: str) -> None:
    """Refuse compressed or overlapping entries, with which a small file unpacks to any size, and too many.

    Args:
        entries: of the archive.
        size: of the file, bytes.
        what: the file, for messages.

    Raises:
        BadInput: says why.
    """
    if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
        raise BadInput(f"{what} has compressed entries, which USDZ forbids; export it again")
    inside = sum(entry.file_size for entry in entries)
    if len(entries) > MAX_ENTRIES or inside > size:
        raise BadInput(
            f"{what} declares {len(entries)} files with {inside} bytes in {size} bytes of archive; at most "
            f"{MAX_ENTRIES} files without overlap are read: export it again"
        )


def _check_names(path: Path, names: Sequence[str]) -> None:
    """Refuse names of entries that lead outside of the package."""
    for name in names:
        if {"", ".", ".."} & set(name.split("/")) or "\\" in name:
            raise BadInput(f"{path} has an entry outside of itself, {name!r}; give a file that dg4d wrote")


def _layer_until(layer: Sdf.Layer, end: float, name: str) -> bytes:
    """Encode a layer without the keys after a time code."""
    shortened = Sdf.Layer.CreateAnonymous(name)
    shortened.TransferContent(layer)
    paths: list[Sdf.Path] = []
    shortened.Traverse(Sdf.Path.absoluteRootPath, paths.append)
    for path in paths:
        for key in shortened.ListTimeSamplesForPath(path):
            if key > end + SAME_KEY:
                shortened.EraseTimeSample(path, key)
    with TemporaryDirectory() as scratch:
        return _encode(shortened, Path(scratch), name)


def _encode(layer: Sdf.Layer, scratch: Path, name: str) -> bytes:
    """Return the content of a layer's file; the suffix of its name selects the format."""
    file = scratch / f"layer{Path(name).suffix}"
    layer.Export(str(file))
    return file.read_bytes()
