"""Zips that somebody else may have written, unpacked so that nothing lands outside, and not without end."""

import errno
import lzma
import os
import re
import shutil
import stat
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path, PurePosixPath

from dg4d_lib.errors import BadInput

MOST_ENTRIES = 100_000
MOST_UNPACKED_BYTES = 64 * 2**30  # of all entries together; what they say of themselves is the most that is read
BROKEN = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, NotImplementedError, RuntimeError, EOFError, ValueError)
UNFIT_ERRNOS = {errno.EINVAL, errno.ENAMETOOLONG, errno.EEXIST, errno.ENOTDIR, errno.EISDIR}  # lying offsets, names
LONGEST_PART_BYTES = 255  # of a file's name, on all common file systems
LONGEST_NAME_BYTES = 1024  # with folders; Linux takes paths of 4095, and those of our folders come before
UNFIT = re.compile(r"[\\\x00-\x1f]|^[A-Za-z]:")  # backslashes, control characters, drives
EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest time a zip can hold


def stays_inside(name: str) -> bool:
    """Whether a name with slashes leads to a file in or below its folder, on every system."""
    parts = name.split("/")
    return bool(name) and not UNFIT.search(name) and not {"", ".", ".."} & set(parts)


def can_exist(name: str) -> bool:
    """Return whether a name with slashes is short enough for a file and its folders."""
    size = len(os.fsencode(name))
    return size <= LONGEST_NAME_BYTES and all(len(os.fsencode(part)) <= LONGEST_PART_BYTES for part in name.split("/"))


def checked(archive: zipfile.ZipFile, what: str) -> list[zipfile.ZipInfo]:
    """The files of a zip, by name.

    Args:
        archive: the zip.
        what: how messages call it.

    Raises:
        BadInput: an entry leads outside or is a link, two have one name, or there is too much in it.
    """
    files = (entry for entry in archive.infolist() if not entry.filename.endswith("/"))  # is_dir() needs a name
    entries = sorted(files, key=lambda entry: entry.filename)
    if len(entries) > MOST_ENTRIES:
        raise BadInput(f"{what} has {len(entries)} entries; at most {MOST_ENTRIES} are unpacked")
    size = sum(entry.file_size for entry in entries)
    if size > MOST_UNPACKED_BYTES:
        raise BadInput(f"{what} unpacks to {size} bytes; at most {MOST_UNPACKED_BYTES} are unpacked")
    before = ""
    for entry in entries:
        if not stays_inside(entry.filename):
            raise BadInput(f"{what} has an entry outside itself: {entry.filename!r}")
        if stat.S_ISLNK(entry.external_attr >> 16):
            raise BadInput(f"{what} has a link in it, {entry.filename!r}; pack the file itself")
        if entry.filename == before:
            raise BadInput(f"{what} has two entries {entry.filename!r}")
        before = entry.filename
    return entries


def unpack(path: Path, folder: Path, what: str, wanted: Callable[[str], bool] = lambda name: True) -> list[str]:
    """Unpack a zip into an existing folder; the names of its files.

    Args:
        path: the zip.
        folder: best a new one: links in it would be followed.
        what: how messages call the zip.
        wanted: whether a file of this name is unpacked.

    Raises:
        BadInput: no zip, or what `checked` refuses; then nothing is unpacked.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            entries = [entry for entry in checked(archive, what) if wanted(entry.filename)]
            for entry in entries:
                target = folder / PurePosixPath(entry.filename)
                target.parent.mkdir(parents=True, exist_ok=True)
                with archive.open(entry) as source, target.open("wb") as file:
                    shutil.copyfileobj(source, file)
    except BROKEN as error:
        raise BadInput(f"{what} is broken, encrypted, or no zip: {error}") from error
    except OSError as error:
        if error.errno not in UNFIT_ERRNOS and error.errno is not None:  # bzip2 damage has none
            raise
        raise BadInput(f"{what} is broken, or has a name that no file may have: {error.strerror or error}") from error
    return [entry.filename for entry in entries]


def add_entry(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    """Add an entry without anything that depends on time or machine: equal entries give equal bytes."""
    info = zipfile.ZipInfo(name, EPOCH)
    info.external_attr = 0o644 << 16
    archive.writestr(info, content)
