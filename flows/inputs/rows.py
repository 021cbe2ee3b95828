"""Rows of a manifest (CSV, JSON, JSON Lines, Parquet), read independently: a faulty row does not affect others."""

import codecs
import csv
import io
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from dg4d_lib.errors import BackendUnavailable, BadInput, quoted
from flows.inputs.json_text import loads

COLUMNS = (
    "path", "text", "video", "asset", "name", "profile", "seed", "bank", "mask", "box", "depth", "layers", "views",
    "turntable", "cameras", "priority", "set",
)  # and any setting, such as mesh.grid  # fmt: skip
SUBJECTS = ("path", "text", "asset")  # columns; a row needs one of them
MANIFESTS = (".csv", ".json", ".jsonl", ".parquet")
LARGEST_MANIFEST_BYTES = 256 * 2**20
LARGEST_TABLE_BYTES = 2**30  # of a Parquet table after decompression
ROWS_AT_ONCE = 1024  # of Parquet, where a dictionary may repeat one long text in many cells
MOST_ROWS = 1_000_000
NOT_UTF8 = "it is not valid UTF-8; save the manifest as UTF-8"

_TOKEN = re.compile(r'"[^"\\]*(?:\\.[^"\\]*)*"|[\[\]{},]', re.DOTALL)
_SURROGATE = re.compile("[\ud800-\udfff]")
_SEPARATOR = re.compile("[;\t]")  # of columns in CSV of spreadsheets whose decimal sign is a comma


class ManifestRow(NamedTuple):
    """ManifestRow of a manifest.

    Attributes:
        place: its number, for messages and unnamed items: "row 3"; in JSON Lines "line 3".
        cells: by column, without empty ones.
        error: reason why it cannot be used; empty if none is known.
    """

    place: str
    cells: dict[str, Any]
    error: str = ""


def read_rows(file: Path) -> list[ManifestRow]:
    """Read the rows of a manifest.

    Raises:
        BadInput: it is not a table, has unknown columns, or is too large.
        BackendUnavailable: Parquet support is not installed.
    """
    try:
        if (size := file.stat().st_size) > LARGEST_MANIFEST_BYTES:
            raise BadInput(f"{file} has {size} bytes; at most {LARGEST_MANIFEST_BYTES} are read: divide it")
        rows = _table(file)
    except (OSError, ValueError, csv.Error) as error:
        raise BadInput(f"{file} cannot be read as a manifest: {error}") from error
    if not rows:
        raise BadInput(f"{file} holds no pictures or videos: it has no rows")
    if len(rows) > MOST_ROWS:
        raise BadInput(f"{file} has {len(rows)} rows; at most {MOST_ROWS} are read: divide it")
    return rows


def _table(file: Path) -> list[ManifestRow]:
    kind = file.suffix.lower()
    if kind == ".parquet":
        return _parquet(file)
    content = file.read_bytes()
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise ValueError(NOT_UTF8)
    text = content.removeprefix(codecs.BOM_UTF8).decode(errors="surrogateescape")
    if kind == ".csv":
        return _csv(text)
    if kind == ".jsonl":
        lines = enumerate(text.split("\n"), 1)
        return _of_json((f"line {number}", line) for number, line in lines if line.strip())
    return _of_json((f"row {number}", element) for number, element in enumerate(_elements(text), 1))


def _csv(text: str) -> list[ManifestRow]:
    reader = csv.reader(io.StringIO(text, newline=""), skipinitialspace=True)
    columns = [name.strip() for name in next(reader, [])]
    if len(columns) == 1 and _SEPARATOR.search(columns[0]):
        raise BadInput(f"the manifest has a single column {quoted(columns[0])}; separate the columns with commas")
    _check_columns(columns)
    rows: list[ManifestRow] = []
    while True:
        place = f"row {len(rows) + 1}"
        try:
            cells = next(reader)
        except StopIteration:
            return rows
        except csv.Error as error:
            rows.append(ManifestRow(place, {}, f"it cannot be read: {error}"))
            continue
        if not cells:
            continue
        if len(cells) > len(columns):
            rows.append(ManifestRow(place, {}, f"it has {len(cells)} cells, and there are {len(columns)} columns"))
        elif any(map(_SURROGATE.search, cells)):
            rows.append(ManifestRow(place, {}, NOT_UTF8))
        else:
            rows.append(_row(place, dict(zip(columns, cells, strict=False))))


