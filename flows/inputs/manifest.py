"""The items of a batch: the rows of a manifest, or everything in a folder, a pattern or an object store, by name."""

import json
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

from dg4d_lib.errors import BadInput, DG4DError
from flows.formatting.escaping import quoted, visible
from flows.inputs import listing, sources
from flows.inputs.conversion_job import ConversionRequest, name_of
from flows.inputs.json_text import UnfitJSON, loads
from flows.inputs.naming import check_path, clean, distinct
from flows.inputs.rows import MANIFESTS, Row, read_rows
from flows.inputs.setting_reference import check_names
from steps.contract import LARGEST_SEED, Frozen
from steps.profiles import PipelineSettings, profile, revise

WHAT = (
    "a folder of pictures and videos, a pattern such as 'photos/**/*.png', an object store (s3://BUCKET/PREFIX), or a "
    f"manifest ({', '.join(MANIFESTS)})"
)
HIGHEST_PRIORITY = 10**9
TEXTS = frozenset(["path", "text", "video", "name", "profile", "bank"])  # columns
WHOLE = re.compile(r"[+-]?[0-9]{1,30}(\.0*)?")


class Item(Frozen):
    """One line of a batch: what to make, or why that cannot be known.

    Attributes:
        name: of the folder of its package, within that of the batch.
        request: conversion to run; None where the item has an error.
        error: why that is not known.
        priority: those with a higher one are made earlier.
        store: the object store where the source is, as the user gave it; empty where `request` says where it is.
        remote: the source in that store.
    """

    name: str
    request: ConversionRequest | None = None
    error: str = ""
    priority: int = 0
    store: str = ""
    remote: str = ""

    @contextmanager
    def fetch(self) -> Iterator[ConversionRequest]:
        """Yield the request with its files on this machine; an object is fetched for the length of the block.

        Raises:
            BadInput: what to make is not known, or the object is gone.
            BackendUnavailable: the object store does not answer.
        """
        if self.request is None or self.request.picture is None or not self.remote:
            if self.request is None:
                raise BadInput(self.error)
            yield self.request
            return
        with listing.fetched(self.store, self.remote, self.request.picture.name) as path:
            yield self.request.model_copy(update={"picture": path})


def items_of(
    inputs: str | Path,
    out: Path,
    profile_name: str,
    changes: Mapping[str, Any],
    seed: int,
    root: Path | None = None,
) -> list[Item]:
    """The items of a folder (with its folders, without `out`), a pattern, an object store or a manifest.

    Those of higher priority come first, equal ones in their order: by name, or as in the manifest.

    Args:
        inputs: what the user gave.
        out: the folder of the packages.
        profile_name: of items that do not name one.
        changes: of its knobs, for all items.
        seed: of items that do not have one.
        root: where a manifest's files are, and must stay; default: the folder of the manifest.

    Raises:
        BadInput: there is nothing to do, or the manifest as a whole cannot be read.
        BackendUnavailable: the object store does not answer, or reading Parquet is not installed.
    """
    settings = revise(profile(profile_name), dict(changes))
    path, given = Path(inputs), str(inputs)
    check_path(path)
    if path.is_file() and path.suffix.lower() in MANIFESTS:
        items = _of_manifest(path, root or path.parent, profile_name, changes, seed)
        return sorted(items, key=lambda item: -item.priority)
    if root is not None:
        raise BadInput(f"--root says where the files of a manifest are, and {given} is none")
    if given.startswith(listing.BUCKET):
        found = listing.in_bucket(given)
    elif path.is_dir():
        found = listing.in_folder(path, out)
    elif path.exists():
        raise BadInput(
            f"{given} is neither a folder nor a manifest ({', '.join(MANIFESTS)}); for one file use `dg4d make`"
        )
    elif listing.WILD & set(given):
        found = listing.by_pattern(given, out)
    else:
        raise BadInput(f"{given} does not exist; give {WHAT}")
    if not found:
        raise BadInput(f"{given} holds no pictures or videos ({', '.join(sorted(listing.WANTED))})")
    common = ConversionRequest(item="", profile=profile_name, settings=settings, seed=seed)
    return [_item(name, file, given, common) for name, file in zip(_names(found), found, strict=True)]


def admitted(items: list[Item], allow: Callable[[Item], None]) -> list[Item]:
    """Return the same items; those for which `allow` raises BadInput become bad ones."""
    found = []
    for item in items:
        try:
            allow(item)
            found.append(item)
        except BadInput as error:
            found.append(item.model_copy(update={"request": None, "error": str(error)}))
    return found


def only_commercial(items: list[Item]) -> list[Item]:
    """The same items, each asking for weights that allow commercial use.

    Raises:
        BadInput: the settings of one name others.
    """
    strict = []
    for item in items:
        request = item.request.model_copy(update={"commercial_only": True}) if item.request else None
        if request is not None:
            request.check_licenses()
        strict.append(item.model_copy(update={"request": request}))
    return strict


def parse_changes(pairs: list[str]) -> dict[str, Any]:
    """Turn `knob=value` pairs into changes; values are JSON where they can be, else text.

    Raises:
        BadInput: a pair without "=", or a name that no setting has.
    """
    changes = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals or not key.strip():
            raise BadInput(
                f"a setting is written knob=value, for example motion.iterations=200; this was {quoted(pair)}"
            )
        changes[key.strip()] = _value(key.strip(), value.strip())
    check_names(changes)
    return dict(sorted(changes.items(), key=lambda pair: not pair[0].endswith(".kind")))  # a kind resets its knobs


def _names(found: list[listing.Found]) -> list[str]:
    places = [PurePosixPath(file.name) for file in found]
    return distinct(
        [(clean(place.with_suffix("").as_posix()) or "asset", place.suffix.lower().lstrip(".")) for place in places]
    )


