"""Records of results: read as plain data, whatever class or serializer they name."""

import json
from pathlib import Path
from typing import Any

import pytest
from prefect.serializers import PickleSerializer
from records import record_of, result_with

from flows.engine.records import parse_record, read_record
from flows.tasks import Subject
from steps.contract import ArtifactRef

RESULT = result_with(ArtifactRef(digest="sha256:" + "1" * 64, media_type="a/b", size_bytes=1))
OPENER = {"__class__": "pathlib.Path", "data": "/"}


def changed(content: dict[str, Any], serializer: dict[str, Any] | None = None) -> str:
    """Return a sound record with parts of its content, or of its serializer, replaced."""
    record = json.loads(record_of(RESULT))
    record["result"] = json.dumps(json.loads(record["result"]) | content)
    record["metadata"]["serializer"] |= serializer or {}
    return json.dumps(record)


def with_setting(value: Any) -> dict[str, Any]:
    """Return a sound result of a step that had this setting; settings may have any value of JSON."""
    data = RESULT.model_dump(mode="json")
    data["provenance"]["settings"] = {"a": value}
    return data


def test_results_of_steps_and_of_tasks_are_read() -> None:
    assert parse_record(record_of(RESULT)) == RESULT
    assert parse_record(record_of(Subject(**dict(RESULT)))) == RESULT
    assert parse_record(changed({"data": with_setting([{"deep": 1}])})) is not None


@pytest.mark.parametrize(
    "record",
    [
        changed({"__class__": "builtins.eval"}),
        changed({"__class__": "flows.tasks.run_step"}),
        changed({"__class__": "flows.tasks.Subject.model_validate"}),
        changed({"__exc_type__": "builtins.SystemExit", "message": "1"}),
        changed({"data": dict(RESULT.model_dump(mode="json"), outputs=OPENER)}),
        changed({"data": dict(RESULT.model_dump(mode="json"), outputs={"o": [OPENER]})}),
        changed({"data": with_setting(OPENER)}),
        changed({"data": with_setting([{"deep": OPENER}])}),
        changed({"data": {"__exc_type__": "builtins.SystemExit", "message": "1"}}),
        changed({}, PickleSerializer().model_dump()),
        changed({}, {"object_decoder": "os.system"}),
        changed({}, {"jsonlib": "antigravity"}),
        record_of([1]),
        record_of(None),
        "[" * 100_000,
        "torn",
        "",
    ],
)
def test_a_record_that_would_have_anything_else_imported_is_none(record: str, tmp_path: Path) -> None:
    assert parse_record(record) is None
    (tmp_path / "record").write_text(record)
    assert read_record(tmp_path / "record") is None


def test_a_file_that_cannot_be_read_is_none(tmp_path: Path) -> None:
    (tmp_path / "bytes").write_bytes(b"\xff")
    assert read_record(tmp_path / "bytes") is None
    assert read_record(tmp_path / "none") is None
