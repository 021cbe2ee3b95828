"""The items of a batch: the rows of a manifest, or everything in a folder, a pattern or an object store, by name."""

import csv
import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path, PurePosixPath
from typing import Any

from dg4d_lib.errors import BackendUnavailable, BadInput
from flows.inputs import listing, sources
from flows.inputs.orders import Wish, name_of
from steps.contract import Frozen
from steps.profiles import PipelineSettings, profile, revise

COLUMNS = (
    "path", "text", "video", "name", "profile", "seed", "bank", "priority", "set",
)  # and any dotted knob, as mesh.grid  # fmt: skip
MANIFESTS = (".csv", ".json", ".jsonl", ".parquet")
WHAT = (
    "a folder of pictures and videos, a pattern such as 'photos/**/*.png', an object store (s3://BUCKET/PREFIX), or a "
    f"manifest ({', '.join(MANIFESTS)})"
)


class Item(Frozen):
    """One line of a batch: what to make, or why that cannot be known.

    Attributes:
        name: of the folder of its package, within that of the batch.
        wish: what to make.
        error: why that is not known.
        priority: those with a higher one are made earlier.
        store: the object store where the source is, as the user gave it; empty where `wish` says where it is.
        remote: the source in that store.
    """

    name: str
    wish: Wish | None = None
    error: str = ""
    priority: int = 0
    store: str = ""
    remote: str = ""

    @contextmanager
    def here(self) -> Iterator[Wish]:
        """The wish with its files on this machine, as long as the block runs; an object is fetched.

        Raises:
            BadInput: what to make is not known, or the object is gone.
            BackendUnavailable: the object store does not answer.
        """
        if self.wish is None or self.wish.picture is None or not self.remote:
            if self.wish is None:
                raise BadInput(self.error)
            yield self.wish
            return
        with listing.fetched(self.store, self.remote, self.wish.picture.name) as path:
            yield self.wish.model_copy(update={"picture": path})


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
    common = Wish(item="", profile=profile_name, settings=settings, seed=seed)
    return [_item(name, file, given, common) for name, file in zip(_names(found), found, strict=True)]


def admitted(items: list[Item], allow: Callable[[Item], None]) -> list[Item]:
    """Return the same items; those for which `allow` raises BadInput become bad ones."""
    found = []
    for item in items:
        try:
            allow(item)
            found.append(item)
        except BadInput as error:
            found.append(item.model_copy(update={"wish": None, "error": str(error)}))
    return found


def only_commercial(items: list[Item]) -> list[Item]:
    """The same items, each asking for weights that allow commercial use.

    Raises:
        BadInput: the settings of one name others.
    """
    strict = []
    for item in items:
        wish = item.wish.model_copy(update={"commercial_only": True}) if item.wish else None
        if wish is not None:
            wish.check_licenses()
        strict.append(item.model_copy(update={"wish": wish}))
    return strict


def parse_changes(pairs: list[str]) -> dict[str, Any]:
    """Turn `knob=value` pairs into changes; values are JSON where they can be, else text.

    Raises:
        BadInput: a pair without "=".
    """
    changes = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals or not key.strip():
            raise BadInput(f"a setting is written knob=value, for example motion.iterations=200; this was {pair!r}")
        changes[key.strip()] = _value(value.strip())
    return dict(sorted(changes.items(), key=lambda pair: not pair[0].endswith(".kind")))  # a kind resets its knobs


def distinct(wanted: list[tuple[str, str]]) -> list[str]:
    """A name for each item: no two are equal, whatever the case of their letters, and none lies within another.

    Args:
        wanted: for each item the name it should have, and what to add where that is not clear.
    """
    count = Counter(name.lower() for name, _ in wanted)
    inside = {parent.as_posix().lower() for name, _ in wanted for parent in PurePosixPath(name).parents}
    names: list[str] = []
    for name, addition in wanted:
        clear = count[name.lower()] == 1 and name.lower() not in inside
        names.append(_numbered(name if clear or not addition else f"{name}-{addition}", names, inside))
    return names


def _names(found: list[listing.Found]) -> list[str]:
    places = [PurePosixPath(file.name) for file in found]
    return distinct([(place.with_suffix("").as_posix(), place.suffix.lower().lstrip(".")) for place in places])


def _item(name: str, file: listing.Found, given: str, common: Wish) -> Item:
    if file.error:
        return Item(name=_within(name) or "unnamed", error=file.error)
    wish = common.model_copy(update={"item": name, "picture": file.path})
    return Item(name=name, wish=wish, store=given if file.remote else "", remote=file.remote)


