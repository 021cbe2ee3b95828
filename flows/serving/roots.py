"""Folders and prefixes of object stores that deployments may read, and folders that they may write.

Whoever reaches the server fills in the forms; which folders they may name, the user of the worker's machine says:
`$DG4D_SOURCES` and `$DG4D_OUTPUTS` of the worker, and what a `dg4d watch` of the same user watches at the moment.
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
from flows.inputs.listing import BUCKET, WILD
from flows.inputs.manifest import Item
from flows.processes import locked
from flows.serving import background
from steps.contract import Frozen
from steps.runtime.weights import weights_home, weights_in
from steps.store.files import home as home_folder

SOURCES, OUTPUTS = "DG4D_SOURCES", "DG4D_OUTPUTS"
SEPARATOR = re.compile(rf"{re.escape(os.pathsep)}(?!//)")  # not the one in s3://BUCKET


class Roots(Frozen):
    """Places that a deployment may read and write, links resolved.

    Attributes:
        sources: folders, and `s3://BUCKET/PREFIX`.
        outputs: folders.
    """

    sources: tuple[str, ...]
    outputs: tuple[str, ...]

    @classmethod
    def of_this_process(cls) -> "Roots":
        """Read the environment, and the folders that are watched at the moment.

        Without `$DG4D_SOURCES` it is the current folder, which Prefect makes anew, and empty, for each run of a process
        worker; without `$DG4D_OUTPUTS`, the folders among the sources.
        """
        sources = _places(os.environ.get(SOURCES) or str(Path.cwd()))
        outputs = _places(os.environ.get(OUTPUTS, "")) or _folders(sources)
        granted = list(_granted())
        return cls(
            sources=(*sources, *(place for roots in granted for place in roots.sources)),
            outputs=(*outputs, *(place for roots in granted for place in roots.outputs)),
        )

    def source(self, address: str) -> str:
        """Return the address of a source that may be read; of web servers, fetching checks the host.

        Raises:
            BadInput: it lies elsewhere.
        """
        return address if "://" in address and not address.startswith(BUCKET) else self.folder(address)

    def inputs(self, given: str) -> str:
        """Return a folder, a manifest, a pattern or a prefix of an object store that may be read.

        Raises:
            BadInput: it lies elsewhere.
        """
        parts = Path(given).parts
        first = next((i for i, part in enumerate(parts) if WILD & set(part)), len(parts))
        if given.startswith(BUCKET) or first == len(parts) or _exists(given):
            return self.folder(given)
        if ".." in parts[first:]:
            raise BadInput(f"the pattern {given!r} leads back by '..' after a wildcard; write it without")
        return str(Path(self.folder(str(Path(*parts[:first]))), *parts[first:]))

    def folder(self, given: str) -> str:
        """Return a path, or a place in an object store, that may be read.

        Raises:
            BadInput: it lies elsewhere.
        """
        if given.startswith(BUCKET):
            if not any(_is_below_prefix(given, root) for root in self.sources if root.startswith(BUCKET)):
                raise _refusal(given, "read", self.sources, SOURCES)
            return given
        return str(_inside(given, _folders(self.sources), _refusal(given, "read", self.sources, SOURCES)))

    def output(self, given: str) -> Path:
        """Return a folder that may be written.

        Raises:
            BadInput: it lies elsewhere.
        """
        return _inside(given, self.outputs, _refusal(given, "write", self.outputs, OUTPUTS))

    def check_files(self, paths: Iterable[Path]) -> None:
        """Refuse files that may not be read; links lead where they lead.

        Raises:
            BadInput: says which.
        """
        for path in paths:
            self.folder(str(path))

    def check_item(self, item: Item) -> None:
        """Refuse an item of a batch whose files or weights may not be read.

        Raises:
            BadInput: says which.
        """
        if item.request is None:
            return
        files = (None if item.remote else item.request.picture, item.request.video, item.request.bank)
        self.check_files(file for file in files if file is not None)
        self.check_weights(item.request.settings.model_dump(mode="json"))

    def check_knobs(self, knobs: Mapping[str, Any]) -> None:
        """Refuse knobs, as `prior.weights`, that name folders of weights which may not be read.

        Raises:
            BadInput: says which.
        """
        for knob, value in knobs.items():
            self.check_weights({knob.rpartition(".")[2]: value})

    def check_weights(self, tree: Mapping[str, Any]) -> None:
        """Refuse a dumped settings tree that names folders of weights which may not be read.

        Raises:
            BadInput: says which.
        """
        for name in weights_in(tree):
            if name not in KNOWN and _may_be_path(name):
                roots = (*self.sources, str(weights_home().resolve()))
                _inside(name, _folders(roots), _refusal(f"the folder of weights {name}", "read", roots, SOURCES))


def environment(given: Iterable[str] = ()) -> dict[str, str]:
    """Return the variables of a worker whose deployments may read, and write, these places.

    Args:
        given: folders, or `s3://BUCKET/PREFIX`; default: `$DG4D_SOURCES`, else the current folder.

    Raises:
        BadInput: one is no folder, or cannot be named in a variable.
    """
    chosen = tuple(given)
    for place in chosen:
        if not place.startswith(BUCKET) and not Path(place).is_dir():
            raise BadInput(f"--sources {place} is no folder; give one, or s3://BUCKET/PREFIX")
        if SEPARATOR.search(place):
            raise BadInput(f"--sources {place} has {os.pathsep!r} in its name, which separates folders; give another")
    sources = _resolved(chosen) or _places(os.environ.get(SOURCES) or str(Path.cwd()))
    outputs = _places(os.environ.get(OUTPUTS, "")) or _folders(sources)
    return {SOURCES: os.pathsep.join(sources), OUTPUTS: os.pathsep.join(outputs)}


@contextmanager
def granted(folder: Path, out: Path) -> Iterator[None]:
    """Let deployments of this user read one folder, and write another, as long as the block runs.

    A file says so, which only this user can write; its lock ends with this process, however that ends.
    """
    _grants().mkdir(mode=0o700, parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix="watch-", suffix=".new", dir=_grants())  # mode 0600
    os.close(handle)
    place = Path(name).with_suffix(".json")
    with locked(Path(name)):
        roots = Roots(sources=_resolved([str(folder)]), outputs=_resolved([str(out)]))
        Path(name).write_text(roots.model_dump_json(), encoding="utf-8")
        Path(name).rename(place)
        try:
            yield
        finally:
            place.unlink(missing_ok=True)


def _granted() -> Iterator[Roots]:
    """Read what others grant at the moment, and remove what is left of those who have ended."""
    for file in sorted(_grants().glob("*.json")):
        with locked(file, shared=True) as ended:
            if ended:
                file.unlink(missing_ok=True)
            elif file.stat().st_uid == os.getuid():
                yield Roots.model_validate(json.loads(file.read_text(encoding="utf-8")))


def _grants() -> Path:
    return background.background_server().folder / "grants"


def _places(text: str) -> tuple[str, ...]:
    """Split a variable into places."""
    return _resolved(place for place in SEPARATOR.split(text) if place)


def _resolved(places: Iterable[str]) -> tuple[str, ...]:
    return tuple(
        place.rstrip("/") if place.startswith(BUCKET) else str(Path(place).expanduser().resolve()) for place in places
    )


def _folders(places: Iterable[str]) -> tuple[str, ...]:
    return tuple(place for place in places if not place.startswith(BUCKET))


def _inside(given: str, roots: Iterable[str], refusal: BadInput) -> Path:
    """Return a path without links; raise the refusal unless it lies in or below a root, and not in our own folder."""
    try:
        path = Path(given).expanduser().resolve()
    except (OSError, RuntimeError, ValueError) as error:  # a circle of links, nobody's home, a NUL
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
