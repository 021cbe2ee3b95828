"""The items of a batch: everything in a folder, or the rows of a CSV or JSON file; each with a name of its own."""

import csv
import json
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from dg4d_lib.errors import BadInput
from flows import sources
from flows.orders import Wish, name_of
from flows.publish import record_of
from steps.contract import Frozen
from steps.profiles import PipelineSettings, profile, revise

COLUMNS = ("path", "text", "video", "name", "profile", "seed", "bank", "set")  # and any dotted knob, as mesh.grid
MANIFESTS = (".csv", ".json")


class Item(Frozen):
    """One line of a batch: what to make, or why that cannot be known."""

    name: str
    wish: Wish | None = None
    error: str = ""


def items_of(inputs: Path, out: Path, profile_name: str, changes: Mapping[str, Any], seed: int) -> list[Item]:
    """The items of a folder (with its folders, without `out`), or of a manifest.

    Raises:
        BadInput: there is nothing to do, or the manifest as a whole cannot be read.
    """
    settings = revise(profile(profile_name), dict(changes))
    if inputs.is_dir():
        items = _of_folder(inputs, out, lambda name, path: _wish(name, path, profile_name, settings, seed))
    elif inputs.is_file() and inputs.suffix.lower() in MANIFESTS:
        items = _of_manifest(inputs, profile_name, changes, seed)
    elif inputs.exists():
        raise BadInput(f"{inputs} is neither a folder nor a manifest (.csv, .json); for one file use `dg4d make`")
    else:
        raise BadInput(f"{inputs} does not exist; give a folder of pictures and videos, or a manifest (.csv, .json)")
    if not items:
        raise BadInput(f"{inputs} holds no pictures or videos ({', '.join(sorted(sources.PICTURES | sources.VIDEOS))})")
    return items


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


def _wish(name: str, path: Path, profile_name: str, settings: PipelineSettings, seed: int) -> Item:
    return Item(name=name, wish=Wish(item=name, picture=path, profile=profile_name, settings=settings, seed=seed))


def _of_folder(folder: Path, out: Path, item: Callable[[str, Path], Item]) -> list[Item]:
    wanted = sources.PICTURES | sources.VIDEOS
    packages = {record.parent for record in folder.rglob("provenance.json") if record_of(record.parent) is not None}
    skipped = packages | {out.absolute(), out.resolve()}
    found = [
        path
        for path in sorted(folder.rglob("*"))
        if path.suffix.lower() in wanted
        and path.is_file()
        and not any(part.startswith(".") for part in path.relative_to(folder).parts)
        and not skipped & {*path.parents, *path.absolute().parents}
    ]
    names = distinct(
        [(path.relative_to(folder).with_suffix("").as_posix(), path.suffix.lower().lstrip(".")) for path in found]
    )
    items = []
    for name, path in zip(names, found, strict=True):
        try:
            items.append(item(name, sources.inside(folder, path.relative_to(folder).as_posix(), "the file")))
        except BadInput as error:
            items.append(Item(name=name, error=str(error)))
    return items


def _of_manifest(file: Path, profile_name: str, changes: Mapping[str, Any], seed: int) -> list[Item]:
    rows = _rows(file)
    names = distinct([_wanted(row) for row in rows])
    items = []
    for name, row in zip(names, rows, strict=True):
        try:
            items.append(Item(name=name, wish=_wish_of(name, row, file.parent, profile_name, changes, seed)))
        except BadInput as error:
            items.append(Item(name=name, error=str(error)))
    return items


def _wanted(row: dict[str, Any]) -> tuple[str, str]:
    """The name that a row asks for, within the output folder; and its suffix, in case another asks for it too."""
    path = PurePosixPath(str(row.get("path", "")))
    own = path.stem or name_of(str(row.get("text", "")))
    name = "".join(letter for letter in str(row.get("name") or own) if letter.isprintable())
    parts = [part for part in PurePosixPath(name).parts if part.strip("/") not in {"", ".."}]
    return "/".join(parts) or own, "" if row.get("name") else path.suffix.lower().lstrip(".")


def _wish_of(
    name: str, row: dict[str, Any], folder: Path, profile_name: str, changes: Mapping[str, Any], seed: int
) -> Wish:
    own: Any = row.get("set") or {}
    if isinstance(own, str):
        own = parse_changes([pair for pair in own.split(";") if pair.strip()])
    knobs = {key: _value(value) if isinstance(value, str) else value for key, value in row.items() if "." in key}
    chosen = str(row.get("profile") or profile_name)
    try:
        number = int(row.get("seed", seed))
    except (TypeError, ValueError) as error:
        raise BadInput(f"seed {row['seed']!r} is not a whole number") from error
    if number < 0:
        raise BadInput(f"seed {number} is negative; use 0 or more")
    return Wish(
        item=name,
        picture=sources.inside(folder, str(row["path"]), "path") if row.get("path") else None,
        text=str(row.get("text", "")),
        video=sources.inside(folder, str(row["video"]), "video") if row.get("video") else None,
        bank=sources.inside(folder, str(row["bank"]), "bank") if row.get("bank") else None,
        profile=chosen,
        settings=revise(profile(chosen), {**changes, **own, **knobs}),
        seed=number,
    )


def _rows(file: Path) -> list[dict[str, Any]]:
    """The rows of a manifest without empty cells.

    Raises:
        BadInput: it is not a table, or has columns that mean nothing.
    """
    try:
        text = file.read_text(encoding="utf-8-sig")
        if file.suffix.lower() == ".csv":
            rows: Any = list(csv.DictReader(text.splitlines(), restkey="too many cells"))
        else:
            rows = json.loads(text)
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
    return [{key: value for key, value in row.items() if value not in (None, "")} for row in rows]


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
