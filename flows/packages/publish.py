"""Atomic replacement of the package in an output folder."""

import errno
import filecmp
import glob
import hashlib
import itertools
import math
import os
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, get_args

from dg4d_lib.errors import BadInput, listed
from flows.inputs.naming import check_folder_name
from flows.inputs.package_record import RECORD, check_is_folder, record_of
from flows.processes import host_id
from steps.artifacts.archives import unpack
from steps.store.files import remove_tree, require_regular, room_for, walk

HOST_DIGITS = 6  # of the machine in names of scratch folders, see `naming.LONGEST_PART_BYTES`
FOREIGN_S = 24 * 3600.0  # without a change; then a scratch folder of another machine counts as left over
CANNOT_SWAP = {errno.EBUSY, errno.EXDEV, errno.EACCES, errno.EPERM, errno.EROFS, errno.EINVAL}

Files = dict[str, dict[str, Any]]  # path within the package -> {"digest", "size_bytes"}
Finish = Callable[[Path, Files], Files]
Say = Callable[[str], None]
Scratch = Literal["incoming", "outgoing"]  # folder: of a new package, of an earlier one


def check_folder(folder: Path, item: str = "", force: bool = False) -> None:
    """Refuse an output folder that cannot be written, or that holds anything but a package of this item.

    Args:
        folder: output folder.
        item: name of the asset; empty: of any.
        force: allow to replace a package of another item.

    Raises:
        BadInput: says what the folder holds and what to do.
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
    others = sorted(p.name for p in folder.glob("[!.]*")) if record is None else []
    if others:
        raise BadInput(
            f"{folder} holds other files ({', '.join(others[:3])}{', ...' if len(others) > 3 else ''}); "
            "choose a new or empty folder with -o"
        )
    check_writable(folder)


def check_writable(folder: Path) -> None:
    """Refuse a folder that cannot be written or created.

    Raises:
        BadInput: says why.
    """
    place = folder.absolute()
    try:
        folder.resolve()
        while not place.exists():
            place = place.parent
        with room_for(place):
            tempfile.TemporaryDirectory(prefix=".dg4d-", dir=place).cleanup()
    except (OSError, RuntimeError) as error:  # RuntimeError: a circle of links
        reason = error.strerror if isinstance(error, OSError) else error
        raise BadInput(
            f"the output folder {folder} cannot be written: {reason} ({place}); choose another with -o"
        ) from error


def is_current(folder: Path, job_digest: str) -> bool:
    """Return True if a folder holds the unaltered package of a job, given by its digest.

    Files beside the package, such as the reports, must exist, but may be altered.
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
    """Return the provenance of the package in a folder after checking the digests of its files.

    Raises:
        BadInput: there is no package, or files of it are missing or altered; names them.
    """
    check_is_folder(folder)
    record = record_of(folder)
    if record is None:
        raise BadInput(f"{folder} is not an asset: it has no valid {RECORD}; give a folder that `dg4d make` wrote")
    if not _is_complete(record):
        raise BadInput(f"{folder} cannot be used: its {RECORD} has an unknown format; make the asset again")
    faults = [f"{name} {fault}" for name, fact in record["files"].items() if (fault := _fault(folder / name, fact))]
    if faults:
        raise BadInput(f"{folder} is damaged: {listed(faults, 3)}; make the asset again")
    return record


def publish(package: Path, folder: Path, finish: Finish, say: Say = lambda _: None) -> Files:
    """Unpack a package beside `folder`, finish it, and replace the package in `folder`.

    Files in `folder` that no package brought stay; one whose name the new package brings gets another name, `mesh.glb`
    becomes `mesh.mine.glb`. If anything fails, `folder` is as it was.

    Args:
        package: zip of `pack_asset`.
        folder: output folder.
        finish: called with the unpacked folder and the digests of its files; adds record and reports, and returns the
            digests of the package's files after that.
        say: called with a sentence for every file that was renamed.

    Returns:
        Digests of the files of the new package.

    Raises:
        DiskFull: the disk is full.
        BadInput: the folder cannot be written.
    """
    folder = folder.resolve()
    missing = _first_missing(folder)
    try:
        with room_for(folder):
            try:
                return _publish(package, folder, finish, say)
            except OSError as error:
                if error.errno not in CANNOT_SWAP or not folder.is_dir():
                    raise
                return _publish(package, folder, finish, say, in_place=True)
    except BaseException as error:
        _remove_empty(missing)
        if isinstance(error, OSError):
            raise BadInput(f"the output folder {folder} cannot be written: {error.strerror or error}") from error
        raise


