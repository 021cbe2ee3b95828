"""The one place that writes to the user's folder: a package appears there whole, or not at all."""

import errno
import hashlib
import json
import os
import shutil
import tempfile
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any

from dg4d_lib.errors import BadInput
from steps.store import remove_tree, room_for

RECORD = "provenance.json"
CANNOT_SWAP = {errno.EBUSY, errno.EXDEV, errno.EACCES, errno.EPERM, errno.EROFS, errno.EINVAL}

Files = dict[str, dict[str, Any]]  # path within the package -> {"digest", "size_bytes"}


def check_folder(folder: Path) -> None:
    """Refuse a folder that cannot be written to, or that holds something else than a package.

    Raises:
        BadInput: says what is in the way and what to do.
    """
    if folder.exists() and not folder.is_dir():
        raise BadInput(f"{folder} is a file; choose a folder for the output with -o")
    if folder.is_dir() and record_of(folder) is None:
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


def record_of(folder: Path) -> dict[str, Any] | None:
    """The provenance of the package in a folder; None if there is no package."""
    try:
        record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        return record if isinstance(record["files"], dict) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def is_current(folder: Path, order: str) -> bool:
    """Whether a folder holds the package of an order (its digest), with every byte as it was written."""
    record = record_of(folder)
    if record is None or record.get("order") != order:
        return False
    try:
        return all(_fact(folder / name) == fact for name, fact in record["files"].items())
    except OSError:
        return False


def publish(package: Path, folder: Path, describe: Callable[[Files], dict[str, str]]) -> Files:
    """Unpack a package beside `folder`, describe it, and put it in the place of what is there.

    Files in `folder` that no package brought stay. If anything fails, `folder` is as it was.

    Args:
        package: the zip that `pack_asset` made.
        folder: where the user wants it.
        describe: gives the texts of the files that go with the package, by name; one of them is the record.

    Raises:
        DiskFull: there is no room.
        BadInput: the folder cannot be written.
    """
    folder = folder.resolve()
    missing = _first_missing(folder)
    try:
        with room_for(folder):
            try:
                return _publish(package, folder, describe)
            except OSError as error:
                if error.errno not in CANNOT_SWAP or not folder.is_dir():
                    raise
                return _publish(package, folder, describe, in_place=True)
    except OSError as error:
        _tidy(missing)
        raise BadInput(f"the output folder {folder} cannot be written: {error.strerror or error}") from error
    except BaseException:
        _tidy(missing)
        raise


def readable(size_bytes: int) -> str:
    """A size for people."""
    return f"{size_bytes / 1e6:.1f} MB" if size_bytes >= 100_000 else f"{size_bytes / 1e3:.1f} kB"


def _publish(package: Path, folder: Path, describe: Callable[[Files], dict[str, str]], in_place: bool = False) -> Files:
    place = folder if in_place else folder.parent
    place.mkdir(parents=True, exist_ok=True)
    _recover(folder, place)
    staging = place / f".{folder.name}.incoming-{os.getpid()}"
    remove_tree(staging)
    try:
        staging.mkdir()
        files = _unpacked(package, staging)
        for name, text in describe(files).items():
            (staging / name).write_text(text, encoding="utf-8")
        if in_place or _contains(folder, Path.cwd()):
            _move_in(staging, folder)
        else:
            _swap(staging, folder)
        return files
    finally:
        remove_tree(staging)


def _unpacked(package: Path, folder: Path) -> Files:
    files: Files = {}
    with zipfile.ZipFile(package) as archive:
        for entry in sorted(archive.infolist(), key=lambda e: e.filename):
            name = PurePosixPath(entry.filename)
            if entry.is_dir():
                continue
            if name.is_absolute() or ".." in name.parts:
                raise BadInput(f"the package has an entry outside itself: {entry.filename}")
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            with archive.open(entry) as source, target.open("wb") as file:
                shutil.copyfileobj(source, file)
            files[name.as_posix()] = _fact(target)
    return files


def _fact(path: Path) -> dict[str, Any]:
    with path.open("rb") as file:
        return {
            "digest": f"sha256:{hashlib.file_digest(file, 'sha256').hexdigest()}",
            "size_bytes": path.stat().st_size,
        }


def _swap(staging: Path, folder: Path) -> None:
    """Two renames; then the user's own files move over from the old folder."""
    if not folder.exists():
        staging.replace(folder)
        return
    outgoing = folder.with_name(f".{folder.name}.outgoing-{os.getpid()}")
    theirs = _foreign(folder)
    folder.replace(outgoing)
    try:
        staging.replace(folder)
    except OSError:
        outgoing.replace(folder)
        raise
    _carry_over(theirs, outgoing, folder)


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


def _move_in(staging: Path, folder: Path) -> None:
    """File by file, where the folder itself cannot be renamed; the record last, so that a half is known as one."""
    before = set((record_of(folder) or {"files": {}})["files"])
    fresh = sorted(p.relative_to(staging) for p in staging.rglob("*") if p.is_file())
    for name in sorted(fresh, key=lambda n: n == Path(RECORD)):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (staging / name).replace(folder / name)
    for name in before - {f.as_posix() for f in fresh}:
        (folder / name).unlink(missing_ok=True)


def _foreign(folder: Path) -> list[Path]:
    """Files that no package brought, relative to the folder."""
    record = record_of(folder)
    ours = set() if record is None else {*record["files"], *record.get("beside", ()), RECORD}
    files = (p.relative_to(folder) for p in folder.rglob("*") if p.is_file() or p.is_symlink())
    return sorted(f for f in files if f.as_posix() not in ours)


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
