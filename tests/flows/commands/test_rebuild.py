"""Rebuild of packages: outcomes with fake steps, digests with real steps and small settings."""

import json
import math
from collections.abc import Callable
from pathlib import Path

import fake_steps
import numpy as np
import pytest
from fake_steps import picture
from made_package import SOURCE, made_package, record_in
from PIL import Image
from waiting import retry_after

from dg4d_lib.errors import BadInput
from flows import home
from flows.commands.rebuild import RebuildReport, rebuild
from flows.convert import convert_job
from flows.inputs.conversion_job import ConversionJob, ConversionRequest, job_from_record
from flows.inputs.package_record import record_of
from flows.packages.verify import verify
from flows.serving.server import Server
from steps.profiles import PREVIEW, revise
from steps.runtime.job import Job, StepReport
from steps.store.artifact_store import ArtifactStore

TINY = {
    "subject.size": 64,
    "driving.frames": 3,
    "prior.kind": "geometric",
    "prior.size": 48,
    "static.iterations": 2,
    "static.views": 1,
    "static.start.points": 300,
    "static.reference_size": 48,
    "static.resolution_schedule": [{"until": 1.0, "size": 48}],
    "motion.iterations": 2,
    "motion.reference_size": 48,
    "motion.resolution_schedule": [{"until": 1.0, "size": 48}],
    "mesh.grid": 24,
    "mesh.edge_length": 0.1,
    "mesh.texture_size": 64,
    "mesh.render_size": 64,
    "pack.preview_size": 64,
    "pack.preview_turns": 1,
    "pack.sheet_size": 48,
    "pack.sheet_frames": 2,
}


