"""Manifests with one bad row: that row is a failed item with a sentence, and the others are read."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from dg4d_lib.errors import BadInput
from flows.inputs import rows
from flows.inputs.manifest import Item, items_of

DEEP = "[" * 5000 + "]" * 5000


def items(file: Path) -> list[Item]:
    return items_of(file, Path("out"), "preview", {}, 3)


def in_between(file: Path, content: str | bytes) -> tuple[str, str]:
    """The name and the error of the second item of three, of which the others are well."""
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    first, bad, last = items(file)
    assert (first.name, first.error, last.name, last.error) == ("a", "", "z", "")
    assert first.request is not None and last.request is not None and bad.request is None
    return bad.name, bad.error


@pytest.mark.parametrize(
    ("cells", "says"),
    [
        ('"set": 7', "set 7 holds no settings"),
        ('"set": [1]', "set [1] holds no settings"),
        ('"set": true', "set True holds no settings"),
        (f'"set": "mesh.grid={DEEP}"', "nested more than 100 deep"),
        ('"set": {"mesh.grid": ' + DEEP + "}", "nested more than 100 deep"),
        ('"mesh.grid": ' + DEEP, "nested more than 100 deep"),
        ('"name": ["b"]', "name ['b'] is not text"),
        ('"name": 1.5', "name 1.5 is not text"),
        ('"name": true', "name True is not text"),
        ('"profile": 7', "unknown profile '7'"),
        ('"profile": {}', "profile {} is not text"),
        ('"text": {"a": 1}', "text {'a': 1} is not text"),
        ('"seed": NaN', "is NaN"),
        ('"seed": 1e400', "too large"),
        ('"seed": true', "seed True is not a whole number"),
        ('"seed": "abc"', "seed 'abc' is not a whole number"),
        ('"seed": [1]', "seed [1] is not a whole number"),
        ('"seed": 99999999999999999999999', "use 0 to 9223372036854775807"),
        ('"seed": "99999999999999999999999"', "use 0 to 9223372036854775807"),
        ('"seed": -1', "seed -1 is out of range"),
        ('"seed": ' + "9" * 5000, "5000 digits"),
        ('"priority": NaN', "is NaN"),
        ('"priority": 1e30', "priority 1000000000000000019884624838656 is out of range"),
        ('"name": "\\ud800"', "half a character"),
        ('"text": "\\udfff fox"', "half a character"),
        ('"name": "b", "name": "c"', "the key 'name' is there twice"),
        ('"color": "red"', "unknown column 'color'"),
        ('"pack.fps": 0.5', "1 to 240"),
        ('"pack.fps": 241', "less than or equal to 240"),
        ('"static.iterations": ' + "9" * 40, "static.iterations = 999"),
        ('"max_points.x": 1', "unknown setting"),
    ],
)
@pytest.mark.parametrize("kind", ["json", "jsonl"])
def test_a_bad_cell_of_json_fails_its_row_alone(tmp_path: Path, kind: str, cells: str, says: str) -> None:
    lines = ['{"path": "a.png"}', f'{{"path": "b.png", {cells}}}', '{"path": "z.png"}']
    text = "\n".join(lines) if kind == "jsonl" else f"[{','.join(lines)}]"
    _, error = in_between(tmp_path / f"m.{kind}", text)
    assert says in error
    assert error.startswith("line 2: " if kind == "jsonl" else "row 2: ")
    assert len(error) < 500


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ("{", "cannot be read"),
        ("", "cannot be read"),
        ('{"path": "b.png"', "cannot be read"),
        ("7", "not an object"),
        ('["path"]', "not an object"),
        ("null", "not an object"),
        (DEEP, "nested more than 100 deep"),
        ('{"name": "b"}', "neither a path nor a text"),
        ('{"path": ""}', "neither a path nor a text"),
        ('{"path": null}', "neither a path nor a text"),
    ],
)
def test_a_line_that_is_no_row_is_an_item_named_by_its_number(tmp_path: Path, row: str, says: str) -> None:
    row = row or "what"
    name, error = in_between(tmp_path / "m.jsonl", f'{{"path": "a.png"}}\n\n{row}\n{{"path": "z.png"}}\n')
    assert (name, says in error) == ("b" if "name" in row else "line-3", True)


@pytest.mark.parametrize("row", ["7", "what", '{"path": "b.png" "x"}', DEEP, "{},", '"[,"'])
def test_an_element_that_is_no_row_is_an_item_named_by_its_number(tmp_path: Path, row: str) -> None:
    (tmp_path / "m.json").write_text(f'[{{"path": "a.png"}}, {row.rstrip(",")}, {{"path": "z.png"}}]')
    first, bad, last = items(tmp_path / "m.json")
    assert (first.error, bad.name, last.error) == ("", "row-2", "")
    assert bad.error.startswith("row 2: ")


@pytest.mark.parametrize(
    ("line", "says"),
    [
        (b"b.png,1,,,more", "5 cells"),
        (b"caf\xe9.png,1,,", "not valid UTF-8"),
        (b"b.png,NaN,,", "seed 'NaN' is not a whole number"),
        (b"b.png,1e400,,", "seed '1e400' is not a whole number"),
        (b"b.png,,mesh.grid=" + DEEP.encode() + b",", "nested more than 100 deep"),
        (b"b.png,,mesh.grid=NaN,", "is NaN"),
        (b"b.png,,mesh.grid,", "NAME=VALUE"),
        (b"b.png,,,0.5", "1 to 240"),
        (b"x" * 200_000 + b".png,1,,", "field limit"),
        (b"b\0.png,,,", "leads out of the folder"),
    ],
)
def test_a_bad_line_of_csv_fails_its_row_alone(tmp_path: Path, line: bytes, says: str) -> None:
    content = b"\xef\xbb\xbfpath,seed,set,pack.fps\r\na.png,1,,\r\n" + line + b"\r\nz.png,2.0,,30\r\n"
    _, error = in_between(tmp_path / "m.csv", content)
    assert says in error and error.startswith("row 2: ")


@pytest.mark.parametrize("header", ["path;name", "path\tseed", "path;mesh.grid", "sep=;"])
def test_a_csv_whose_columns_have_no_commas_between_them_is_refused_with_the_remedy(
    tmp_path: Path, header: str
) -> None:
    (tmp_path / "m.csv").write_text(f"{header}\na.png;64\n")
    with pytest.raises(BadInput, match="separate the columns with commas") as raised:
        items(tmp_path / "m.csv")
    assert repr(header) in str(raised.value)


def test_spaces_around_the_names_of_columns_and_after_commas_do_not_count(tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text(' path, name ,text , mesh.grid\n, fox, "red, fat", 64\n')
    (item,) = items(tmp_path / "m.csv")
    assert (item.name, item.error) == ("fox", "")
    assert item.request is not None and item.request.text == "red, fat"
    (tmp_path / "m.csv").write_text("path, path\na.png,b.png\n")
    with pytest.raises(BadInput, match="two columns 'path'"):
        items(tmp_path / "m.csv")


@pytest.mark.parametrize("encoding", ["utf-16-le", "utf-16-be"])
@pytest.mark.parametrize("kind", ["csv", "json"])
def test_a_manifest_in_utf_16_is_refused_with_the_remedy(tmp_path: Path, kind: str, encoding: str) -> None:
    (tmp_path / f"m.{kind}").write_text("\ufeffpath\na.png\n", encoding)
    with pytest.raises(BadInput, match="save the manifest as UTF-8"):
        items(tmp_path / f"m.{kind}")


def test_line_breaks_in_quotes_belong_to_their_cell(tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text('path,text,text.weights\n,"a red\nfox\x0band more",some/pictures\nb.png,,\n')
    fox, b = items(tmp_path / "m.csv")
    assert fox.request is not None and fox.request.text == "a red\nfox\x0band more"
    assert b.name == "b"


@pytest.mark.parametrize("kind", ["csv", "json", "jsonl", "parquet"])
@pytest.mark.parametrize("content", [b"", b"\xef\xbb\xbf", b"\x89PNG\r\n\x1a\n" + bytes(range(256)), DEEP.encode()])
def test_a_file_that_is_no_manifest_is_refused_as_a_whole(tmp_path: Path, kind: str, content: bytes) -> None:
    (tmp_path / f"m.{kind}").write_bytes(content)
    with pytest.raises(BadInput) as refused:
        items(tmp_path / f"m.{kind}")
    assert len(str(refused.value)) < 600
    str(refused.value).encode()


@pytest.mark.parametrize(
    ("text", "says"),
    [('[{"path": "a"}', "not closed"), ('[{"path": "a"}]]', "follows"), ("{}", "list of rows"), ("[]", "no rows")],
)
def test_a_list_that_does_not_end_where_it_should_is_refused(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "m.json").write_text(text)
    with pytest.raises(BadInput, match=says):
        items(tmp_path / "m.json")


def test_nan_is_an_empty_cell_in_parquet_alone(tmp_path: Path) -> None:
    arrow = pytest.importorskip("pyarrow", reason="Parquet needs pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    content: list[dict[str, Any]] = [
        {"path": "a.png", "seed": float("nan"), "priority": None, "name": None},
        {"path": "b.png", "seed": 7.0, "priority": 2, "name": "bee"},
        {"path": "c.png", "seed": 7.5, "priority": None, "name": None},
    ]
    parquet.write_table(arrow.Table.from_pylist(content), tmp_path / "m.parquet")
    bee, a, c = items(tmp_path / "m.parquet")
    assert a.request is not None and (a.name, a.request.seed) == ("a", 3)  # the seed of the batch
    assert bee.request is not None and (bee.name, bee.request.seed, bee.priority) == ("bee", 7, 2)
    assert "row 3: seed 7.5 is not a whole number" in c.error


def test_a_parquet_table_that_unpacks_to_too_much_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arrow = pytest.importorskip("pyarrow", reason="Parquet needs pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    parquet.write_table(arrow.table({"path": ["x" * 10_000] * 5000}), tmp_path / "m.parquet")
    assert (tmp_path / "m.parquet").stat().st_size < 100_000
    monkeypatch.setattr(rows, "LARGEST_TABLE_BYTES", 2**24)
    with pytest.raises(BadInput, match="unpacks to more than"):
        items(tmp_path / "m.parquet")


def test_a_manifest_that_is_too_large_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rows, "LARGEST_MANIFEST_BYTES", 10)
    (tmp_path / "m.csv").write_text("path\na.png\n")
    with pytest.raises(BadInput, match="11 bytes"):
        items(tmp_path / "m.csv")


def test_whatever_else_goes_wrong_with_a_row_is_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(name: str) -> None:
        raise ZeroDivisionError("oh")

    monkeypatch.setattr("flows.inputs.manifest.profile", lambda name: broken(name) if name == "odd" else PREVIEW)
    from steps.profiles import PREVIEW

    (tmp_path / "m.json").write_text(json.dumps([{"path": "a.png"}, {"path": "b.png", "profile": "odd"}]))
    a, b = items_of(tmp_path / "m.json", Path("out"), "preview", {}, 0)
    assert a.error == "" and b.error == "row 2: ZeroDivisionError: oh"


@pytest.mark.parametrize(
    ("value", "seed"), [(7, 7), (7.0, 7), ("7", 7), ("7.0", 7), (" 7 ", 7), (2**63 - 1, 2**63 - 1)]
)
def test_a_seed_may_be_written_as_tables_write_whole_numbers(tmp_path: Path, value: object, seed: int) -> None:
    (tmp_path / "m.json").write_text(json.dumps([{"path": "a.png", "seed": value}]))
    (item,) = items(tmp_path / "m.json")
    assert item.request is not None and item.request.seed == seed


@pytest.mark.parametrize("name", [5, "5"])
def test_a_number_can_be_a_name(tmp_path: Path, name: object) -> None:
    (tmp_path / "m.json").write_text(json.dumps([{"path": "a.png", "name": name}]))
    assert [item.name for item in items(tmp_path / "m.json")] == ["5"]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("..", "a"), (".", "a"), ("/", "a"), ("///", "a"), ("  ", "a"), ("../../b", "b"), ("b\nc\x1b[31m", "bc[31m"),
        ("b/../c", "b/c"), ("CON", "CON"), ("b.", "b."), (None, "a"), ("", "a"),
    ],
)  # fmt: skip
def test_names_lead_nowhere_else_and_have_no_letters_that_a_terminal_obeys(
    tmp_path: Path, name: object, expected: str
) -> None:
    (tmp_path / "m.json").write_text(json.dumps([{"path": "a.png", "name": name}]))
    (item,) = items(tmp_path / "m.json")
    assert (item.name, item.error) == (expected, "")
    assert not re.search(r"\.\.(/|$)", item.name)
