"""The files of a batch that has no manifest: in a folder, by a pattern, or in an object store."""

import functools
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, NamedTuple, cast

from dg4d_lib.errors import BadInput
from flows.inputs import sources
from flows.packages.publish import record_of
from steps.artifacts.archives import stays_inside
from steps.store.opening import open_store

if TYPE_CHECKING:
    from steps.store.bucket import BucketStore

WANTED = sources.PICTURES | sources.VIDEOS
WILD = frozenset("*?[")
BUCKET = "s3://"


class Found(NamedTuple):
    """A picture or a video.

    Attributes:
        name: its place below what was given, with slashes and suffix.
        path: where it is; of an object in a store, its last name.
        remote: the address of such an object.
        error: why it cannot be used; empty if nothing is known against it.
    """

    name: str
    path: Path
    remote: str = ""
    error: str = ""


def in_folder(folder: Path, out: Path) -> list[Found]:
    """Everything in a folder and its folders, by name, but for packages, hidden files and `out`."""
    return _wanted(folder, folder.rglob("*"), out)


def by_pattern(pattern: str, out: Path) -> list[Found]:
    """What a pattern such as photos/**/*.png matches; named from its first folder without a wildcard on.

    Raises:
        BadInput: that folder does not exist.
    """
    parts = Path(pattern).parts
    first = next(i for i, part in enumerate(parts) if WILD & set(part))
    base = Path(*parts[:first])
    if not base.is_dir():
        raise BadInput(f"{base}, where the pattern {pattern!r} begins, is not a folder")
    try:
        return _wanted(base, base.glob("/".join(parts[first:])), out)
    except ValueError as error:
        raise BadInput(f"{pattern!r} is not a pattern such as 'photos/**/*.png': {error}") from error


def in_bucket(address: str) -> list[Found]:
    """Everything below `s3://BUCKET/PREFIX`, by name; nothing is fetched.

    Raises:
        BadInput: there is no such bucket, or that is no address of one.
        BackendUnavailable: it refuses access, or does not answer.
    """
    try:
        entries = sorted(_bucket(address).entries(""))
    except FileNotFoundError as error:
        raise BadInput(f"{address}: there is no such bucket") from error
    found = []
    for entry in entries:
        name = PurePosixPath(entry.name)
        if name.suffix.lower() not in WANTED or any(part.startswith(".") and part != ".." for part in name.parts):
            continue
        trouble = ""
        if not stays_inside(entry.name):
            trouble = f"the object {entry.name!r} is named as if it lay outside of {address}"
        elif entry.size_bytes > sources.LARGEST_FILE_BYTES:
            trouble = f"{entry.name} has {entry.size_bytes} bytes; at most {sources.LARGEST_FILE_BYTES} are read"
        found.append(Found(entry.name, Path(name.name), entry.name, trouble))
    return found


@contextmanager
def fetched(address: str, found: str, name: str) -> Iterator[Path]:
    """An object as a file called `name`, as long as the block runs.

    Args:
        address: as given to `in_bucket`.
        found: the object, `Found.remote`.
        name: of the file.

    Raises:
        BadInput: it is not there any more, or there is no room.
        BackendUnavailable: the store refuses access, or does not answer.
    """
    with tempfile.TemporaryDirectory(prefix="dg4d-object-") as folder:
        path = Path(folder) / name
        try:
            _bucket(address).fetch(found, path, sources.LARGEST_FILE_BYTES)
        except FileNotFoundError as error:
            raise BadInput(f"{found} is not in {address} any more") from error
        yield path


def _bucket(address: str) -> "BucketStore":
    if not address.startswith(BUCKET):
        raise BadInput(f"{address!r} is not of the form s3://BUCKET/PREFIX")
    return cast("BucketStore", open_store(address.rstrip("/")))


def _wanted(folder: Path, paths: Iterable[Path], out: Path) -> list[Found]:
    own = {out.absolute(), out.resolve()}
    is_package = functools.cache(lambda place: record_of(place) is not None)
    found = []
    for path in sorted(set(paths)):
        name = path.relative_to(folder)
        if path.suffix.lower() not in WANTED or not path.is_file() or any(part.startswith(".") for part in name.parts):
            continue
        if own & {*path.parents, *path.absolute().parents} or any(is_package(folder / up) for up in name.parents):
            continue
        try:
            found.append(Found(name.as_posix(), sources.inside(folder, name.as_posix(), "the file")))
        except BadInput as error:
            found.append(Found(name.as_posix(), path, error=str(error)))
    return found
