"""The one place that writes to the user's folder: a package appears there whole, or not at all."""

import errno
import hashlib
import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dg4d_lib.errors import BadInput
from flows.inputs.naming import check_folder_name
from flows.inputs.package_record import RECORD, record_of
from steps.artifacts.archives import unpack
from steps.store.files import remove_tree, room_for

CANNOT_SWAP = {errno.EBUSY, errno.EXDEV, errno.EACCES, errno.EPERM, errno.EROFS, errno.EINVAL}

Files = dict[str, dict[str, Any]]  # path within the package -> {"digest", "size_bytes"}
Finish = Callable[[Path, Files], Files]


def check_folder(folder: Path, item: str = "", force: bool = False) -> None:
    """Refuse a folder that cannot be written to, or that holds something else than a package of this item.

    Args:
        folder: where a package goes.
        item: name of its asset; empty: of any.
        force: a package of another item may be replaced.

    Raises:
        BadInput: says what is in the way and what to do.
    """
    check_folder_name(folder)
    if folder.exists() and not folder.is_dir():
        raise BadInput(f"{folder} is a file; choose a folder for the output with -o")
    record = record_of(folder) if folder.is_dir() else None
    if record is not None and item and not force and record.get("item", item) != item:
        raise BadInput(
            f"{folder} holds the asset {record['item']!r}, and this run makes {item!r}; choose another folder with -o, "
            "or replace it with --force"
        )
    if folder.is_dir() and record is None:
        others = sorted(p.name for p in folder.iterdir() if not p.name.startswith("."))
        if others:
            raise BadInput(
                f"{folder} holds other files ({', '.join(others[:3])}{', ...' if len(others) > 3 else ''}); "
                "choose a new or empty folder with -o"
            )
    check_writable(folder)


def check_writable(folder: Path) -> None:
    """Refuse a folder in which nothing can be made.

    Raises:
        BadInput: says which folder and why.
    """
    place = folder.absolute()
    try:
        while not place.exists():
            place = place.parent
        with room_for(place):
            tempfile.TemporaryDirectory(prefix=".dg4d-", dir=place).cleanup()
    except OSError as error:
        raise BadInput(
            f"the output folder {folder} cannot be written: {error.strerror} ({place}); choose another with -o"
        ) from error


def is_current(folder: Path, job_digest: str) -> bool:
    """Whether a folder holds the package of a job (its digest), with every byte as it was written.

    What lies beside the package, the reports for example, must be there, as whatever it is.
    """
    record = record_of(folder)
    if record is None or record.get("order") != job_digest:
        return False
    try:
        unchanged = all(file_digest(folder / name) == fact for name, fact in record["files"].items())
        return unchanged and all((folder / name).is_file() for name in record.get("beside", ()))
    except OSError:
        return False


def load_verified(folder: Path) -> dict[str, Any]:
    """The provenance of the package in a folder, whose files are all there with every byte as it was written.

    Raises:
        BadInput: there is no package, or files of it are missing or altered; says which.
    """
    record = record_of(folder)
    if record is None:
        raise BadInput(f"{folder} is no asset: it has no sound {RECORD}; give a folder that `dg4d make` wrote")
    if not _is_complete(record):
        raise BadInput(f"{folder} cannot be used: its {RECORD} has another form than `dg4d make` writes; make it again")
    faults = [f"{name} {fault}" for name, fact in record["files"].items() if (fault := _fault(folder / name, fact))]
    if faults:
        more = f" and {len(faults) - 3} more" if len(faults) > 3 else ""
        raise BadInput(f"{folder} is not as it was made: {', '.join(faults[:3])}{more}; make it again")
    return record


def publish(package: Path, folder: Path, finish: Finish) -> Files:
    """Replace the package in a folder for good; see `replace_package`."""
    swap = replace_package(package, folder, finish)
    swap.keep()
    return swap.files


