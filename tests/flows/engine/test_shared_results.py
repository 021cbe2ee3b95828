"""Two machines with one store: what the first finished, the second does not do again."""

from contextlib import nullcontext
from pathlib import Path

import pytest
from fake_steps import picture
from prefect import flow
from records import record_of, result_with

from flows import home
from flows.convert import convert_job
from flows.engine.records import record_key
from flows.engine.shared_results import fetch_result, sharing_results
from flows.inputs.conversion_job import ConversionJob, ConversionRequest
from flows.packages.delivery import RESULTS
from flows.serving.server import Server
from steps.contract import StepRequest
from steps.profiles import PREVIEW

STEPS = 8


@pytest.fixture
def log(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """File in which steps note that they ran; the store is shared."""
    monkeypatch.setenv("DG4D_STORE", str(tmp_path / "store"))
    monkeypatch.setenv("DG4D_CATALOG", "fake_steps:STEPS")
    monkeypatch.setenv("DG4D_CODE_VERSION", tmp_path.name)
    monkeypatch.setenv("DG4D_EXECUTOR", "in_process")
    monkeypatch.setenv("FAKE_LOG", str(tmp_path / "ran"))
    return tmp_path / "ran"


@pytest.mark.parametrize(("shares", "again"), [(True, 0), (False, STEPS)])
def test_a_machine_takes_over_what_another_finished(
    shares: bool, again: int, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def make_on(machine: str) -> int:
        monkeypatch.setenv("DG4D_HOME", str(tmp_path / machine))
        log.unlink(missing_ok=True)
        with sharing_results(home.store()) if shares else nullcontext():
            convert_job(job(), tmp_path / machine / "out")
        return len(log.read_text().split()) if log.exists() else 0

    def job() -> ConversionJob:
        (tmp_path / "fox.png").write_text(picture(f"shared {shares}"))
        return ConversionRequest(item="fox", picture=tmp_path / "fox.png", settings=PREVIEW).to_job(home.store())

    assert make_on("first") == STEPS
    assert make_on("second") == again
    assert len(list((tmp_path / "second" / "results").iterdir())) == STEPS
    assert len(list(home.store().entries(RESULTS))) == (STEPS if shares else 0)


def test_a_conversion_within_another_flow_keeps_its_records_under_home(log: Path, tmp_path: Path) -> None:
    (tmp_path / "fox.png").write_text(picture("within"))

    @flow(persist_result=False)
    def outer() -> None:
        convert_job(
            ConversionRequest(item="fox", picture=tmp_path / "fox.png", settings=PREVIEW).to_job(home.store()),
            tmp_path / "out",
        )

    before = set(home.records().iterdir()) if home.records().exists() else set()
    outer()
    assert len(set(home.records().iterdir()) - before) == STEPS


def test_a_result_is_fetched_only_by_a_process_that_shares(log: Path, tmp_path: Path) -> None:
    request = StepRequest(step="pack_asset", version="1", inputs={}, settings={}, seed=0)
    store, record = home.store(), tmp_path / "results" / record_key(request)
    shared = record_of(result_with(store.put_bytes(b"content", "a/b"), request.digest()))
    store.write(f"{RESULTS}/{record.name}", shared)
    fetch_result(record.name, record)
    assert not record.exists()  # nobody shares
    with sharing_results(store):
        fetch_result(record.name, record)
    assert record.read_text() == shared


def test_a_shared_record_that_is_torn_is_not_fetched(log: Path, tmp_path: Path) -> None:
    store, record = home.store(), tmp_path / "results" / "pack_asset-0"
    store.write(f"{RESULTS}/{record.name}", "torn")
    with sharing_results(store):
        fetch_result(record.name, record)
    assert not record.exists()
