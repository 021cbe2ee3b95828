"""Drafts: files that were handed in through the studio page, checked by content, until and after their conversion.

uploads/ID/files/NAME        files as handed in, under cleaned names
uploads/ID/mask.png          matte drawn by the user, of the size of the first file
uploads/ID/runs/KEY/NAME     links to the files of one conversion, named as the asset
uploads/ID/batch-KEY.json    manifest of a batch of all files
"""

import asyncio
import io
import json
import os
import re
import secrets
import tempfile
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

from PIL import Image

from dg4d_lib.errors import BadInput
from flows import home
from flows.engine.free_space import require_free_space
from flows.inputs.models import check_model
from flows.inputs.naming import LONGEST_PART_BYTES, clean_name
from flows.inputs.sources import LARGEST_FILE_BYTES
from steps.sources.media_types import (
    MODEL_SUFFIXES,
    SNIFFED_BYTES,
    check_media,
    is_animated_png,
    is_video,
)
from steps.store.files import home as home_folder
from steps.store.files import room_for, write_atomically

Kind = Literal["picture", "video", "model"]

LIMIT_VARIABLE = "DG4D_STUDIO_UPLOAD_MB"
LIMIT_MB = 2048  # of one file
MOST_FILES = 1000  # of one draft
MOST_MASK_BYTES = 16 * 2**20
MASK_SIDES = 2048  # largest side of a mask as the page draws it, pixels
BLOCK = 2**20  # bytes that are written at once
IDENTIFIER = re.compile(r"[0-9a-f]{16}")


class TooLarge(BadInput):
    """File that exceeds the limit on bytes."""


@dataclass(frozen=True)
class Upload:
    """One file of a draft.

    Attributes:
        path: of the file.
        kind: of the file, recognized by its content.
    """

    path: Path
    kind: Kind

    @property
    def name(self) -> str:
        """Name of the file."""
        return self.path.name


class Draft:
    """Files of one future asset, or of one batch.

    Args:
        identifier: 16 hexadecimal digits.

    Raises:
        LookupError: there is no such draft.
    """

    def __init__(self, identifier: str) -> None:
        if not IDENTIFIER.fullmatch(identifier) or not (home.uploads() / identifier).is_dir():
            raise LookupError("this draft does not exist; drop the files again")
        self.identifier, self.folder = identifier, home.uploads() / identifier

    @classmethod
    def create(cls) -> "Draft":
        """Make an empty draft.

        Raises:
            DiskFull: the disk of the home folder is nearly full.
        """
        require_free_space(home_folder())
        home.make_private(home_folder())
        identifier = secrets.token_hex(8)
        (home.uploads() / identifier / "files").mkdir(parents=True)
        return cls(identifier)

    @property
    def files_folder(self) -> Path:
        """Folder of the files as handed in."""
        return self.folder / "files"

    @property
    def mask(self) -> Path:
        """File of the matte that the user drew; it need not exist."""
        return self.folder / "mask.png"

    def uploads(self) -> list[Upload]:
        """Return the files in the order in which they were handed in."""
        paths = [path for path in self.files_folder.iterdir() if not path.name.startswith(".")]
        ordered = sorted(paths, key=lambda path: (path.stat().st_mtime_ns, path.name))
        return [Upload(path, kind_of(path)) for path in ordered]

    def upload(self, name: str) -> Upload:
        """Return a file by name.

        Raises:
            LookupError: the draft has no such file.
        """
        found = next((each for each in self.uploads() if each.name == name), None)
        if found is None:
            raise LookupError(f"this draft has no file {name!r}")
        return found

    def first(self) -> Upload:
        """Return the file that the asset is made of: a model, else the first one.

        Raises:
            BadInput: the draft is empty.
        """
        files = self.uploads()
        if not files:
            raise BadInput("this draft has no files yet; drop a picture, a video or a model")
        return next((each for each in files if each.kind == "model"), files[0])

    async def receive(self, name: str, chunks: AsyncIterator[bytes]) -> Upload:
        """Write a stream to a file and keep it if it is a picture, a video, a zip of frames or a model.

        Args:
            name: given by the browser; only its last part is used, cleaned.
            chunks: content.

        Raises:
            BadInput: the content is of no known kind, or too long; nothing is kept.
            DiskFull: there is no room; nothing is kept.
        """
        await asyncio.to_thread(require_free_space, home_folder())
        cleaned = clean_file_name(name)
        if len(list(self.files_folder.iterdir())) >= MOST_FILES:
            raise TooLarge(f"a draft takes at most {MOST_FILES} files; use `dg4d batch FOLDER` for more")
        handle, scratch = tempfile.mkstemp(prefix=".part-", suffix=PurePosixPath(cleaned).suffix, dir=self.files_folder)
        path = Path(scratch)
        try:
            with room_for(self.folder), os.fdopen(handle, "wb") as file:
                await _write(file.write, chunks)
            await asyncio.to_thread(check_upload, path, cleaned)
            return await asyncio.to_thread(self._keep, path, cleaned)
        finally:
            path.unlink(missing_ok=True)

    def _keep(self, scratch: Path, name: str) -> Upload:
        """Give a checked file its name, with a number where another one has it."""
        stem, suffix = PurePosixPath(name).stem, PurePosixPath(name).suffix
        for number in range(1, MOST_FILES + 2):
            target = self.files_folder / (name if number == 1 else f"{stem}-{number}{suffix}")
            with suppress(FileExistsError):
                os.link(scratch, target)
                return Upload(target, kind_of(target))
        raise BadInput(f"too many files are named {name}; rename some")

    def save_mask(self, content: bytes, size: tuple[int, int]) -> None:
        """Keep a matte that the page drew, at the size of the source.

        Args:
            content: picture whose brightness is the matte.
            size: width and height of the source in pixels.

        Raises:
            BadInput: the picture is not a PNG, or is empty.
            DiskFull: there is no room.
        """
        try:
            with Image.open(io.BytesIO(content), formats=["PNG"]) as picture:
                if max(picture.size) > MASK_SIDES:
                    width, height = picture.size
                    raise BadInput(f"the mask has {width} x {height} pixels; its sides may have at most {MASK_SIDES}")
                mask = picture.convert("L").resize(size, Image.Resampling.BICUBIC)
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise BadInput("the mask is not a readable PNG; paint it again") from error
        if mask.getextrema() == (0, 0):
            raise BadInput("the mask is empty: paint over the subject with the brush `keep`")
        png = io.BytesIO()
        mask.save(png, "PNG")
        write_atomically(self.mask, png.getvalue())

    def saved_mask(self) -> Path:
        """Return the file of the matte that the user drew.

        Raises:
            BadInput: there is none.
        """
        if not self.mask.is_file():
            raise BadInput("there is no mask yet; paint over the subject first")
        return self.mask

    def link(self, key: str, name: str, path: Path) -> Path:
        """Link a file under the name of the asset for one conversion, and return the link.

        The asset is named after its file, and a retry finds what the first attempt read.
        """
        folder = self.folder / "runs" / key
        folder.mkdir(parents=True, exist_ok=True)
        target = folder / name
        with room_for(self.folder), suppress(FileExistsError):
            os.link(path, target)
        return target

    def write_manifest(self, key: str) -> Path:
        """Write a manifest with a row for every file, whatever its suffix, and return its path.

        Raises:
            DiskFull: there is no room.
        """
        path = self.folder / f"batch-{key}.json"
        rows = [{"path": each.path.relative_to(self.folder).as_posix()} for each in self.uploads()]
        write_atomically(path, json.dumps(rows))
        return path