def replace_package(package: Path, folder: Path, finish: Finish) -> "Swap":
    """Unpack a package beside `folder`, finish it, and put it in the place of the package there.

    Files in `folder` that no package brought stay. If anything fails, `folder` is as it was.

    Args:
        package: the zip that `pack_asset` made.
        folder: output folder.
        finish: is given the unpacked folder and the facts of its files; adds what goes with the package, the record
            above all, and returns the facts of the package's files as they are then.

    Returns:
        The finished swap; call `keep` or `undo` on it.

    Raises:
        DiskFull: there is no room.
        BadInput: the folder cannot be written.
    """
    folder = folder.resolve()
    missing = _first_missing(folder)
    try:
        with room_for(folder):
            try:
                return replace(_publish(package, folder, finish), first_made=missing)
            except OSError as error:
                if error.errno not in CANNOT_SWAP or not folder.is_dir():
                    raise
                return replace(_publish(package, folder, finish, in_place=True), first_made=missing)
    except OSError as error:
        _tidy(missing)
        raise BadInput(f"the output folder {folder} cannot be written: {error.strerror or error}") from error
    except BaseException:
        _tidy(missing)
        raise


@dataclass(frozen=True)
class Swap:
    """Package that took the place of another one, which is kept beside it for the time being.

    Attributes:
        folder: output folder.
        files: facts of the files of the new package.
        before: folder with what was there; it does not exist if nothing was.
        moved_in: files of the new package where it was moved in file by file; else None.
        first_made: outermost parent folder that was created for the package; None if none was.
    """

    folder: Path
    files: Files
    before: Path
    moved_in: tuple[Path, ...] | None = None
    first_made: Path | None = None

    def keep(self) -> None:
        """Remove the earlier package; files of the user move over from its folder."""
        if self.before.exists():
            _carry_over(_foreign(self.before) if self.moved_in is None else [], self.before, self.folder)

    def undo(self) -> None:
        """Restore the folder as it was, and remove parent folders that were created for it."""
        if self.moved_in is None:
            remove_tree(self.folder)
            if self.before.exists():
                self.before.replace(self.folder)
            _tidy(self.first_made)
            return
        for name in self.moved_in:
            (self.folder / name).unlink(missing_ok=True)
        for path in sorted(p for p in self.before.rglob("*") if p.is_file()):
            path.replace(self.folder / path.relative_to(self.before))
        remove_tree(self.before)


def unpacked(package: Path, folder: Path) -> Files:
    """Unpack a package into a folder; the facts of its files.

    Raises:
        BadInput: an entry leads out of the folder, or the package is broken.
    """
    return {name: file_digest(folder / name) for name in unpack(package, folder, "the package")}


def file_digest(path: Path) -> dict[str, Any]:
    """The digest and the size of a file."""
    with path.open("rb") as file:
        return {
            "digest": f"sha256:{hashlib.file_digest(file, 'sha256').hexdigest()}",
            "size_bytes": path.stat().st_size,
        }


def bytes_digest(content: bytes) -> dict[str, Any]:
    """As `file_digest`, of what a file will hold."""
    return {"digest": f"sha256:{hashlib.sha256(content).hexdigest()}", "size_bytes": len(content)}


def _publish(package: Path, folder: Path, finish: Finish, in_place: bool = False) -> Swap:
    if folder.exists() and not folder.is_dir():  # it may have come since the output was checked
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(folder))
    place = folder if in_place else folder.parent
    place.mkdir(parents=True, exist_ok=True)
    _recover(folder, place)
    staging = place / f".{folder.name}.incoming-{os.getpid()}"
    before = staging.with_name(f".{folder.name}.outgoing-{os.getpid()}")
    remove_tree(staging)
    try:
        staging.mkdir()
        files = finish(staging, unpacked(package, staging))
        if in_place or _contains(folder, Path.cwd()):
            return Swap(folder, files, before, tuple(_move_in(staging, folder, before)))
        _swap(staging, folder, before)
        return Swap(folder, files, before)
    finally:
        remove_tree(staging)


