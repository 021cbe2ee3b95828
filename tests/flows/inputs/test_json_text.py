import json
import os
from pathlib import Path

import pytest

from flows.inputs.json_text import DEEPEST, UnfitJSON, loads, read_object


def nested(depth: int) -> str:
    return "[" * depth + "]" * depth


def test_what_is_fit_is_what_json_says() -> None:
    text = '{"a": [1, 2.5, null, true, "\\u00e9 \\ud83e\\udd8e"], "b": {"a": -3}}'
    assert loads(text) == json.loads(text)
    assert loads(nested(DEEPEST)) == json.loads(nested(DEEPEST))


@pytest.mark.parametrize(
    "text",
    [
        nested(DEEPEST + 1), nested(100_000), '{"a":' * 50_000, "NaN", "[-Infinity]", "1e999", "9" * 101, "9" * 5000,
        '"\\ud800"', '{"\\udfff": 1}', '{"a": 1, "a": 2}', '{"a": {"b": 1, "b": 1}}',
    ],
)  # fmt: skip
def test_what_no_file_can_hold_is_unfit(text: str) -> None:
    with pytest.raises(UnfitJSON) as refused:
        loads(text)
    assert len(str(refused.value)) < 100


@pytest.mark.parametrize("text", ["", "{", "[1,]", "fox", "\ufeff1"])
def test_what_is_no_json_is_another_error(text: str) -> None:
    with pytest.raises(json.JSONDecodeError) as refused:
        loads(text)
    assert not isinstance(refused.value, UnfitJSON)


@pytest.mark.parametrize("text", ["", "[1]", "{", '{"a": NaN}', "\udcff", "[" * 10_000])
def test_a_file_without_an_object_counts_as_empty(tmp_path: Path, text: str) -> None:
    (tmp_path / "file.json").write_bytes(text.encode(errors="surrogateescape"))
    assert read_object(tmp_path / "file.json") == {}


def test_objects_are_read_from_regular_files_alone(tmp_path: Path) -> None:
    (tmp_path / "file.json").write_text('{"a": 1}')
    os.mkfifo(tmp_path / "fifo.json")
    assert read_object(tmp_path / "file.json") == {"a": 1}
    assert read_object(tmp_path / "fifo.json") == read_object(tmp_path / "gone.json") == {}
