"""Pictures and videos of a batch without a manifest: in a folder, by a pattern, or in an object store."""

import functools
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, NamedTuple, cast

from dg4d_lib.errors import BadInput
from flows.inputs import sources
from flows.inputs.package_record import record_of
from steps.artifacts.archives import stays_inside
from steps.store.files import walk
from steps.store.opening import open_store

if TYPE_CHECKING:
    from steps.store.bucket import BucketStore

SUFFIXES = sources.PICTURES | sources.VIDEOS
WILDCARDS = frozenset("*?[")
BUCKET = "s3://"


class Found(NamedTuple):
    """Picture or video.

    Attributes:
        name: path relative to the given folder, with slashes and suffix.
        path: local path; of an object in a store, its last name.
        remote: key of such an object.
        error: reason why it cannot be used; empty if none is known.
    """

    name: str
    path: Path
    remote: str = ""
    error: str = ""


def list_folder(folder: Path, out: Path) -> list[Found]:
    """List a folder recursively, by name, without packages, hidden files and `out`."""
    return _media(folder, walk(folder), out)


def list_pattern(pattern: str, out: Path) -> list[Found]:
    """List the matches of a pattern such as photos/**/*.png, named relative to its last plain folder.

    Raises:
        BadInput: that folder does not exist, or the pattern is invalid.
    """
    parts = Path(pattern).parts
    first = next(i for i, part in enumerate(parts) if WILDCARDS & set(part))
    base = Path(*parts[:first])
    if not base.is_dir():
        state = "is not a folder" if base.exists() else "does not exist"
        raise BadInput(f"the pattern {pattern!r} matches nothing: {base} {state}")
    try:
        matches = (path for path in base.glob("/".join(parts[first:])) if not path.is_dir())
        return _media(base, matches, out)
    except ValueError as error:
        raise BadInput(f"{pattern!r} is not a pattern such as 'photos/**/*.png': {error}") from error


def list_bucket(address: str) -> list[Found]:
    """List everything below `s3://BUCKET/PREFIX`, by name, without fetching it.

    Raises:
        BadInput: the bucket does not exist, or the address is malformed.
        BackendUnavailable: the store refuses access, or does not answer.
    """
    try:
        entries = sorted(_bucket(address).entries(""))
    except FileNotFoundError as error:
        raise BadInput(f"{address}: there is no such bucket") from error
    found = []
    for entry in entries:
        name = PurePosixPath(entry.name)
        if name.suffix.lower() not in SUFFIXES or any(part.startswith(".") and part != ".." for part in name.parts):
            continue
        fault = ""
        if not stays_inside(entry.name):
            fault = f"the name of the object {entry.name!r} leads out of {address}"
        elif entry.size_bytes > sources.LARGEST_FILE_BYTES:
            fault = f"{entry.name} has {entry.size_bytes} bytes; at most {sources.LARGEST_FILE_BYTES} are read"
        found.append(Found(entry.name, Path(name.name), entry.name, fault))
    return found


@contextmanager
def fetch_object(address: str, key: str, name: str) -> Iterator[Path]:
    """Yield an object as a temporary file.

    Args:
        address: as given to `list_bucket`.
        key: of the object, relative to the address.
        name: of the file.

    Raises:
        BadInput: the object is gone, or the disk is full.
        BackendUnavailable: the store refuses access, or does not answer.
    """
    with tempfile.TemporaryDirectory(prefix="dg4d-object-") as folder:
        path = Path(folder) / name
        try:
            _bucket(address).fetch(key, path, sources.LARGEST_FILE_BYTES)
        except FileNotFoundError as error:
            raise BadInput(f"{key} is not in {address} any more") from error
        yield path


def _bucket(address: str) -> "BucketStore":
    if not address.startswith(BUCKET):
        raise BadInput(f"{address!r} is not of the form s3://BUCKET/PREFIX")
    return cast("BucketStore", open_store(address.rstrip("/")))


def _media(folder: Path, paths: Iterable[Path], out: Path) -> list[Found]:
    own = {out.absolute(), out.resolve()}
    is_package = functools.cache(lambda place: record_of(place) is not None)
    found = []
    for path in sorted(set(paths)):
        name = path.relative_to(folder)
        linked = path.is_symlink() and path.is_dir()  # not followed: an error says that its files are left out
        is_media = path.suffix.lower() in SUFFIXES and path.is_file()
        if not (linked or is_media) or any(part[0] == "." for part in name.parts):
            continue
        if own & {*path.parents, *path.absolute().parents} or any(is_package(folder / up) for up in name.parents):
            continue
        if linked and (own & {path.absolute(), path.resolve()} or is_package(path)):
            continue
        try:
            place = sources.resolve_inside(folder, name.as_posix(), "the folder" if linked else "the file")
        except BadInput as error:
            found.append(Found(name.as_posix(), path, error=str(error)))
        else:
            if not linked:  # files of a linked folder that leads inside are listed at their own place
                found.append(Found(name.as_posix(), place))
    return found
