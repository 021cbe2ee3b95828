"""USDZ container: an uncompressed zip with fixed dates, the layer first, and files aligned to 64 bytes."""

import io
import struct
import zipfile
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

from pxr import Tf, Usd

from dg4d_lib.errors import BadInput

ALIGNMENT = 64  # bytes; alignment of every file's content (USDZ specification)
HEADER = 30  # bytes of a local file header before the name
EXTRA_HEADER = 4  # bytes of an extra field before its content
PADDING = 0x1986  # id of the extra field that OpenUSD uses for padding
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
        file = Path(scratch) / layer
        stage.GetRootLayer().Export(str(file))
        entries = {layer: file.read_bytes(), **files}
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

    def __init__(self, path: Path) -> None:
        """Read a USDZ.

        Raises:
            BadInput: the file is missing, not a USDZ, or has no default prim.
        """
        try:
            with zipfile.ZipFile(path) as package:
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
