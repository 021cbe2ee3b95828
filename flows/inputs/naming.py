"""Names of items: cleaned, made unique, and checked against the limits of file systems, records and pages."""

import os
import unicodedata
from collections import Counter
from pathlib import Path, PurePath, PurePosixPath

from dg4d_lib.errors import BadInput, quoted
from flows.formatting.escaping import visible

LONGEST_PART_BYTES = 230  # of one folder: file systems take 255, of which names of scratch folders need up to 25
LONGEST_NAME_BYTES = 1000  # of a name with its folders
LONGEST_PATH_BYTES = 3900  # of an output folder: Linux takes 4096, and files in a package need the rest
RESERVED = frozenset(["summary.json", "summary.csv", "index.html"])  # files that a batch writes beside its packages


def clean_name(name: str) -> str:
    """Remove unprintable characters, and parts that lead out of a folder; the result may be empty."""
    printable = "".join(letter for letter in name if letter.isprintable())
    return "/".join(part for part in PurePosixPath(printable).parts if part.strip("/ ") not in {"", ".", ".."})


def name_from_path(path: PurePath) -> str:
    """Return the name that a file, or a folder of frames, gives its asset: `fox` for fox.png and for the folder fox."""
    try:
        folder = isinstance(path, Path) and path.is_dir()
    except OSError:  # the name is too long, which `check_path` refuses
        folder = False
    return clean_name(path.name if folder else path.stem) or "asset"


def check_name(name: str, advice: str = "choose a shorter name") -> None:
    """Refuse a name of an item that cannot be the name of a folder.

    Raises:
        BadInput: it is empty, too long, or not printable UTF-8; says what is allowed.
    """
    check_text(name, "the name")
    if not clean_name(name) or visible(name) != name or set("\n\t") & set(name):
        raise BadInput(f"the name {quoted(name)} cannot be that of a folder; use printable characters")
    longest = max(name.split("/"), key=_bytes)
    for text, most, folders in ((longest, LONGEST_PART_BYTES, ""), (name, LONGEST_NAME_BYTES, " with its folders")):
        if _bytes(text) > most:
            raise BadInput(
                f"the name {quoted(text)} is too long: it has {_bytes(text)} bytes in UTF-8{folders}, and at most "
                f"{most} are allowed; {advice}"
            )


def check_text(text: str, what: str) -> None:
    """Refuse text that cannot be encoded as UTF-8, such as file names with other bytes.

    Raises:
        BadInput: names the text.
    """
    try:
        text.encode()
    except UnicodeEncodeError:
        raise BadInput(f"{what} {quoted(text)} is not UTF-8, as records and pages need it; rename it") from None


def check_not_reserved(name: str) -> None:
    """Refuse the name of an item that is the name of a file of the batch.

    Raises:
        BadInput: lists the reserved names.
    """
    if name.partition("/")[0].lower() in RESERVED:
        files = ", ".join(sorted(RESERVED))
        raise BadInput(f"{name} is the name of a file that every batch writes ({files}); rename it")


def check_path(path: Path) -> None:
    """Refuse a path that the system cannot look up; a missing file passes.

    Raises:
        BadInput: it is too long, has invalid characters, or lies in a folder without permission.
    """
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        pass
    except (OSError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else "") or str(error)
        raise BadInput(f"{quoted(str(path))} cannot be read: {reason}") from error


def check_folder_name(folder: Path) -> None:
    """Refuse an output folder whose name leaves no room for the names of scratch folders and files.

    Raises:
        BadInput: says how long it is and how long it may be.
    """
    path, name = os.fsencode(folder.absolute()), os.fsencode(folder.absolute().name)
    if b"\0" in path:
        raise BadInput(f"the output folder {visible(str(folder))} cannot be written: a zero byte is in its name")
    for what, text, size, most in (
        ("name", folder.name, len(name), LONGEST_PART_BYTES),
        ("path", str(folder), len(path), LONGEST_PATH_BYTES),
    ):
        if size > most:
            raise BadInput(
                f"the output folder {quoted(text)} cannot be written: its {what} has {size} bytes, and at most {most} "
                "are allowed; choose another with -o"
            )


def unique_names(wanted: list[tuple[str, str]]) -> list[str]:
    """Return a name for each item: no two are equal on any file system, and none lies within another.

    Names that differ only in case, or in the Unicode form of an accented letter, count as equal.

    Args:
        wanted: for each item the wanted name, and a suffix in case it is not unique.
    """
    count = Counter(_folded(name) for name, _ in wanted)
    used = {_folded(parent.as_posix()) for name, _ in wanted for parent in PurePosixPath(name).parents}
    parents, last_number = set(used), Counter[str]()
    names: list[str] = []
    for name, suffix in wanted:
        folded = _folded(name)
        unique = name if not suffix or (count[folded] == 1 and folded not in parents) else f"{name}-{suffix}"
        names.append(_numbered(unique, used, last_number))
        used.add(_folded(names[-1]))
    return names


def _numbered(name: str, used: set[str], last_number: Counter[str]) -> str:
    """Append the first free number to a name that is used."""
    folded = _folded(name)
    if folded not in used:
        return name
    last_number[folded] = max(last_number[folded], 1) + 1
    while _folded(f"{name}-{last_number[folded]}") in used:
        last_number[folded] += 1
    return f"{name}-{last_number[folded]}"


def _folded(name: str) -> str:
    """Return a name as a file system compares it that ignores case and Unicode forms."""
    return unicodedata.normalize("NFC", name).casefold()


def _bytes(text: str) -> int:
    return len(text.encode(errors="surrogateescape"))
