"""Safe extraction of untrusted zips: no entries outside of the target, bounded in number and size."""

import errno
import lzma
import os
import re
import stat
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

from dg4d_lib.errors import BadInput

MOST_ENTRIES = 100_000
MOST_UNPACKED_BYTES = 64 * 2**30  # of all entries; zipfile reads no more of an entry than its header declares
ZIP_ERRORS = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, NotImplementedError, RuntimeError, EOFError, ValueError)
UNFIT_ERRNOS = {errno.EINVAL, errno.ENAMETOOLONG, errno.EEXIST, errno.ENOTDIR, errno.EISDIR}  # false offsets and names
LONGEST_PART_BYTES = 255  # file name, on all common file systems
LONGEST_NAME_BYTES = 1024  # path in the zip; Linux allows 4095, of which our folders need some
UNFIT = re.compile(r"[\\\x00-\x1f]|^[A-Za-z]:")  # backslashes, control characters, drives
EPOCH = (1980, 1, 1, 0, 0, 0)  # earliest time that a zip can hold; every entry has it


def stays_inside(name: str) -> bool:
    """Return True if a name with slashes leads to a file in or below its folder, on every system."""
    return bool(name) and not UNFIT.search(name) and not {"", ".", ".."} & set(name.split("/"))


def can_exist(name: str) -> bool:
    """Return True if a name with slashes is short enough for a file and its folders."""
    size = len(os.fsencode(name))
    return size <= LONGEST_NAME_BYTES and all(len(os.fsencode(part)) <= LONGEST_PART_BYTES for part in name.split("/"))


def _checked_entries(archive: zipfile.ZipFile, what: str) -> list[zipfile.ZipInfo]:
    """Return the files of a zip, sorted by name.

    Raises:
        BadInput: an entry leads outside or is a link, two have the same name, or they are too many or too large.
    """
    files = (entry for entry in archive.infolist() if not entry.filename.endswith("/"))  # is_dir() fails without a name
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
    """Unpack a zip into an existing folder and return the names of its files.

    Args:
        path: the zip.
        folder: target, new if possible, as links in it are followed.
        what: name of the zip in messages.
        wanted: filter for the names of the files.

    Raises:
        BadInput: the file is not a zip, or is broken, or has unsafe, too many or too large entries.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            entries = [entry for entry in _checked_entries(archive, what) if wanted(entry.filename)]
            archive.extractall(folder, entries)
    except ZIP_ERRORS as error:
        raise BadInput(f"{what} is broken, encrypted, or not a zip: {error}") from error
    except OSError as error:
        if error.errno not in UNFIT_ERRNOS and error.errno is not None:  # damaged bzip2 data has no errno
            raise
        raise BadInput(f"{what} is broken, or has a name that no file may have: {error.strerror or error}") from error
    return [entry.filename for entry in entries]


def add_entry(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    """Add an entry whose bytes depend on name and content alone, not on time or machine."""
    info = zipfile.ZipInfo(name, EPOCH)
    info.external_attr = 0o644 << 16
    archive.writestr(info, content)