def _is_complete(record: dict[str, Any]) -> bool:
    """Check that a record has the form that its readers count on."""
    try:
        steps = [*record.get("steps", ()), *record.get("run", {}).get("steps", ())]
        return (
            all(type(fact["digest"]) is str and type(fact["size_bytes"]) is int for fact in record["files"].values())
            and all(isinstance(step["step"], str) for step in steps)
            and all(isinstance(step.get(name, 0), int | float) for step in steps for name in ("duration_s", "cpu_s"))
            and all(isinstance(step.get("machine", {}), dict) for step in steps)
            and isinstance(record.get("item", ""), str)
        )
    except (KeyError, TypeError, AttributeError):
        return False


def _fault(path: Path, fact: dict[str, Any]) -> str:
    """What is wrong with a file; empty if nothing is."""
    try:
        return "" if file_digest(path) == fact else "was altered"
    except FileNotFoundError:
        return "is missing"
    except OSError as error:
        return f"cannot be read ({error.strerror})"


def _swap(staging: Path, folder: Path, before: Path) -> None:
    """Rename the old folder to `before` and the new one to `folder`."""
    if not folder.exists():
        staging.replace(folder)
        return
    folder.replace(before)
    try:
        staging.replace(folder)
    except OSError:
        before.replace(folder)
        raise


def _carry_over(names: list[Path], outgoing: Path, folder: Path) -> None:
    for name in names:
        target = folder / name
        if not target.exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            (outgoing / name).replace(target)
    remove_tree(outgoing)


def _recover(folder: Path, place: Path) -> None:
    """Clear up after commands that were killed while they published."""
    for left in sorted(place.glob(f".{_literal(folder.name)}.*-*")):
        kind, _, pid = left.name.removeprefix(f".{folder.name}.").partition("-")
        if kind not in {"incoming", "outgoing"} or not pid.isdigit() or Path(f"/proc/{pid}").exists():
            continue
        if kind == "incoming":
            remove_tree(left)
        elif folder.exists():
            _carry_over(_foreign(left), left, folder)
        else:
            left.replace(folder)


def _move_in(staging: Path, folder: Path, before: Path) -> list[Path]:
    """Move the new files in one by one, where the folder cannot be renamed, and the old ones to `before`.

    The record goes last, so that a half-finished swap is recognized as one.
    """
    new = sorted(p.relative_to(staging) for p in staging.rglob("*") if p.is_file())
    new.sort(key=lambda name: name == Path(RECORD))
    for name in [*sorted(Path(old) for old in _ours(folder) - {n.as_posix() for n in new}), *new]:
        if (folder / name).exists():
            (before / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).replace(before / name)
        if (staging / name).exists():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (staging / name).replace(folder / name)
    return new


def _foreign(folder: Path) -> list[Path]:
    """Files that no package brought, relative to the folder."""
    ours = _ours(folder)
    files = (p.relative_to(folder) for p in folder.rglob("*") if p.is_file() or p.is_symlink())
    return sorted(f for f in files if f.as_posix() not in ours)


def _ours(folder: Path) -> set[str]:
    """The files that the package in a folder brought."""
    record = record_of(folder)
    return set() if record is None else {*record["files"], *record.get("beside", ()), RECORD}


def _first_missing(folder: Path) -> Path | None:
    """The outermost folder that would have to be made."""
    missing = None
    while not folder.exists():
        missing, folder = folder, folder.parent
    return missing


def _tidy(made: Path | None) -> None:
    """Remove the folders that were made on the way to a failure; they are empty."""
    if made is None:
        return
    for folder in [*sorted((p for p in made.rglob("*") if p.is_dir()), reverse=True), made]:
        with suppress(OSError):
            folder.rmdir()


def _contains(folder: Path, other: Path) -> bool:
    return other == folder or folder in other.parents


def _literal(name: str) -> str:
    """A name for use in a glob pattern."""
    return "".join(f"[{c}]" if c in "*?[" else c for c in name)
