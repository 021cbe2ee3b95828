"""Items of a batch: rows of a manifest, or the files of a folder, a pattern or an object store."""

import json
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from dg4d_lib.errors import BadInput, DG4DError, quoted
from dg4d_lib.input_settings import BOX_FORM
from flows.formatting.escaping import visible
from flows.inputs import listing, sources
from flows.inputs.conversion_job import ConversionRequest, name_from_text
from flows.inputs.given_views import ViewsRequest, views_in_cell
from flows.inputs.json_text import UnfitJSON, loads
from flows.inputs.naming import check_path, clean_name, unique_names
from flows.inputs.rows import MANIFESTS, ManifestRow, read_rows
from flows.inputs.setting_reference import check_changes
from steps.contract import LARGEST_SEED, Frozen
from steps.profiles import PipelineSettings, profile, revise

INPUTS = (
    "a folder of pictures and videos, a pattern such as 'photos/**/*.png', an object store (s3://BUCKET/PREFIX), or a "
    f"manifest ({', '.join(MANIFESTS)})"
)
HIGHEST_PRIORITY = 10**9
TEXTS = (  # columns
    "path", "text", "video", "asset", "name", "profile", "bank", "mask", "box", "depth", "layers", "views", "turntable",
    "cameras",
)  # fmt: skip
BOX_NUMBER = re.compile(r"[0-9]{1,7}")
INTEGER = re.compile(r"[+-]?[0-9]{1,100}(\.0*)?")


class Item(Frozen):
    """Item of a batch.

    Attributes:
        name: folder of its package, within that of the batch.
        request: request; None if the item is faulty.
        error: reason why it is.
        priority: items with a higher one are made earlier.
        store: address of the object store that has the source; empty for local files.
        remote: key of the source in that store.
    """

    name: str
    request: ConversionRequest | None = None
    error: str = ""
    priority: int = 0
    store: str = ""
    remote: str = ""

    @contextmanager
    def fetch(self) -> Iterator[ConversionRequest]:
        """Yield the request with local files; a fetched object is removed afterwards.

        Raises:
            BadInput: the item is faulty, or the object is gone.
            BackendUnavailable: the object store does not answer.
        """
        if self.request is None:
            raise BadInput(self.error)
        if self.request.picture is None or not self.remote:
            yield self.request
            return
        with listing.fetch_object(self.store, self.remote, self.request.picture.name) as path:
            yield self.request.model_copy(update={"picture": path})


def items_of(
    inputs: str | Path,
    out: Path,
    profile_name: str,
    changes: Mapping[str, Any],
    seed: int,
    root: Path | None = None,
) -> list[Item]:
    """Return the items of a folder (recursively, without `out`), a pattern, an object store or a manifest.

    Items are sorted by priority, then by name, or as in the manifest.

    Args:
        inputs: argument of the user.
        out: folder of the packages.
        profile_name: of items that do not name one.
        changes: settings changed for all items.
        seed: of items that do not have one.
        root: folder that contains a manifest's files; default: the folder of the manifest.

    Raises:
        BadInput: there are no items, or the manifest as a whole cannot be read.
        BackendUnavailable: the object store does not answer, or Parquet support is not installed.
    """
    settings = revise(profile(profile_name), dict(changes))
    path, given = Path(inputs), str(inputs)
    check_path(path)
    if path.is_file() and path.suffix.lower() in MANIFESTS:
        reader = _Reader(root or path.parent, profile_name, changes, seed)
        return sorted(reader.items(path), key=lambda item: -item.priority)
    if root is not None:
        raise BadInput(f"--root names the folder of a manifest's files, and {given} is not a manifest")
    if given.startswith(listing.BUCKET):
        found = listing.list_bucket(given)
    elif path.is_dir():
        found = listing.list_folder(path, out)
    elif path.exists():
        raise BadInput(
            f"{given} is neither a folder nor a manifest ({', '.join(MANIFESTS)}); for one file use `dg4d make`"
        )
    elif listing.WILDCARDS & set(given):
        found = listing.list_pattern(given, out)
    else:
        raise BadInput(f"{given} does not exist; give {INPUTS}")
    if not found:
        raise BadInput(f"{given} holds no pictures or videos ({', '.join(sorted(listing.SUFFIXES))})")
    common = ConversionRequest(item="", profile=profile_name, settings=settings, seed=seed)
    return [_item(name, file, given, common) for name, file in zip(_names(found), found, strict=True)]


