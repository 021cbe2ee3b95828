import errno
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from dg4d_lib.errors import BackendUnavailable, BadInput, FitDiverged
from dg4d_lib.settings import Settings
from steps.contract import ArtifactRef, Port, StepFailure, StepRequest, StepResult, StepSpec
from steps.runtime import installed_code, program
from steps.runtime.job import Job, StepReport
from steps.runtime.perform import perform
from steps.runtime.process_setup import cpu_seconds
from steps.store.artifact_store import ArtifactMissing, ArtifactStore

TEXT = Port(media_type="text/plain", suffix=".txt")


class ShoutSettings(Settings):
    """Of the step below."""

    times: int = 1
    trouble: str = ""


TROUBLES: dict[str, BaseException] = {
    "bad": BadInput("the text is ugly"),
    "missing": BackendUnavailable("no megaphone"),
    "gone": ArtifactMissing("gone"),
    "diverged": FitDiverged("loss is nan at iteration 7"),
    "memory": MemoryError("no memory"),
    "torch memory": RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 99 bytes"),
    "full": OSError(errno.ENOSPC, "No space left on device"),
    "bug": ZeroDivisionError("division by zero"),
    "exit": SystemExit(3),
}


def shout(job: Job) -> StepReport:
    """A step: upper case, some times over."""
    (job.pictures / "last.png").write_bytes(b"picture")
    if job.settings.trouble in TROUBLES:
        raise TROUBLES[job.settings.trouble]
    for i in range(job.settings.times):
        job.progress(i + 1, job.settings.times, {"loss": 1.0})
    print("a library talks")  # noqa: T201
    os.write(1, b"so does native code\n")
    if job.settings.trouble != "forgets":
        job.outputs["loud"].write_text(job.inputs["quiet"].read_text().upper() * job.settings.times)
    return StepReport(backend="voice", notes=("It was loud.",), licenses={"voice": "free"})


CATALOG = {
    "shout": StepSpec(
        name="shout",
        version="3",
        entry="test_main:shout",
        settings="test_main:ShoutSettings",
        inputs={"quiet": TEXT, "extra": TEXT.model_copy(update={"optional": True})},
        outputs={"loud": TEXT, "echo": TEXT.model_copy(update={"optional": True})},
    )
}


@pytest.fixture(autouse=True)
def catalog(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DG4D_CATALOG", "test_main:CATALOG")


@pytest.fixture
def store(tmp_path: Path) -> ArtifactStore:
    return ArtifactStore(tmp_path / "store")


def request_for(store: ArtifactStore, **settings: Any) -> StepRequest:
    return StepRequest(
        step="shout", version="3", inputs={"quiet": store.put_bytes(b"hey", "text/plain")}, settings=settings, seed=4
    )


def failure(request: StepRequest, store: ArtifactStore) -> StepFailure:
    outcome, _ = perform(request, store)
    assert isinstance(outcome, StepFailure)
    return outcome


def test_a_request_becomes_outputs_and_a_record(store: ArtifactStore) -> None:
    request = request_for(store, times=2)
    seen: list[tuple[int, int]] = []
    outcome, error = perform(request, store, lambda done, total, values: seen.append((done, total)))
    assert isinstance(outcome, StepResult)
    assert error is None
    assert store.path(outcome.outputs["loud"]).read_text() == "HEYHEY"
    assert set(outcome.outputs) == {"loud"}
    record = outcome.provenance
    assert record.request_digest == request.digest()
    assert record.inputs["quiet"] == request.inputs["quiet"].digest
    assert record.outputs["loud"] == outcome.outputs["loud"].digest
    assert (record.seed, record.backend, record.notes, record.licenses) == (
        4,
        "voice",
        ("It was loud.",),
        {"voice": "free"},
    )
    assert record.peak_memory_mb > 1
    assert seen == [(1, 2), (2, 2)]


@pytest.mark.parametrize(
    ("trouble", "kind"),
    [
        ("bad", "bad_input"),
        ("missing", "missing"),
        ("gone", "lost"),
        ("diverged", "diverged"),
        ("memory", "out_of_memory"),
        ("torch memory", "out_of_memory"),
        ("full", "bad_input"),
        ("bug", "crashed"),
        ("exit", "crashed"),
        ("forgets", "crashed"),
    ],
)
def test_every_trouble_has_its_kind_and_keeps_its_pictures(store: ArtifactStore, trouble: str, kind: str) -> None:
    found = failure(request_for(store, trouble=trouble), store)
    assert found.kind == kind
    assert store.path(found.pictures["last"]).read_bytes() == b"picture"


@pytest.mark.parametrize("trouble", ["memory", "torch memory"])
def test_without_memory_a_step_says_what_to_do(store: ArtifactStore, trouble: str) -> None:
    assert "or lower subject.size, static.views" in failure(request_for(store, trouble=trouble), store).message


def test_a_forgotten_output_is_named(store: ArtifactStore) -> None:
    assert "loud" in failure(request_for(store, trouble="forgets"), store).message


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"step": "sing"}, "unknown step 'sing'; there are: shout"),
        ({"inputs": {}}, "needs the input quiet"),
        ({"settings": {"time": 2}}, "time = 2: Extra inputs"),
        ({"settings": {"times": "many"}}, "times = 'many'"),
        ({"version": "2"}, "the code changed"),
        ({"version": "3+000000000000"}, "the code changed"),
    ],
)
def test_a_wrong_request_is_bad_input_and_says_why(store: ArtifactStore, change: dict[str, Any], says: str) -> None:
    found = failure(request_for(store).model_copy(update=change), store)
    assert found.kind == "bad_input"
    assert says in found.message


