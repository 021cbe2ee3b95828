"""The schema of provenance.json: it takes the records that are written, and nothing else."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator
from made_package import WEIGHTS, made_package, record_in
from signing import identity

from flows.packages.record_schema import record_schema


@pytest.fixture(scope="module")
def validator() -> Draft202012Validator:
    Draft202012Validator.check_schema(record_schema())
    return Draft202012Validator(record_schema())


@pytest.fixture
def record(tmp_path: Path) -> dict[str, Any]:
    return record_in(made_package(tmp_path, weights=WEIGHTS))


def test_records_of_packages_are_valid(validator: Draft202012Validator, record: dict[str, Any], tmp_path: Path) -> None:
    with identity(tmp_path / "keys").configured():
        signed = record_in(made_package(tmp_path / "signed"))
    assert signed["signatures"]["files"]
    assert [error.message for each in (record, signed) for error in validator.iter_errors(each)] == []


FAULTS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "another format": lambda record: record.update(format=3),
    "no recipe": lambda record: record.pop("recipe"),
    "an unknown field": lambda record: record.update(made_by="me"),
    "a path for a digest": lambda record: record.update(source="/home/me/fox.png"),
    "a negative size": lambda record: record["files"]["asset.glb"].update(size_bytes=-1),
    "a fact of the run in a step": lambda record: record["steps"][0].update(duration_s=1.0),
    "a run without machine": lambda record: record["run"]["steps"][0].pop("machine"),
    "half a signature": lambda record: record["signatures"].update(subject="CN=me"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_other_records_are_not(validator: Draft202012Validator, record: dict[str, Any], fault: str) -> None:
    FAULTS[fault](record)
    assert not validator.is_valid(record)