def _of_json(texts: Iterable[tuple[str, str]]) -> list[ManifestRow]:
    """Parse rows that are JSON objects.

    Raises:
        ValueError: none of them is one.
    """
    rows = [_object(place, text) for place, text in texts]
    if rows and all(row.error and not row.cells for row in rows):
        raise ValueError(f"{rows[0].place}: {rows[0].error}")
    return rows


def _object(place: str, text: str) -> ManifestRow:
    if _SURROGATE.search(text):
        return ManifestRow(place, {}, NOT_UTF8)
    try:
        value = loads(text)
    except ValueError as error:
        return ManifestRow(place, {}, f"it cannot be read: {error}")
    if not isinstance(value, dict):
        return ManifestRow(place, {}, 'it is not an object such as {"path": "fox.png"}')
    if unknown := _unknown(value):
        return ManifestRow(place, value, unknown)
    return _row(place, value)


def _elements(text: str) -> Iterator[str]:
    """Split a JSON list into the texts of its elements, so that a malformed one does not affect the others.

    Raises:
        ValueError: it is not a list, or is not closed.
    """
    text = text.strip()
    if not text.startswith("["):
        loads(text)
        raise ValueError("give a JSON list of rows, each with at least a path or a text")
    depth, start = 0, 1
    for token in _TOKEN.finditer(text):
        letter = token.group()[0]
        depth += (letter in "[{") - (letter in "]}")
        if depth == 0:
            if (last := text[start : token.start()]).strip() or start > 1:
                yield last
            if text[token.end() :].strip():
                raise ValueError("text follows the list")
            return
        if letter == "," and depth == 1:
            yield text[start : token.start()]
            start = token.end()
    raise ValueError("the list is not closed")


def _parquet(file: Path) -> list[ManifestRow]:
    if find_spec("pyarrow") is None:
        raise BackendUnavailable(f"{file} is Parquet, which needs pyarrow; run `make setup`, or give a .csv")
    arrow, parquet = import_module("pyarrow"), import_module("pyarrow.parquet")
    try:
        with parquet.ParquetFile(file) as opened:
            _check_columns(opened.schema_arrow.names)
            content: list[dict[str, Any]] = []
            size = 0
            for batch in opened.iter_batches(ROWS_AT_ONCE):
                size += batch.nbytes
                if size > LARGEST_TABLE_BYTES or len(content) > MOST_ROWS:
                    raise BadInput(
                        f"{file} unpacks to more than {MOST_ROWS} rows or {LARGEST_TABLE_BYTES} bytes; divide it"
                    )
                content += batch.to_pylist()
    except (arrow.ArrowException, NotImplementedError, ArithmeticError) as error:
        raise ValueError(str(error)) from error
    return [_row(f"row {number}", cells) for number, cells in enumerate(content, 1)]


def _row(place: str, cells: dict[str, Any]) -> ManifestRow:
    # NaN: an empty cell of a number column in Parquet files that data frames wrote; JSON with NaN is refused before
    filled = {column: value for column, value in cells.items() if value not in (None, "") and value == value}  # noqa: PLR0124
    error = "" if any(filled.get(column) for column in SUBJECTS) else "neither a path nor a text, nor an asset"
    return ManifestRow(place, filled, error)


def _check_columns(columns: list[str]) -> None:
    """Refuse unknown and repeated columns of a table; raises BadInput."""
    if unknown := _unknown(columns):
        raise BadInput(f"the manifest has an {unknown}")
    if twice := [column for column, count in Counter(columns).items() if count > 1]:
        raise BadInput(f"the manifest has two columns {quoted(twice[0])}; leave one out")


def _unknown(columns: Iterable[str]) -> str:
    """Return a message about the first unknown column; empty if all are known."""
    unknown = sorted(column for column in columns if column not in COLUMNS and "." not in column)
    known = f"{', '.join(COLUMNS)}, and any setting such as motion.iterations"
    return f"unknown column {quoted(unknown[0])}; use: {known}" if unknown else ""