def leftovers(folder: Path) -> list[Path]:
    """List the scratch folders that killed commands left beside a folder, or in it."""
    folder, left = folder.resolve(), []
    for path in sorted(p for place in (folder.parent, folder) for p in place.glob(f".{glob.escape(folder.name)}.*-*")):
        kind, _, owner = path.name.removeprefix(f".{folder.name}.").partition("-")
        left += [path] if kind in get_args(Scratch) and _is_left_over(owner, path) else []
    return left


def scratch_name(folder: Path, kind: Scratch, pid: int) -> str:
    """Return the name of a folder beside, or in, an output folder that a process of this machine publishes to."""
    return f".{folder.name}.{kind}-{_host()}-{pid}"


def recover(folder: Path, say: Say = lambda _: None) -> None:
    """Clean up the `leftovers` of a folder: put its package or the user's files back, and remove the rest.

    Args:
        folder: output folder.
        say: as of `publish`.
    """
    folder = folder.resolve()
    for left in leftovers(folder):
        if left.name.startswith(f".{folder.name}.incoming"):
            remove_tree(left)
        elif folder.exists():
            _carry_over(left, folder, say)
        else:
            left.replace(folder)


def unpacked(package: Path, folder: Path) -> Files:
    """Unpack a package into a folder; return the digests of its files.

    Raises:
        BadInput: an entry leads out of the folder, or the package is damaged.
    """
    return {name: file_digest(folder / name) for name in unpack(package, folder, "the package")}


def file_digest(path: Path) -> dict[str, Any]:
    """Return digest and size of a file; raise OSError if it cannot be read, or is a FIFO or a device."""
    require_regular(path)
    with path.open("rb") as file:
        return {
            "digest": f"sha256:{hashlib.file_digest(file, 'sha256').hexdigest()}",
            "size_bytes": path.stat().st_size,
        }


def bytes_digest(content: bytes) -> dict[str, Any]:
    """Return digest and size as `file_digest` does, of the content of a file."""
    return {"digest": f"sha256:{hashlib.sha256(content).hexdigest()}", "size_bytes": len(content)}


def _publish(package: Path, folder: Path, finish: Finish, say: Say, in_place: bool = False) -> Files:
    if folder.exists() and not folder.is_dir():  # created since the output was checked
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(folder))
    place = folder if in_place else folder.parent
    place.mkdir(parents=True, exist_ok=True)
    recover(folder, say)
    staging = place / scratch_name(folder, "incoming", os.getpid())
    before = place / scratch_name(folder, "outgoing", os.getpid())
    remove_tree(staging)
    try:
        staging.mkdir()
        files = finish(staging, unpacked(package, staging))
        if in_place or Path.cwd().is_relative_to(folder):
            _move_in(staging, folder, before, say)
            remove_tree(before)
        else:
            _swap(staging, folder, before)
            if before.exists():
                _carry_over(before, folder, say)
        return files
    finally:
        remove_tree(staging)


def _host() -> str:
    """Return a short digest of the identity of this machine, since process ids are unique on one machine only."""
    return hashlib.sha256(host_id().encode()).hexdigest()[:HOST_DIGITS]


def _is_left_over(owner: str, scratch: Path) -> bool:
    """Return true if a scratch folder is left over.

    On this machine, its process has ended; on another one, nothing in it has changed for `FOREIGN_S`.

    Args:
        owner: end of its name, HOST-PID; earlier versions wrote the PID alone.
        scratch: the folder.
    """
    host, _, pid = owner.partition("-")
    if host != _host():
        return time.time() - _last_change(scratch) > FOREIGN_S
    # in containers, process ids are used again
    return pid.isdigit() and (int(pid) == os.getpid() or not Path(f"/proc/{pid}").exists())


def _last_change(folder: Path) -> float:
    """Return the time of the last change in a folder, in seconds since the epoch; infinity if the folder is gone."""
    times: list[float] = []
    for path in (folder, *walk(folder)):
        with suppress(FileNotFoundError):
            status = path.lstat()
            times += [status.st_mtime, status.st_ctime]  # a rename changes the latter only
    return max(times, default=math.inf)


def _is_complete(record: dict[str, Any]) -> bool:
    """Return True if a record has the fields that its readers use."""
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
    """Return the fault of a file; "" if it has none."""
    try:
        return "" if file_digest(path) == fact else "was altered"
    except FileNotFoundError:
        return "is missing"
    except OSError as error:
        return f"cannot be read ({error.strerror})"