def test_an_input_the_step_does_not_have_is_refused(store: ArtifactStore) -> None:
    request = request_for(store)
    extra = request.model_copy(update={"inputs": {**request.inputs, "third": request.inputs["quiet"]}})
    assert "no input third" in failure(extra, store).message


def test_an_artifact_that_is_gone_is_missing(store: ArtifactStore) -> None:
    gone = ArtifactRef(digest="sha256:" + "1" * 64, media_type="text/plain", size_bytes=3)
    assert failure(request_for(store).model_copy(update={"inputs": {"quiet": gone}}), store).kind == "lost"


def test_the_version_of_a_request_follows_the_source() -> None:
    version = installed_code.request_version(CATALOG["shout"])
    assert version.startswith("3+")
    assert len(version) == 2 + 12
    other = CATALOG["shout"].model_copy(update={"entry": "test_store:anything"})
    assert installed_code.code_version(other) != installed_code.code_version(CATALOG["shout"])


def test_only_source_files_count_for_the_version_of_the_code() -> None:
    """Kernels that are compiled during a run lie beside the source and must not make another request of the next."""
    names = [name for name, *_ in installed_code._source_files()]
    assert "dg4d_lib/settings.py" in names
    assert all(name.endswith(".py") for name in names)


def test_an_image_may_fix_the_version_of_its_code(store: ArtifactStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DG4D_CODE_VERSION", "image-7")
    outcome, _ = perform(request_for(store).model_copy(update={"version": "3+image-7"}), store)
    assert isinstance(outcome, StepResult)
    assert outcome.provenance.code_version.endswith("+image-7")


def run_alone(tmp_path: Path, request: str, *arguments: str) -> tuple[subprocess.CompletedProcess[str], Any]:
    (tmp_path / "request.json").write_text(request)
    files = [str(tmp_path / "request.json"), str(tmp_path / "result.json")]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    command = [sys.executable, "-m", "steps.main", *files, "--store", str(tmp_path / "store"), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    result = tmp_path / "result.json"
    return done, json.loads(result.read_text()) if result.exists() else None


def test_a_step_runs_alone_and_only_progress_goes_to_standard_output(store: ArtifactStore, tmp_path: Path) -> None:
    done, result = run_alone(tmp_path, request_for(store).model_dump_json())
    assert done.returncode == 0, done.stderr
    assert [json.loads(line) for line in done.stdout.splitlines()] == [{"done": 1, "total": 1, "values": {"loss": 1.0}}]
    assert "so does native code" in done.stderr
    assert store.has(StepResult.model_validate(result).outputs["loud"])


@pytest.mark.parametrize(
    ("trouble", "status"), [("bad", 65), ("missing", 69), ("diverged", 70), ("memory", 137), ("bug", 1)]
)
def test_the_exit_status_says_what_happened(store: ArtifactStore, tmp_path: Path, trouble: str, status: int) -> None:
    (tmp_path / "request.json").write_text(request_for(store, trouble=trouble).model_dump_json())
    files = [str(tmp_path / "request.json"), str(tmp_path / "result.json")]
    progress = ["--store", str(store.root), "--progress", str(tmp_path / "progress")]
    assert program.main([*files, *progress]) == status
    assert StepFailure.model_validate_json((tmp_path / "result.json").read_text()).step == "shout"


def test_a_request_that_is_no_json_is_bad_input(tmp_path: Path) -> None:
    (tmp_path / "request.json").write_text("{")
    files = [str(tmp_path / "request.json"), str(tmp_path / "result.json")]
    assert program.main([*files, "--progress", str(tmp_path / "p")]) == 65
    assert "not a StepRequest" in json.loads((tmp_path / "result.json").read_text())["message"]


def test_a_step_ends_with_the_process_that_wanted_it(store: ArtifactStore, tmp_path: Path) -> None:
    done, result = run_alone(tmp_path, request_for(store).model_dump_json(), "--parent", "1")
    assert done.returncode == 1
    assert result is None


def test_processor_time_is_that_of_the_step_and_of_what_it_started() -> None:
    before = cpu_seconds()
    spin = "import time\nwhile time.process_time() < 0.3: pass"
    subprocess.run([sys.executable, "-c", spin], check=True)
    assert 0.3 <= cpu_seconds() - before < 3


def test_the_source_is_read_once_for_many_requests(monkeypatch: pytest.MonkeyPatch) -> None:
    version = installed_code.request_version(CATALOG["shout"])
    monkeypatch.setattr(installed_code, "_source_files", lambda: pytest.fail("it was read already"))
    assert installed_code.request_version(CATALOG["shout"]) == version