@pytest.fixture
def fakes(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Log of fake steps."""
    monkeypatch.setenv("DG4D_CATALOG", "fake_steps:STEPS")
    monkeypatch.setenv("DG4D_CODE_VERSION", "test")
    monkeypatch.setenv("DG4D_EXECUTOR", "in_process")
    monkeypatch.setenv("FAKE_LOG", str(tmp_path / "ran"))
    retry_after(0.01, monkeypatch)
    return tmp_path / "ran"


def job(words: str, folder: Path, name: str = "fake.png", **changes: object) -> ConversionJob:
    (folder / name).write_text(picture(words))
    return ConversionRequest(
        item="fake", picture=folder / name, settings=revise(PREVIEW, dict(changes)), seed=5
    ).to_job(home.store())


def again(folder: Path, out: Path | None = None, source: Path | None = None) -> RebuildReport:
    record = record_of(folder)
    assert record is not None
    return rebuild(folder, record, job_from_record(record, home.store(), source), out)


def outcomes(rebuilt: RebuildReport) -> dict[str, str]:
    return {comparison.name: comparison.outcome for comparison in rebuilt.comparisons}


def altered(
    step: Callable[[Job], StepReport], port: str, change: Callable[[bytes], bytes]
) -> Callable[[Job], StepReport]:
    """Step whose output is changed."""

    def run(job: Job) -> StepReport:
        facts = step(job)
        job.outputs[port].write_bytes(change(job.outputs[port].read_bytes()))
        return facts

    return run


def test_every_step_runs_again_and_gives_the_same(fakes: Path, tmp_path: Path) -> None:
    wanted = job("same", tmp_path)
    convert_job(wanted, tmp_path / "out")
    ran = fakes.read_text()
    fakes.unlink()
    rebuilt = again(tmp_path / "out", tmp_path / "again")
    assert sorted(fakes.read_text().split()) == sorted(ran.split())
    assert set(outcomes(rebuilt).values()) == {"identical"}
    assert len(rebuilt.comparisons) == len(ran.split()) + 4  # files
    assert rebuilt.environment_changes == ()
    assert list(rebuilt.rows())[-1] == ("4 files", "identical", "")
    assert rebuilt.exit_code == 0
    one, two = (record_of(tmp_path / name) for name in ("out", "again"))
    assert one is not None and two is not None
    assert one.pop("run") != two.pop("run")
    assert one == two
    assert verify(tmp_path / "again").exit_code == 0


def test_words_and_meshes_per_frame_are_rebuilt_too(
    fakes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = revise(PREVIEW, {"text.weights": "somebody/pictures", "mesh.mode": "per_frame"})
    monkeypatch.setenv("DG4D_CPUS", "3")
    convert_job(
        ConversionRequest(item="words", text="a red  fox", settings=settings).to_job(home.store()), tmp_path / "out"
    )
    record = record_of(tmp_path / "out")
    assert record is not None
    assert record["recipe"]["text"] == "a red fox"
    monkeypatch.setenv("DG4D_CPUS", "1")  # another machine, which divides the frames as the first one did
    found = outcomes(rebuild(tmp_path / "out", record, job_from_record(record, ArtifactStore(home.store().root))))
    assert set(found.values()) == {"identical"}
    assert {"draw_picture", "extract_mesh 1/3", "extract_mesh 3/3"} <= set(found)


def curves(factor: float) -> Callable[[bytes], bytes]:
    def change(content: bytes) -> bytes:
        tree = json.loads(content)
        tree["series"]["loss"] = [value * factor for value in tree["series"]["loss"]]
        return json.dumps(tree).encode()

    return change


def test_a_little_is_within_tolerance_more_is_different_and_what_is_lost_is_not_compared(
    fakes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    convert_job(job("near", tmp_path), tmp_path / "out")
    record = record_of(tmp_path / "out")
    assert record is not None
    (motion,) = [step["outputs"]["motion"] for step in record["steps"] if step["step"] == "fit_motion"]
    plain = fake_steps.fit_motion

    monkeypatch.setattr(fake_steps, "fit_motion", altered(plain, "curves", curves(1.001)))
    rebuilt = again(tmp_path / "out")
    (near,) = [comparison for comparison in rebuilt.comparisons if comparison.outcome != "identical"]
    assert (near.name, near.outcome) == ("fit_motion", "within tolerance")
    assert near.difference == pytest.approx(0.001 / math.sqrt(3), rel=0.02)
    assert "curves" in near.detail
    assert rebuilt.exit_code == 0

    monkeypatch.setattr(fake_steps, "fit_motion", altered(plain, "curves", curves(2.0)))
    rebuilt = again(tmp_path / "out")
    assert outcomes(rebuilt)["fit_motion"] == "different"
    assert rebuilt.exit_code == 1

    (blob,) = (home.store().root / "sha256").rglob(motion.removeprefix("sha256:"))
    blob.unlink()
    monkeypatch.setattr(fake_steps, "fit_motion", altered(plain, "motion", lambda content: content + b"!"))
    rebuilt = again(tmp_path / "out")
    found = {comparison.name: comparison for comparison in rebuilt.comparisons}
    assert found["fit_motion"].outcome == "not compared"
    assert "motion" in found["fit_motion"].detail and "not in the store" in found["fit_motion"].detail
    assert "no metric" in found["asset.glb"].detail  # a fake, which no reader reads
    assert rebuilt.exit_code == 0


def test_another_file_is_different_and_other_code_is_told(
    fakes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    convert_job(job("code", tmp_path), tmp_path / "out")
    monkeypatch.setenv("DG4D_CODE_VERSION", "newer")
    monkeypatch.setenv("DG4D_IMAGE", "dg4d/cpu:2")
    noise = np.random.default_rng(0).integers(0, 255, (6, 8, 3), np.uint8)
    Image.fromarray(noise).save(tmp_path / "noise.png")
    monkeypatch.setattr(fake_steps, "PNG", (tmp_path / "noise.png").read_bytes())
    monkeypatch.setattr(fake_steps, "_begin", lambda step, job, words: b"code")
    rebuilt = again(tmp_path / "out")
    assert outcomes(rebuilt)["contact_sheet.png"] == "different"
    assert rebuilt.exit_code == 1
    assert "image: none recorded, dg4d/cpu:2 now" in rebuilt.environment_changes
    assert any(text.startswith("code: ") and text.endswith("+newer now") for text in rebuilt.environment_changes)


def test_a_source_that_is_not_in_the_store_must_be_given_and_be_the_same(tmp_path: Path) -> None:
    record = record_in(made_package(tmp_path))
    elsewhere = ArtifactStore(tmp_path / "elsewhere")
    with pytest.raises(BadInput, match="give it with --source"):
        job_from_record(record, elsewhere)
    (tmp_path / "other.png").write_text(picture("other"))
    with pytest.raises(BadInput, match="is not the source of this package"):
        job_from_record(record, elsewhere, tmp_path / "other.png")
    (tmp_path / "same.png").write_bytes(SOURCE)
    found = job_from_record(record, elsewhere, tmp_path / "same.png")
    assert found.recipe() == record["recipe"]
    assert (found.item, found.source_name, found.profile, found.seed) == ("red fox", "fox.png", "preview", 3)


@pytest.mark.parametrize("damage", ["recipe", "run"])
def test_a_record_of_another_version_is_refused(tmp_path: Path, damage: str) -> None:
    record = record_in(made_package(tmp_path))
    del record[damage]
    with pytest.raises(BadInput, match="another version"):
        job_from_record(record, ArtifactStore(tmp_path / "store"))


@pytest.mark.slow
def test_real_steps_give_equal_bytes_again(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows, columns = np.mgrid[-1:1:96j, -1:1:96j]
    inside = (rows / 0.7) ** 2 + (columns / 0.5) ** 2 < 1
    egg = np.stack([inside * (rows + 1) / 2, inside * 0.4, inside * (columns + 1) / 2, inside], -1)
    Image.fromarray((egg * 255).astype(np.uint8)).save(tmp_path / "egg.png")
    wanted = ConversionRequest(item="egg", picture=tmp_path / "egg.png", settings=revise(PREVIEW, dict(TINY))).to_job(
        home.store()
    )
    monkeypatch.setenv("DG4D_EXECUTOR", "in_process")
    convert_job(wanted, tmp_path / "egg")
    assert verify(tmp_path / "egg").exit_code == 0
    rebuilt = again(tmp_path / "egg")
    assert {name: outcome for name, outcome in outcomes(rebuilt).items() if outcome != "identical"} == {}
    assert {"fit_motion", "asset.glb", "preview.mp4", "canonical/asset4d.safetensors"} <= set(outcomes(rebuilt))
