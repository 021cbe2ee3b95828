"""The USDZ container: a stored zip with fixed dates, a layer first, and every file at a multiple of 64 bytes."""

import io
import struct
import zipfile
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

from pxr import Tf, Usd

from dg4d_lib.errors import BadInput

ALIGNMENT = 64  # bytes; the content of every file begins at a multiple (USDZ specification)
HEADER = 30  # bytes of a local file header before the name
EXTRA_HEADER = 4  # bytes of an extra field before its content
PADDING = 0x1986  # the kind of extra field with which OpenUSD fills up to the next multiple
UNIX = 3  # the system that made the zip, said to be the same everywhere


def write_usdz_package(path: Path, stage: Usd.Stage, layer: str, files: Mapping[str, bytes]) -> None:
    """Write a stage's own layer and what it names; equal input gives equal bytes.

    Args:
        path: of the file, `.usdz`.
        stage: its layer refers to `files` by paths relative to the package.
        layer: its name in the package, `.usdc`.
        files: content by name in the package.

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
    """A USDZ that was read.

    Attributes:
        files: content by name; the first is the layer.
        layer: its name.
        fps: time codes per second.
        duration_s: when its last time code is reached.
    """

    def __init__(self, path: Path) -> None:
        """Read it.

        Raises:
            BadInput: it is missing, no USDZ, or has no default prim that a scene could refer to.
        """
        try:
            with zipfile.ZipFile(path) as package:
                self.files = {name: package.read(name) for name in package.namelist()}
            stage = Usd.Stage.Open(str(path))
        except OSError as error:
            raise BadInput(f"{path} cannot be read: {error.strerror}") from error
        except (zipfile.BadZipFile, Tf.ErrorException) as error:
            raise BadInput(f"{path} is no USDZ: {error}".strip()) from error
        if not stage.HasDefaultPrim():
            raise BadInput(f"{path} has no default prim, so a scene cannot refer to it; give a file that dg4d wrote")
        self.layer = next(iter(self.files))
        self.fps: float = stage.GetTimeCodesPerSecond()
        self.duration_s: float = stage.GetEndTimeCode() / self.fps
