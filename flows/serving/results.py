"""Results in the output folder of a watched folder: lines for packages that appear, and for failures."""

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from dg4d_lib.errors import BadInput
from flows.formatting.escaping import visible
from flows.inputs.json_text import read_object
from flows.inputs.package_record import RECORD, REPORT

SUMMARY = "summary.json"  # of a batch


class Results:
    """Packages and summaries below an output folder; those that exist at the start are not reported.

    Args:
        out: output folder; it need not exist yet.
    """

    def __init__(self, out: Path) -> None:
        self.out = out
        self._packages = self._stamps()
        self._failures = self._failed()

    def poll(self) -> list[str]:
        """Return a line for every new or replaced package, and for every new failure, since the last poll."""
        packages, failures = self._stamps(), self._failed()
        finished = [name for name, stamp in packages.items() if self._packages.get(name) != stamp]
        failed = [name for name, message in failures.items() if self._failures.get(name) != message]
        self._packages, self._failures = packages, failures
        made = [f"done: {visible(str(self.out / name))}{self._verdict(name)}" for name in sorted(finished)]
        return [*made, *(visible(f"failed: {name}: {failures[name]}") for name in sorted(failed))]

    def _stamps(self) -> dict[str, int]:
        """Return the times of the records of all packages by their folder."""
        found: dict[str, int] = {}
        for path in visible_files(self.out):
            if path.name == RECORD:
                with suppress(OSError):  # the package is being replaced
                    found[path.parent.relative_to(self.out).as_posix()] = path.stat().st_mtime_ns
        return found

    def _failed(self) -> dict[str, str]:
        """Return the messages of failed items in the summary."""
        rows = read_object(self.out / SUMMARY).get("items")
        if not isinstance(rows, list):
            return {}
        failed = [row for row in rows if isinstance(row, dict) and row.get("status") == "failed"]
        return {str(row.get("item")): str(row.get("message", "")) for row in failed}

    def _verdict(self, name: str) -> str:
        acceptance = read_object(self.out / name / REPORT).get("acceptance")
        failing = acceptance.get("failing") if isinstance(acceptance, dict) else None
        return f" (not accepted: {', '.join(map(str, failing))})" if isinstance(failing, list) and failing else ""


def check_watched(folder: Path, out: Path) -> None:
    """Refuse a folder that cannot be watched for an output folder.

    Raises:
        BadInput: there is no such folder, or it is in the output folder.
    """
    if not folder.is_dir():
        state = "is not a folder" if folder.exists() else "does not exist"
        raise BadInput(f"{folder} {state}; give a folder into which pictures, videos or a manifest are dropped")
    if folder.resolve().is_relative_to(out.resolve()):
        raise BadInput(f"the output folder {out} holds the watched folder {folder}; choose another with -o")


def visible_files(folder: Path) -> Iterator[Path]:
    """Yield the files below a folder that are not hidden, nor below a hidden folder such as those of a publication.

    Folders that vanish or cannot be read are left out.
    """
    for parent, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        yield from (Path(parent, name) for name in names if not name.startswith("."))