def _swap(staging: Path, folder: Path, before: Path) -> None:
    """Rename the old folder to `before` and the new one to `folder`."""
    if folder.exists():
        folder.replace(before)
    try:
        staging.replace(folder)
    except OSError:
        if before.exists():
            before.replace(folder)
        raise


def _carry_over(outgoing: Path, folder: Path, say: Say) -> None:
    """Move the user's files over from the folder of an earlier package, and remove that."""
    knows_its_own = record_of(outgoing) is not None  # else `_move_in` was interrupted, and these may be of a package
    for name in sorted(_foreign(outgoing), key=lambda name: (folder / name).exists()):  # names that stay first
        is_lost = knows_its_own and not _is_equal(outgoing / name, folder / name)
        if is_lost or not (folder / name).exists():
            _set_aside(outgoing / name, folder, name, say)
    remove_tree(outgoing)


def _set_aside(path: Path, folder: Path, name: Path, say: Say) -> None:
    """Move a file of the user to `name` in a folder, or to a similar name if a package has something there."""
    place = _free_name(folder, name)
    (folder / place).parent.mkdir(parents=True, exist_ok=True)
    path.replace(folder / place)
    if place != name:
        say(f"your own file {name} in {folder} is {place} now: the asset has a file of that name")


def _free_name(folder: Path, name: Path) -> Path:
    """Return a name, or a similar one if it is taken, or if a file has the name of a folder above it."""
    if _is_free(folder, name):
        return name
    taken = next((up for up in reversed(name.parents) if (folder / up).is_file()), name)
    numbered = (f".mine{'' if number == 1 else f'-{number}'}" for number in itertools.count(1))
    others = (taken.with_name(f"{taken.stem}{mark}{taken.suffix}") / name.relative_to(taken) for mark in numbered)
    return next(other for other in others if _is_free(folder, other))


def _is_free(folder: Path, name: Path) -> bool:
    """Return true if nothing has the name, and no file that of a folder above it."""
    return not (folder / name).exists() and not any((folder / up).is_file() for up in name.parents)


def _move_in(staging: Path, folder: Path, before: Path, say: Say) -> None:
    """Move the old files to `before` and the new ones in, one by one, for folders that cannot be renamed.

    The record goes last, so that an interrupted swap is recognized.
    """
    new = sorted(p.relative_to(staging) for p in staging.rglob("*") if p.is_file())
    new.sort(key=lambda name: name == Path(RECORD))
    ours = _ours(folder)
    for name in [*sorted(Path(old) for old in ours - {n.as_posix() for n in new}), *new]:
        if name.as_posix() not in ours:
            _rename_user_files(staging, folder, name, say)
        if (folder / name).exists():
            (before / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).replace(before / name)
        if (staging / name).exists():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (staging / name).replace(folder / name)


def _rename_user_files(staging: Path, folder: Path, name: Path, say: Say) -> None:
    """Rename the user's files that have the name of a new file, or of its folder; equal files may be replaced."""
    for place in (*reversed(name.parents), name):
        mine, new = folder / place, staging / place
        if mine.exists() and not (mine.is_dir() and new.is_dir()) and not _is_equal(mine, new):
            _set_aside(mine, folder, place, say)


def _is_equal(one: Path, other: Path) -> bool:
    """Return true if both are files with the same content."""
    return one.is_file() and other.is_file() and filecmp.cmp(one, other, shallow=False)


def _foreign(folder: Path) -> list[Path]:
    """List the files that no package brought, relative to the folder."""
    ours = _ours(folder)
    files = (p.relative_to(folder) for p in folder.rglob("*") if p.is_file() or p.is_symlink())
    return sorted(f for f in files if f.as_posix() not in ours)


def _ours(folder: Path) -> set[str]:
    """Return the files that the package in a folder brought."""
    record = record_of(folder)
    return set() if record is None else {*record["files"], *record.get("beside", ()), RECORD}


def _first_missing(folder: Path) -> Path | None:
    """Return the outermost folder that has to be created; None if there is none."""
    missing = None
    while not folder.exists():
        missing, folder = folder, folder.parent
    return missing


def _remove_empty(made: Path | None) -> None:
    """Remove the empty folders that a failed run created."""
    if made is None:
        return
    for folder in [*sorted((p for p in made.rglob("*") if p.is_dir()), reverse=True), made]:
        with suppress(OSError):
            folder.rmdir()