def admitted(items: list[Item], allow: Callable[[Item], None]) -> list[Item]:
    """Return the items; those for which `allow` raises BadInput become faulty."""
    found = []
    for item in items:
        try:
            allow(item)
            found.append(item)
        except BadInput as error:
            found.append(item.model_copy(update={"request": None, "error": str(error)}))
    return found


def only_commercial(items: list[Item]) -> list[Item]:
    """Return the items with requests restricted to weights that allow commercial use.

    Raises:
        BadInput: an item's settings name other weights.
    """
    strict = []
    for item in items:
        request = item.request.model_copy(update={"commercial_only": True}) if item.request else None
        if request is not None:
            request.check_licenses()
        strict.append(item.model_copy(update={"request": request}))
    return strict


def parse_changes(pairs: list[str]) -> dict[str, Any]:
    """Parse `NAME=VALUE` pairs; values are JSON if they parse as JSON, else text.

    Raises:
        BadInput: a pair has no "=", or its name is not a setting.
    """
    changes = {}
    for pair in pairs:
        key, equals, value = (part.strip() for part in pair.partition("="))
        if not equals or not key:
            raise BadInput(f"a setting is NAME=VALUE, for example motion.iterations=200; given {quoted(pair)}")
        changes[key] = _value(key, value)
    check_changes(changes)
    return dict(sorted(changes.items(), key=lambda pair: not pair[0].endswith(".kind")))  # a kind resets the others


def box_settings(text: str) -> dict[str, tuple[int, ...]]:
    """Return the setting that a box "X,Y,W,H" stands for; none if the text is empty.

    Raises:
        BadInput: it is not four whole numbers.
    """
    if not text.strip():
        return {}
    parts = [part.strip() for part in text.strip().strip("[]").split(",")]
    if len(parts) != 4 or not all(BOX_NUMBER.fullmatch(part) for part in parts):
        raise BadInput(f"{BOX_FORM}, for example 120,40,300,420; given {quoted(text)}")
    return {"subject.box": tuple(map(int, parts))}


def _names(found: list[listing.Found]) -> list[str]:
    paths = [PurePosixPath(file.name) for file in found]
    return unique_names([(clean_name(path.with_suffix("").as_posix()) or "asset", _kind(path)) for path in paths])


def _kind(path: PurePosixPath) -> str:
    """Return the suffix that distinguishes files of one name."""
    return path.suffix.lower().lstrip(".")


def _item(name: str, file: listing.Found, given: str, common: ConversionRequest) -> Item:
    if file.error:
        return Item(name=name, error=visible(file.error))
    request = common.model_copy(update={"item": name, "picture": file.path})
    return Item(name=name, request=request, store=given if file.remote else "", remote=file.remote)