def _item(name: str, file: listing.Found, given: str, common: ConversionRequest) -> Item:
    if file.error:
        return Item(name=name, error=visible(file.error))
    request = common.model_copy(update={"item": name, "picture": file.path})
    return Item(name=name, request=request, store=given if file.remote else "", remote=file.remote)


def _of_manifest(file: Path, root: Path, profile_name: str, changes: Mapping[str, Any], seed: int) -> list[Item]:
    if not root.is_dir():
        raise BadInput(f"--root {root} is not a folder")
    rows = [_checked(row) for row in read_rows(file)]
    names = distinct([_wanted(row) for row in rows])
    reader = _Reader(root, profile_name, changes, seed)
    return [
        Item(name=name, error=f"{row.place}: {row.error}") if row.error else reader.item(name, row)
        for name, row in zip(names, rows, strict=True)
    ]


class _Reader:
    """Makes items of rows.

    Args:
        root: where their files are.
        profile_name: of rows that do not name one.
        changes: of its knobs, for all rows.
        seed: of rows that do not have one.
    """

    def __init__(self, root: Path, profile_name: str, changes: Mapping[str, Any], seed: int) -> None:
        self._root, self._profile, self._changes, self._seed = root, profile_name, changes, seed
        self._pipelines: dict[str, PipelineSettings] = {}  # many rows want the same: it is kept, and checked, once

    def item(self, name: str, row: Row) -> Item:
        """Make an item of a row; whatever is wrong with the row is in its `error`."""
        try:
            request = self._request(name, row.cells)
            priority = _whole("priority", row.cells.get("priority", 0), -HIGHEST_PRIORITY, HIGHEST_PRIORITY)
        except DG4DError as error:
            return Item(name=name, error=f"{row.place}: {visible(str(error))}")
        except Exception as error:  # whatever it is, it is this row's own
            return Item(name=name, error=f"{row.place}: {type(error).__name__}: {visible(str(error))}")
        return Item(name=name, request=request, priority=priority)

    def _request(self, name: str, cells: Mapping[str, Any]) -> ConversionRequest:
        chosen = cells.get("profile", self._profile)
        return ConversionRequest(
            item=name,
            profile=chosen,
            settings=self._settings(chosen, {**self._changes, **_knobs(cells)}),
            seed=_whole("seed", cells.get("seed", self._seed), 0, LARGEST_SEED),
            text=cells.get("text", ""),
            picture=self._file(cells, "path"),
            video=self._file(cells, "video"),
            bank=self._file(cells, "bank"),
        )

    def _settings(self, chosen: str, knobs: dict[str, Any]) -> PipelineSettings:
        key = f"{chosen} {json.dumps(knobs, default=str)}"
        if key not in self._pipelines:
            self._pipelines[key] = revise(profile(chosen), knobs)
        return self._pipelines[key]

    def _file(self, cells: Mapping[str, Any], column: str) -> Path | None:
        return sources.inside(self._root, cells[column], column) if cells.get(column) else None


def _checked(row: Row) -> Row:
    """The row with text where a column holds text; with an error where there is something else."""
    try:
        texts = {column: _text(column, row.cells[column]) for column in TEXTS & row.cells.keys()}
    except BadInput as error:
        return row._replace(error=row.error or str(error))
    return row._replace(cells={**row.cells, **texts})


def _text(column: str, value: Any) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, int) and not isinstance(value, bool):  # a number can be a name
        return str(value)
    raise BadInput(f"{column} {quoted(value)} is no text")


def _wanted(row: Row) -> tuple[str, str]:
    """The name that a row asks for, within the output folder; and its suffix, in case another asks for it too."""
    try:
        cells = {column: _text(column, row.cells.get(column, "")) for column in ("path", "text", "name")}
    except BadInput:
        cells = {}
    path = PurePosixPath(cells.get("path", ""))
    if name := clean(cells.get("name", "")):
        return name, ""
    own = clean(path.stem) or (name_of(cells["text"]) if cells.get("text") else "")
    return own or row.place.replace(" ", "-"), path.suffix.lower().lstrip(".")


def _knobs(cells: Mapping[str, Any]) -> dict[str, Any]:
    """The knobs that a row sets: those in its column `set`, then those with a column of their own."""
    own: Any = cells.get("set", "")
    if isinstance(own, str):
        own = parse_changes([pair for pair in own.split(";") if pair.strip()])
    elif not isinstance(own, dict):
        raise BadInput(f'set {quoted(own)} holds no settings; write "a.b=c; d.e=f", or an object of knobs and values')
    columns = {
        knob: _value(knob, value) if isinstance(value, str) else value for knob, value in cells.items() if "." in knob
    }
    check_names({**own, **columns})
    return {**own, **columns}


def _whole(what: str, value: Any, least: int, most: int) -> int:
    """A whole number, however a table says it: 7, 7.0 or "7"."""
    if isinstance(value, str) and WHOLE.fullmatch(value.strip()):
        number = int(value.strip().partition(".")[0])
    elif isinstance(value, int) and not isinstance(value, bool):
        number = value
    elif isinstance(value, float) and value.is_integer():
        number = int(value)
    else:
        raise BadInput(f"{what} {quoted(value)} is not a whole number")
    if not least <= number <= most:
        raise BadInput(f"{what} {number} is out of range; use {least} to {most}")
    return number


def _value(knob: str, text: str) -> Any:
    """A value as JSON where it is some, else as text.

    Raises:
        BadInput: JSON that cannot be used.
    """
    try:
        return loads(text)
    except UnfitJSON as error:
        raise BadInput(f"{knob} = {quoted(text)}: {error}") from error
    except ValueError:
        return text