def _of_manifest(file: Path, root: Path, profile_name: str, changes: Mapping[str, Any], seed: int) -> list[Item]:
    if not root.is_dir():
        raise BadInput(f"--root {root} is not a folder")
    rows = _rows(file)
    if not rows:
        raise BadInput(f"{file} holds no pictures or videos: it has no rows")
    names = distinct([_wanted(row) for row in rows])
    pipelines: dict[str, PipelineSettings] = {}  # many rows want the same: it is kept, and checked, once
    items = []
    for name, row in zip(names, rows, strict=True):
        try:
            chosen = str(row.get("profile") or profile_name)
            knobs = {**changes, **_knobs(row)}
            key = f"{chosen} {json.dumps(knobs, default=str)}"
            if key not in pipelines:
                pipelines[key] = revise(profile(chosen), knobs)
            common = Wish(
                item=name, profile=chosen, settings=pipelines[key], seed=_whole("seed", row.get("seed", seed), least=0)
            )
            items.append(
                Item(name=name, wish=_wish(row, root, common), priority=_whole("priority", row.get("priority", 0)))
            )
        except BadInput as error:
            items.append(Item(name=name, error=str(error)))
    return items


def _wanted(row: dict[str, Any]) -> tuple[str, str]:
    """The name that a row asks for, within the output folder; and its suffix, in case another asks for it too."""
    path = PurePosixPath(str(row.get("path", "")))
    own = path.stem or name_of(str(row.get("text", "")))
    name = _within(str(row.get("name") or own)) or own
    return name, "" if row.get("name") else path.suffix.lower().lstrip(".")


def _within(name: str) -> str:
    """A name without parts that lead out of a folder."""
    printable = "".join(letter for letter in name if letter.isprintable())
    return "/".join(part for part in PurePosixPath(printable).parts if part.strip("/") not in {"", ".."})


def _knobs(row: dict[str, Any]) -> dict[str, Any]:
    """The knobs that a row sets: those in its column `set`, then those with a column of their own."""
    own: Any = row.get("set") or {}
    if isinstance(own, str):
        own = parse_changes([pair for pair in own.split(";") if pair.strip()])
    return {
        **own,
        **{key: _value(value) if isinstance(value, str) else value for key, value in row.items() if "." in key},
    }


def _whole(what: str, value: Any, least: int | None = None) -> int:
    try:
        number = int(value)
        if number != float(value):
            raise ValueError
    except (TypeError, ValueError, OverflowError) as error:
        raise BadInput(f"{what} {value!r} is not a whole number") from error
    if least is not None and number < least:
        raise BadInput(f"{what} {number} is too small; use {least} or more")
    return number


def _wish(row: dict[str, Any], root: Path, common: Wish) -> Wish:
    def file(column: str) -> Path | None:
        return sources.inside(root, str(row[column]), column) if row.get(column) else None

    files = {"picture": file("path"), "video": file("video"), "bank": file("bank")}
    return common.model_copy(update={"text": str(row.get("text", "")), **files})


def _rows(file: Path) -> list[dict[str, Any]]:
    """The rows of a manifest without empty cells.

    Raises:
        BadInput: it is not a table, or has columns that mean nothing.
        BackendUnavailable: reading Parquet is not installed.
    """
    try:
        rows = _table(file)
    except (OSError, ValueError, csv.Error) as error:
        raise BadInput(f"{file} cannot be read as a manifest: {error}") from error
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise BadInput(f"{file} should hold a list of rows, each with at least a path or a text")
    for number, row in enumerate(rows, 1):
        if unknown := sorted(key for key in row if key not in COLUMNS and ("." not in key)):
            raise BadInput(
                f"{file}, row {number}: unknown column {unknown[0]!r}; there are: {', '.join(COLUMNS)}, "
                "and any knob such as motion.iterations"
            )
        if not row.get("path") and not row.get("text"):
            raise BadInput(f"{file}, row {number}: neither a path nor a text")
    return [{key: value for key, value in row.items() if not _is_empty(value)} for row in rows]


def _table(file: Path) -> Any:
    kind = file.suffix.lower()
    if kind == ".parquet":
        return _parquet(file)
    text = file.read_text(encoding="utf-8-sig")
    if kind == ".csv":
        return list(csv.DictReader(text.splitlines(), restkey="too many cells"))
    if kind == ".jsonl":
        return [json.loads(line) for line in text.splitlines() if line.strip()]
    return json.loads(text)


def _parquet(file: Path) -> Any:
    if find_spec("pyarrow") is None:
        raise BackendUnavailable(f"{file} is Parquet, which pyarrow reads: pip install 'dg4d[parquet]'; or give a .csv")
    return import_module("pyarrow.parquet").read_table(file).to_pylist()


def _is_empty(value: Any) -> bool:
    """Nothing in a cell, in the ways in which tables say so; what is not a number is unlike itself."""
    return value is None or value == "" or value != value  # noqa: PLR0124


def _numbered(name: str, taken: list[str], inside: set[str]) -> str:
    used = {other.lower() for other in taken} | inside
    if name.lower() not in used:
        return name
    number = 2
    while f"{name}-{number}".lower() in used:
        number += 1
    return f"{name}-{number}"


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text