@dataclass(frozen=True)
class _Reader:
    """Reader of the rows of a manifest.

    Attributes:
        root: folder of their files.
        profile: of rows that do not name one.
        changes: settings changed for all rows.
        seed: of rows that do not have one.
        validated: settings by profile and changes, because thousands of rows may share them.
    """

    root: Path
    profile: str
    changes: Mapping[str, Any]
    seed: int
    validated: dict[str, PipelineSettings] = field(default_factory=dict)

    def items(self, file: Path) -> list[Item]:
        """Read the items of a manifest, in its order."""
        if not self.root.is_dir():
            raise BadInput(f"--root {self.root} is not a folder")
        rows = [_with_texts(row) for row in read_rows(file)]
        names = unique_names([_wanted_name(row) for row in rows])
        return [self._item(name, row) for name, row in zip(names, rows, strict=True)]

    def _item(self, name: str, row: ManifestRow) -> Item:
        try:
            if row.error:
                raise BadInput(row.error)
            request = self._request(name, row.cells)
            priority = _integer("priority", row.cells.get("priority", 0), -HIGHEST_PRIORITY, HIGHEST_PRIORITY)
        except DG4DError as error:
            return Item(name=name, error=f"{row.place}: {visible(str(error))}")
        except Exception as error:  # any other error fails this row alone
            return Item(name=name, error=f"{row.place}: {type(error).__name__}: {visible(str(error))}")
        return Item(name=name, request=request, priority=priority)

    def _request(self, name: str, cells: Mapping[str, Any]) -> ConversionRequest:
        profile_name = cells.get("profile", self.profile)
        return ConversionRequest(
            item=name,
            profile=profile_name,
            settings=self._settings(
                profile_name, {**self.changes, **_settings_in(cells), **box_settings(cells.get("box", ""))}
            ),
            seed=_integer("seed", cells.get("seed", self.seed), 0, LARGEST_SEED),
            text=cells.get("text", ""),
            picture=self._file(cells, "path"),
            video=self._file(cells, "video"),
            bank=self._file(cells, "bank"),
            mask=self._file(cells, "mask"),
            depth=self._file(cells, "depth"),
            layers=self._file(cells, "layers"),
            asset=self._file(cells, "asset"),
            given_views=ViewsRequest(
                views=views_in_cell(cells.get("views", ""), self.root),
                turntable=self._file(cells, "turntable"),
                cameras=self._file(cells, "cameras"),
            ),
        )

    def _settings(self, profile_name: str, changes: dict[str, Any]) -> PipelineSettings:
        key = f"{profile_name} {json.dumps(changes, default=str)}"
        if key not in self.validated:
            self.validated[key] = revise(profile(profile_name), changes)
        return self.validated[key]

    def _file(self, cells: Mapping[str, Any], column: str) -> Path | None:
        return sources.resolve_inside(self.root, cells[column], column) if cells.get(column) else None


def _with_texts(row: ManifestRow) -> ManifestRow:
    """Convert numbers in text columns, such as the name 5; other values there make the row faulty."""
    cells, error = dict(row.cells), row.error
    for column in (name for name in TEXTS if name in cells):
        value = cells[column]
        if isinstance(value, int) and not isinstance(value, bool):
            cells[column] = str(value)
        elif not isinstance(value, str):
            del cells[column]
            error = error or f"{column} {quoted(value)} is not text"
    return row._replace(cells=cells, error=error)


def _wanted_name(row: ManifestRow) -> tuple[str, str]:
    """Return the name of a row's item, and a suffix in case another row has it too."""
    if name := clean_name(row.cells.get("name", "")):
        return name, ""
    path = PurePosixPath(row.cells.get("path", "") or row.cells.get("asset", ""))
    text = row.cells.get("text")
    return clean_name(path.stem) or (name_from_text(text) if text else row.place.replace(" ", "-")), _kind(path)


def _settings_in(cells: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a row: those in its column `set`, then those with their own column."""
    own: Any = cells.get("set", "")
    if isinstance(own, str):
        own = parse_changes([pair for pair in own.split(";") if pair.strip()])
    elif not isinstance(own, dict):
        raise BadInput(f'set {quoted(own)} holds no settings; write "a.b=c; d.e=f", or a JSON object')
    columns = {
        name: _value(name, value) if isinstance(value, str) else value for name, value in cells.items() if "." in name
    }
    check_changes({**own, **columns})
    return {**own, **columns}


def _integer(what: str, value: Any, least: int, most: int) -> int:
    """Parse an integer as tables write it: 7, 7.0 or "7"."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    text = "" if isinstance(value, bool) else str(value).strip()
    if not INTEGER.fullmatch(text):
        raise BadInput(f"{what} {quoted(value)} is not a whole number")
    number = int(text.partition(".")[0])
    if not least <= number <= most:
        raise BadInput(f"{what} {number} is out of range; use {least} to {most}")
    return number


def _value(name: str, text: str) -> Any:
    """Parse a value as JSON if possible, else return the text.

    Raises:
        BadInput: JSON that cannot be used.
    """
    try:
        return loads(text)
    except UnfitJSON as error:
        raise BadInput(f"{name} = {quoted(text)}: {error}") from error
    except ValueError:
        return text
