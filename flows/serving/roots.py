"""Allow-lists of the folders and object store prefixes that deployments may read and write.

Every user of the server can fill in the forms. The user of the worker's machine decides which folders they may name:
`$DG4D_SOURCES` and `$DG4D_OUTPUTS` of the worker, the folders of a running `dg4d watch` of the same user, and those of
the studio page.
"""

import json
import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from dg4d_lib.errors import BadInput
from dg4d_lib.weights.registry import KNOWN
from flows.home import studio_assets, uploads
from flows.inputs.listing import BUCKET, WILDCARDS
from flows.inputs.manifest import Item
from flows.processes import locked
from flows.serving import background
from steps.contract import Frozen
from steps.runtime.weights import weights_home, weights_in
from steps.store.files import home as home_folder

SOURCES, OUTPUTS = "DG4D_SOURCES", "DG4D_OUTPUTS"
SEPARATOR = re.compile(rf"{re.escape(os.pathsep)}(?!//)")  # except in s3://BUCKET


class Roots(Frozen):
    """Folders and `s3://BUCKET/PREFIX` that deployments may read, and folders they may write; links are resolved."""

    sources: tuple[str, ...]
    outputs: tuple[str, ...]

    @classmethod
    def of_this_process(cls) -> "Roots":
        """Return the roots from the environment, and those of running `dg4d watch` commands.

        Default of `$DG4D_SOURCES` is the current folder, which is new and empty in each run of a process worker; the
        default of `$DG4D_OUTPUTS` are the folders among the sources.
        """
        sources = _sources()
        outputs = _split_roots(os.environ.get(OUTPUTS, "")) or _folders(sources)
        granted = [*_studio_roots(), *_granted_roots()]
        return cls(
            sources=(*sources, *(place for roots in granted for place in roots.sources)),
            outputs=(*outputs, *(place for roots in granted for place in roots.outputs)),
        )

    def source(self, address: str) -> str:
        """Return the address of a source that may be read; hosts of web addresses are checked on download.

        Raises:
            BadInput: it is outside of the roots.
        """
        return address if "://" in address and not address.startswith(BUCKET) else self.folder(address)

    def inputs(self, given: str) -> str:
        """Return a folder, a manifest, a pattern or a prefix of an object store that may be read.

        Raises:
            BadInput: it is outside of the roots.
        """
        parts = Path(given).parts
        first = next((i for i, part in enumerate(parts) if WILDCARDS & set(part)), len(parts))
        if given.startswith(BUCKET) or first == len(parts) or _exists(given):
            return self.folder(given)
        if ".." in parts[first:]:
            raise BadInput(f"the pattern {given!r} leads back by '..' after a wildcard; write it without")
        return str(Path(self.folder(str(Path(*parts[:first]))), *parts[first:]))

    def folder(self, given: str) -> str:
        """Return a path, or a place in an object store, that may be read.

        Raises:
            BadInput: it is outside of the roots.
        """
        if given.startswith(BUCKET):
            if not any(_is_below_prefix(given, root) for root in self.sources if root.startswith(BUCKET)):
                raise _refusal(given, "read", self.sources, SOURCES)
            return given
        return str(_inside(given, _folders(self.sources), _refusal(given, "read", self.sources, SOURCES)))

    def output(self, given: str) -> Path:
        """Return a folder that may be written.

        Raises:
            BadInput: it is outside of the roots.
        """
        return _inside(given, self.outputs, _refusal(given, "write", self.outputs, OUTPUTS))

    def check_files(self, paths: Iterable[Path]) -> None:
        """Refuse files outside of the sources, after links are resolved.

        Raises:
            BadInput: a file is outside.
        """
        for path in paths:
            self.folder(str(path))

    def check_item(self, item: Item) -> None:
        """Refuse an item of a batch whose files or weights may not be read.

        Raises:
            BadInput: a file or folder is outside.
        """
        if item.request is None:
            return
        asked = item.request
        own = (asked.video, asked.bank, asked.mask, asked.depth, asked.layers, asked.asset)
        files = (None if item.remote else asked.picture, *own)
        self.check_files(file for file in (*files, *asked.given_views.files()) if file is not None)
        self.check_weights(item.request.settings.model_dump(mode="json"))

    def check_settings(self, settings: Mapping[str, Any]) -> None:
        """Refuse settings such as `prior.weights` that name folders of weights which may not be read.

        Raises:
            BadInput: a folder is outside.
        """
        for name, value in settings.items():
            self.check_weights({name.rpartition(".")[2]: value})

    def check_weights(self, tree: Mapping[str, Any]) -> None:
        """Refuse a settings tree that names folders of weights which may not be read.

        Raises:
            BadInput: a folder is outside.
        """
        for name in weights_in(tree):
            if name not in KNOWN and _may_be_path(name):
                roots = (*self.sources, str(weights_home().resolve()))
                _inside(name, _folders(roots), _refusal(f"the folder of weights {name}", "read", roots, SOURCES))


