"""Names of items: cleaned, and checked against what file systems, records and pages can hold."""

import os
import unicodedata
from collections import Counter
from pathlib import Path, PurePosixPath

from dg4d_lib.errors import BadInput
from flows.formatting.escaping import quoted, visible

LONGEST_PART_BYTES = 230  # of one folder: file systems take 255, of which the names of scratch folders need up to 25
LONGEST_NAME_BYTES = 1000  # of a name with its folders
LONGEST_PATH_BYTES = 3900  # of an output folder: Linux takes 4096, and files in a package need the rest
RESERVED = frozenset(["summary.json", "summary.csv", "index.html"])  # files that a batch writes beside its packages


def clean(name: str) -> str:
    """Return a name without parts that lead out of a folder, and without letters that cannot be seen; may be empty."""
    printable = "".join(letter for letter in name if letter.isprintable())
    return "/".join(part for part in PurePosixPath(printable).parts if part.strip("/ ") not in {"", ".", ".."})


def check_name(name: str, advice: str = "choose a shorter name") -> None:
    """Refuse a name of an item that cannot be that of a folder.

    Raises:
        BadInput: it is empty, too long, or no text; says what is allowed.
    """
    check_text(name, "the name")
    if not clean(name) or visible(name) != name or set("\n\t") & set(name):
        raise BadInput(f"the name {quoted(name)} cannot be that of a folder: choose letters that can be seen")
    longest = max(name.split("/"), key=_bytes)
    if _bytes(longest) > LONGEST_PART_BYTES:
        raise BadInput(
            f"the name {quoted(longest)} is too long: it has {_bytes(longest)} bytes in UTF-8, and at most "
            f"{LONGEST_PART_BYTES} are allowed; {advice}"
        )
    if _bytes(name) > LONGEST_NAME_BYTES:
        raise BadInput(
            f"the name {quoted(name)} is too long: it has {_bytes(name)} bytes in UTF-8 with its folders, and at most "
            f"{LONGEST_NAME_BYTES} are allowed; {advice}"
        )


def check_text(text: str, what: str) -> None:
    """Refuse text that cannot be written as UTF-8, as file names with other bytes are.

    Raises:
        BadInput: says which letters are wrong.
    """
    try:
        text.encode()
    except UnicodeEncodeError:
        raise BadInput(f"{what} {quoted(text)} is not UTF-8: records and pages could not hold it; rename it") from None


def check_not_reserved(name: str) -> None:
    """Refuse the name of an item under which the batch writes a file of its own.

    Raises:
        BadInput: says which.
    """
    if name.partition("/")[0].lower() in RESERVED:
        files = ", ".join(sorted(RESERVED))
        raise BadInput(f"{name} is the name of a file that every batch writes ({files}); rename it")


def check_path(path: Path) -> None:
    """Refuse a path that the system cannot look up; one at which there is nothing passes.

    Raises:
        BadInput: it is too long, holds impossible letters, or lies where nobody may look.
    """
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        pass
    except (OSError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else "") or str(error)
        raise BadInput(f"{quoted(str(path))} cannot be read: {reason}") from error


def check_folder_name(folder: Path) -> None:
    """Refuse an output folder whose name leaves no room for those that are needed beside and in it.

    Raises:
        BadInput: says how long it is and how long it may be.
    """
    place, name = os.fsencode(folder.absolute()), os.fsencode(folder.absolute().name)
    if b"\0" in place:
        raise BadInput(f"the output folder {visible(str(folder))} cannot be written: a zero byte is in its name")
    if (size := len(name)) > LONGEST_PART_BYTES:
        raise BadInput(
            f"the output folder {quoted(folder.name)} cannot be written: its name has {size} bytes, and at "
            f"most {LONGEST_PART_BYTES} are allowed; choose another with -o"
        )
    if len(place) > LONGEST_PATH_BYTES:
        raise BadInput(
            f"the output folder {quoted(str(folder))} cannot be written: its path has {len(place)} bytes, and "
            f"at most {LONGEST_PATH_BYTES} are allowed; choose another with -o"
        )


def distinct(wanted: list[tuple[str, str]]) -> list[str]:
    """Return a name for each item: no two are equal on any file system, and none lies within another.

    The case of letters does not tell names apart, and neither do the two Unicode forms of an accented letter.

    Args:
        wanted: for each item the name it should have, and what to add where that is not clear.
    """
    count = Counter(_folded(name) for name, _ in wanted)
    inside = {_folded(parent.as_posix()) for name, _ in wanted for parent in PurePosixPath(name).parents}
    names: list[str] = []
    used, numbers = set(inside), Counter[str]()
    for name, addition in wanted:
        clear = count[_folded(name)] == 1 and _folded(name) not in inside
        names.append(_numbered(name if clear or not addition else f"{name}-{addition}", used, numbers))
        used.add(_folded(names[-1]))
    return names


def _numbered(name: str, used: set[str], numbers: Counter[str]) -> str:
    """The name, or with the first number that is free; `numbers` has the last one of every name."""
    folded = _folded(name)
    if folded not in used:
        return name
    numbers[folded] = max(numbers[folded], 1) + 1
    while _folded(f"{name}-{numbers[folded]}") in used:
        numbers[folded] += 1
    return f"{name}-{numbers[folded]}"


def _folded(name: str) -> str:
    """A name as file systems compare it that know neither case nor Unicode forms."""
    return unicodedata.normalize("NFC", name).casefold()


def _bytes(text: str) -> int:
    return len(text.encode(errors="surrogateescape"))
