"""Conversion of a job without a server: leases on its files, and the check of the output folder."""

import json
import os
import threading
import zipfile
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fake_steps import picture

from dg4d_lib.errors import BadInput
from flows import convert, home
from flows.commands import rebuild
from flows.convert import convert_job, rank_motions, stored
from flows.engine import leases
from flows.engine.collecting import collect
from flows.inputs.conversion_job import ConversionJob, ConversionRequest
from flows.inputs.package_record import FORMAT, record_of
from flows.packages.publish import Files, publish
from steps.contract import ArtifactRef
from steps.profiles import PREVIEW
from steps.store.artifact_store import object_name

NO_STEPS: Any = SimpleNamespace(steps=[])


@pytest.fixture
def request_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], ConversionRequest]:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("DG4D_CODE_VERSION", "test")

    def make(item: str) -> ConversionRequest:
        (tmp_path / f"{item}.png").write_text(picture(item))
        return ConversionRequest(item=item, picture=tmp_path / f"{item}.png", settings=PREVIEW)

    return make


def collected() -> list[str]:
    """Collect garbage without grace; return the digests of what was removed."""
    return [entry.name for entry in collect(home.store(), home.records(), grace_s=0).artifacts]


def age(ref: ArtifactRef) -> None:
    """Date an artifact back, as if an earlier process had stored it."""
    os.utime(home.store().root / object_name(ref.digest), (1, 1))


def test_a_garbage_collection_between_storing_and_converting_takes_no_source(
    request_of: Callable[[str], ConversionRequest], tmp_path: Path
) -> None:
    def run(job: ConversionJob, folder: Path) -> Any:
        age(job.source)
        assert collected() == [] and home.store().has(job.source)
        return NO_STEPS

    with stored(request_of("fox")) as job:
        assert collected() == []
        convert_job(job, tmp_path / "out", run)
    assert list(home.store().entries(leases.FOLDER)) == []
    assert collected() == [job.source.digest]  # it is old, and no version needs it


def test_motions_and_a_rebuild_keep_the_source_from_a_garbage_collection(
    request_of: Callable[[str], ConversionRequest], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Ended(Exception):
        """The flow, which is not run, would have begun."""

    def flow(*_: object, **__: object) -> None:
        assert collected() == []
        raise Ended

    job = request_of("fox").to_job(home.store())
    age(job.source)
    monkeypatch.setattr("flows.ui.showing.run_again", flow)
    monkeypatch.setattr(convert, "_flow_context", lambda _: nullcontext())
    with pytest.raises(Ended):
        rank_motions(job, tmp_path / "motions")
    monkeypatch.setattr(rebuild, "run_flow", flow)
    with pytest.raises(Ended):
        rebuild.rebuild(tmp_path / "package", {"steps": [], "run": {"steps": []}}, job)
    assert collected() == [job.source.digest]


def test_of_two_commands_for_one_folder_the_second_does_not_replace_the_asset_of_the_first(
    request_of: Callable[[str], ConversionRequest], tmp_path: Path
) -> None:
    out, fox, cat = tmp_path / "out", *(request_of(item).to_job(home.store()) for item in ("fox", "cat"))
    started, begun = threading.Event(), threading.Event()

    def run(job: ConversionJob, folder: Path) -> Any:
        started.set()
        begun.wait(5)
        with zipfile.ZipFile(tmp_path / "package.zip", "w") as package:
            package.writestr("asset.glb", job.item)

        def finish(staging: Path, files: Files) -> Files:
            record = {"format": FORMAT, "order": job.digest(), "item": job.item, "files": files, "beside": []}
            (staging / "provenance.json").write_text(json.dumps(record))
            return files

        publish(tmp_path / "package.zip", folder, finish)
        return NO_STEPS

    first = threading.Thread(target=convert_job, args=(fox, out, run, False))
    first.start()
    started.wait(5)
    threading.Timer(0.1, begun.set).start()
    with pytest.raises(BadInput, match="holds the asset 'fox'"):
        convert_job(cat, out, run, force=False)
    first.join()
    assert (out / "asset.glb").read_text() == "fox"
    convert_job(cat, out, run, force=True)
    assert (record_of(out) or {})["item"] == "cat"