def environment(given: Iterable[str] = ()) -> dict[str, str]:
    """Return the environment variables that grant a worker these roots.

    Args:
        given: folders or `s3://BUCKET/PREFIX`; default: `$DG4D_SOURCES`, else the current folder.

    Raises:
        BadInput: one is not a folder, or its path contains the separator, also after links are resolved.
    """
    selected = tuple(given)
    for place in selected:
        if not place.startswith(BUCKET) and not Path(place).is_dir():
            raise BadInput(f"--sources {place} is not a folder; give one, or s3://BUCKET/PREFIX")
    sources = _resolve(selected) or _sources()
    outputs = _split_roots(os.environ.get(OUTPUTS, "")) or _folders(sources)
    for place in (*sources, *outputs):
        if SEPARATOR.search(place):
            raise BadInput(
                f"{place} contains {os.pathsep!r}, which separates folders; rename it, or give another as --sources"
            )
    return {SOURCES: os.pathsep.join(sources), OUTPUTS: os.pathsep.join(outputs)}


@contextmanager
def granted(folder: Path, out: Path) -> Iterator[None]:
    """Let deployments of this user read one folder and write another while the block runs.

    The grant is a locked file that only this user can write; the lock ends with this process.
    """
    _grants().mkdir(mode=0o700, parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix="watch-", suffix=".new", dir=_grants())  # mode 0600
    os.close(handle)
    place = Path(name).with_suffix(".json")
    with locked(Path(name)):
        roots = Roots(sources=_resolve([str(folder)]), outputs=_resolve([str(out)]))
        Path(name).write_text(roots.model_dump_json(), encoding="utf-8")
        Path(name).rename(place)
        try:
            yield
        finally:
            place.unlink(missing_ok=True)


def _studio_roots() -> Iterator[Roots]:
    """Yield the folders of the studio page, once it was used: its uploads are read, its packages written."""
    if uploads().is_dir():
        yield Roots(sources=_resolve([str(uploads())]), outputs=_resolve([str(studio_assets())]))


def _granted_roots() -> Iterator[Roots]:
    """Yield the grants of running processes; remove those of processes that have ended."""
    for file in sorted(_grants().glob("*.json")):
        with locked(file, shared=True) as ended:
            if ended:
                file.unlink(missing_ok=True)
            elif file.stat().st_uid == os.getuid():
                yield Roots.model_validate(json.loads(file.read_text(encoding="utf-8")))


def _grants() -> Path:
    return background.background_server().folder / "grants"


def _sources() -> tuple[str, ...]:
    """Return the roots of `$DG4D_SOURCES`, else the current folder, whose path may contain the separator."""
    given = os.environ.get(SOURCES)
    return _split_roots(given) if given else _resolve([str(Path.cwd())])


def _split_roots(text: str) -> tuple[str, ...]:
    """Split the value of a variable into resolved roots."""
    return _resolve(place for place in SEPARATOR.split(text) if place)


def _resolve(places: Iterable[str]) -> tuple[str, ...]:
    return tuple(
        place.rstrip("/") if place.startswith(BUCKET) else str(Path(place).expanduser().resolve()) for place in places
    )


def _folders(places: Iterable[str]) -> tuple[str, ...]:
    return tuple(place for place in places if not place.startswith(BUCKET))


def _inside(given: str, roots: Iterable[str], refusal: BadInput) -> Path:
    """Resolve a path; raise the refusal unless it is in or below a root and outside of `$DG4D_HOME`."""
    try:
        path = Path(given).expanduser().resolve()
    except (OSError, RuntimeError, ValueError) as error:  # circular links, an unknown user, a NUL
        raise refusal from error
    own = home_folder().resolve()
    for root in map(Path, roots):
        if path.is_relative_to(root) and (root.is_relative_to(own) or not path.is_relative_to(own)):
            return path
    raise refusal


def _exists(given: str) -> bool:
    try:
        return Path(given).exists()
    except (OSError, ValueError):  # too long, or with a NUL
        return False


def _is_below_prefix(address: str, root: str) -> bool:
    parts, above = address.rstrip("/").split("/"), root.split("/")
    return parts[: len(above)] == above and not {".", ".."} & {unquote(part) for part in parts}


def _may_be_path(name: str) -> bool:
    return name.startswith((".", "~", "/")) or name.count("/") > 1 or _exists(name)


def _refusal(given: str, verb: str, roots: Iterable[str], variable: str) -> BadInput:
    return BadInput(
        f"{given} lies outside of what deployments of this worker may {verb}: {', '.join(roots) or 'nothing'}; name a "
        f"place there, or set {variable} of the worker (`dg4d up --sources DIR`)"
    )