def most_bytes() -> int:
    """Return the largest number of bytes of a file that is taken.

    Raises:
        BadInput: the variable is not a whole number.
    """
    given = os.environ.get(LIMIT_VARIABLE) or str(LIMIT_MB)
    if not given.isdecimal() or not int(given):
        raise BadInput(f"${LIMIT_VARIABLE} is {given!r}; set it to the MiB of the largest file, as {LIMIT_MB}")
    return min(int(given) * 2**20, LARGEST_FILE_BYTES)


def clean_file_name(name: str) -> str:
    """Return the last part of a name without unprintable characters, short enough, with its suffix in lower case."""
    last = PurePosixPath(clean_name(name.replace("\\", "/").replace("\0", ""))).name
    stem, suffix = PurePosixPath(last).stem.strip(" ."), PurePosixPath(last).suffix.lower()
    room = LONGEST_PART_BYTES - 40  # for the number of an equal name, and names of scratch folders
    short = stem.encode("utf-8", "ignore")[:room].decode("utf-8", "ignore")
    return f"{short or 'asset'}{suffix if len(suffix) <= 8 and suffix.isascii() else ''}"


def check_upload(path: Path, name: str) -> None:
    """Refuse a file that is neither a picture, a video, a zip of frames nor a model.

    Raises:
        BadInput: says what it is and what to give.
    """
    try:
        if path.suffix in MODEL_SUFFIXES:
            check_model(path)
        else:
            check_media(path)
    except BadInput as error:
        sentence = str(error).replace(str(path), name).removeprefix("--asset: ").removeprefix(f"{name} ")
        raise BadInput(f"{name}: {sentence}") from error


def kind_of(path: Path) -> Kind:
    """Return the kind of a checked file; an animated WebP counts as a picture that may move."""
    if path.suffix in MODEL_SUFFIXES:
        return "model"
    with path.open("rb") as file:
        head = file.read(SNIFFED_BYTES)
    return "video" if is_animated_png(head) or is_video(path) else "picture"


async def _write(write: Callable[[bytes], object], chunks: AsyncIterator[bytes]) -> None:
    """Write a stream in blocks, in another thread."""

    most, size, block = most_bytes(), 0, bytearray()
    async for chunk in chunks:
        size += len(chunk)
        if size > most:
            raise TooLarge(f"the file has more than {most / 2**20:.0f} MiB; shorten it, or raise ${LIMIT_VARIABLE}")
        block += chunk
        if len(block) >= BLOCK:
            await asyncio.to_thread(write, bytes(block))
            block.clear()
    await asyncio.to_thread(write, bytes(block))
