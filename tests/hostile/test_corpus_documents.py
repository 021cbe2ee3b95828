"""Scene files and records of packages that somebody else wrote."""

import json
import re
from pathlib import Path

import pytest

from dg4d_lib.errors import BadInput
from flows.commands.compose import compose
from flows.inputs.conversion_job import job_from_record
from flows.inputs.package_record import RECORD, record_of
from flows.packages.publish import check_folder, is_current, load_verified
from flows.packages.verify import verify
from steps.store.artifact_store import ArtifactStore
from tests.hostile import table
from tests.hostile.conftest import Place
from tests.hostile.documents import RECORDS, SCENES


def test_every_document_is_in_the_table() -> None:
    assert set(SCENES) == set(table.SCENES)
    assert set(RECORDS) == set(table.RECORDS)


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_file_is_refused_in_a_sentence(name: str, place: Place) -> None:
    path = place.work / "scene.json"
    path.write_bytes(SCENES[name]())
    (place.work / "gem").mkdir()
    with pytest.raises(BadInput, match=table.SCENES[name].says) as refusal:
        compose([], place.work / "out" / "scene.glb", path)
    assert len(str(refusal.value)) < 10_000
    assert not (place.work / "out").exists()


@pytest.mark.parametrize("name", RECORDS)
def test_a_record_is_refused_or_found_altered(name: str, place: Place) -> None:
    says = verdict(name, place.work)
    assert re.search(table.RECORDS[name].says, says), says
    assert len(says) < 10_000


@pytest.mark.parametrize("name", RECORDS)
def test_a_record_breaks_no_command_that_reads_one(name: str, place: Place) -> None:
    (place.work / RECORD).write_bytes(RECORDS[name]())
    record = record_of(place.work)
    assert record is None or isinstance(record["files"], dict)
    assert not is_current(place.work, "sha256:0")
    for command in (load_verified, check_folder):
        try:
            command(place.work)
        except BadInput as error:
            assert len(str(error)) < 10_000
    if record is not None:
        with pytest.raises(BadInput):
            job_from_record(record, ArtifactStore(place.home / "store"))


def verdict(name: str, folder: Path) -> str:
    """Return what `dg4d verify` says, which must be a refusal or faults, and JSON too."""
    (folder / RECORD).write_bytes(RECORDS[name]())
    try:
        found = verify(folder)
    except BadInput as error:
        return str(error)
    assert found.exit_code == 65
    json.loads(found.model_dump_json())
    return "; ".join(" ".join(row) for row in found.rows())
