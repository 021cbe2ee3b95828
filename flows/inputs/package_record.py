"""Provenance record of a package in a folder, which others may have written."""

from pathlib import Path
from typing import Any

from dg4d_lib.errors import BadInput, quoted
from flows.inputs.json_text import read_object
from steps.artifacts.archives import can_exist, stays_inside

RECORD = "provenance.json"
REPORT = "report.json"  # beside it
FORMAT = 2  # of the record


def check_is_folder(place: Path) -> None:
    """Refuse a path of a package that does not exist or is a file.

    Raises:
        BadInput: says what to give instead.
    """
    try:
        is_file, is_folder = place.is_file(), place.is_dir()
    except OSError as error:  # a name that is too long
        raise BadInput(
            f"{quoted(str(place))} cannot be read: {error.strerror}; give a folder that `dg4d make` wrote"
        ) from error
    if is_file:
        raise BadInput(f"{place} is a file; give its folder {place.parent}")
    if not is_folder:
        raise BadInput(f"{place} does not exist; give a folder that `dg4d make` wrote")


def record_of(folder: Path) -> dict[str, Any] | None:
    """Return the provenance of the package in a folder.

    None if there is no package, or the record cannot be used: a name in it leads out of the folder or is too long for
    a file, or it is nested too deeply.
    """
    record = read_object(folder / RECORD)
    try:
        names = [*record["files"], *record.get("beside", ())]
        sound = isinstance(record["files"], dict) and all(stays_inside(name) and can_exist(name) for name in names)
        return record if sound else None
    except (ValueError, KeyError, TypeError, AttributeError):
        return None
