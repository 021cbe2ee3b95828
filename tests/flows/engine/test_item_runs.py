"""Runs of items by a deployment: begun once, found again, given up; what travels through the store."""

import pickle
import threading
import time
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from fake_steps import picture
from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.client.schemas.objects import FlowRun
from prefect.settings import PREFECT_API_URL
from prefect.states import Cancelled, Completed, Crashed, Failed, Pending, Running, State

from dg4d_lib.errors import BackendUnavailable, BadInput
from flows import home, step_errors
from flows.engine import item_runs, resources
from flows.engine.item_runs import (
    JOB_MEDIA_TYPE,
    ItemDeployment,
    ItemFailed,
    code_version,
    failure,
    item_deployment,
    read_job,
)
from flows.inputs.conversion_job import ConversionJob, ConversionRequest
from flows.packages.delivery import Outcome, pack_package, read_outcome, remove_expired, unpack_package, write_outcome
from flows.serving import registering
from flows.serving.pools import read_pools
from flows.serving.server import Server
from flows.step_errors import StepBadInput, StepError, StepOutOfMemory
from steps.contract import ArtifactRef
from steps.profiles import PREVIEW

STEP_ERRORS = [kind for kind in vars(step_errors).values() if isinstance(kind, type) and issubclass(kind, StepError)]


@pytest.fixture(scope="module")
def client(server: Server) -> Iterator[SyncPrefectClient]:
    """Of a server with two pools that take items, and no worker."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DG4D_HOME", str(server.folder.parent))
        patch.setenv("DG4D_CATALOG", "fake_steps:STEPS")
        patch.setenv("DG4D_CODE_VERSION", "items")
        patch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))
        patch.setenv("PREFECT_API_URL", str(PREFECT_API_URL.value()))
        registering.register(read_pools(), ["process-cpu", "fleet"])
        with get_client(sync_client=True) as client:
            yield client


@pytest.fixture
def job(client: SyncPrefectClient, tmp_path: Path) -> ConversionJob:
    (tmp_path / "fox.png").write_text(picture(f"item {tmp_path}"))
    return ConversionRequest(item="fox", picture=tmp_path / "fox.png", settings=PREVIEW).to_job(home.store())


@pytest.fixture
def reference(job: ConversionJob) -> ArtifactRef:
    return home.store().put_bytes(job.model_dump_json().encode(), JOB_MEDIA_TYPE)


@pytest.fixture
def package(tmp_path: Path) -> ArtifactRef:
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "asset.glb").write_bytes(b"glb")
    return pack_package(tmp_path / "package", home.store())


@pytest.mark.slow
def test_an_item_is_begun_once_and_again_only_after_it_failed(
    client: SyncPrefectClient, job: ConversionJob, reference: ArtifactRef, package: ArtifactRef
) -> None:
    fleet, store = item_deployment("fleet", 4), home.store()

    def begin() -> FlowRun:
        return fleet._begin(client, job, reference, store)

    def end(run: FlowRun, state: State[Any]) -> None:
        client.set_flow_run_state(run.id, state, force=True)

    first = begin()
    assert first.work_pool_name == "fleet" and first.parameters["item"] == "fox" and "preview" in first.tags
    for state in (Pending(), Running()):
        end(first, state)
        assert begin().id == first.id
    renamed = job.model_copy(update={"item": "another name of it"})
    assert (
        fleet._begin(client, renamed, store.put_bytes(renamed.model_dump_json().encode(), JOB_MEDIA_TYPE), store).id
        != first.id
    )
    assert item_deployment("process-cpu", 4)._begin(client, job, reference, store).id != first.id
    end(first, Completed())
    write_outcome(store, str(first.id), Outcome(package=package))
    assert begin().id == first.id  # its package is there
    store.drop([package.digest])
    second = begin()
    assert second.id != first.id
    end(second, Failed())
    third = begin()
    assert third.id not in {first.id, second.id}
    end(third, Cancelled())
    assert begin().id not in {first.id, second.id, third.id}


def test_a_crashed_run_is_waited_for_until_the_server_would_have_begun_it_again(
    client: SyncPrefectClient, job: ConversionJob, reference: ArtifactRef, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet = ItemDeployment(item_deployment("fleet", 1).name, "fleet", poll_s=0.02)
    run = fleet._begin(client, job, reference, home.store())
    client.set_flow_run_state(run.id, Running(), force=True)
    client.set_flow_run_state(run.id, Crashed(), force=True)
    ended: list[FlowRun] = []
    waiting = threading.Thread(
        target=lambda: ended.append(fleet._wait(client, client.read_flow_run(run.id), "fox")), daemon=True
    )
    waiting.start()
    time.sleep(0.5)
    assert waiting.is_alive()
    monkeypatch.setattr(item_runs, "CRASHED_S", 0.1)
    waiting.join(60)
    assert ended[0].state is not None and ended[0].state.is_crashed()
    assert item_runs._outcome_of(ended[0], home.store()).may_heal
    client.set_flow_run_state(run.id, Cancelled(), force=True)
    cancelled = item_runs._outcome_of(client.read_flow_run(run.id), home.store())
    assert (cancelled.kind, cancelled.may_heal) == ("Cancelled", False)


def test_a_run_whose_worker_died_before_it_began_is_scheduled_again(
    client: SyncPrefectClient, job: ConversionJob, reference: ArtifactRef, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet = item_deployment("fleet", 1)
    run = fleet._begin(client, job, reference, home.store())
    client.set_flow_run_state(run.id, Pending(), force=True)
    client.send_worker_heartbeat("fleet", "alive", 30.0)

    def is_stranded(worker: str) -> bool:
        client.update_flow_run_labels(run.id, {item_runs.WORKER_LABEL: worker})
        return item_runs._is_stranded(client, client.read_flow_run(run.id), "fleet")

    assert not is_stranded("dead")  # it may still be pulling an image
    monkeypatch.setattr(item_runs, "PENDING_S", 0.0)
    assert is_stranded("dead") and not is_stranded("alive")


def test_a_user_who_stops_takes_back_what_no_worker_has_begun(
    client: SyncPrefectClient, job: ConversionJob, reference: ArtifactRef, tmp_path: Path
) -> None:
    fleet = item_deployment("fleet", 1)
    run = fleet._begin(client, job, reference, home.store())
    resources.stopping.set()
    with pytest.raises(resources.Stopped):
        fleet._wait(client, run, "fox")
    assert client.read_flow_run(run.id).state_name == "Cancelled"
    again = fleet._begin(client, job, reference, home.store())
    client.set_flow_run_state(again.id, Running(), force=True)
    with pytest.raises(resources.Stopped):
        fleet._wait(client, client.read_flow_run(again.id), "fox")
    assert client.read_flow_run(again.id).state_name == "Running"


def test_a_pool_of_items_is_named_unless_there_is_only_one(client: SyncPrefectClient) -> None:
    assert item_deployment("fleet", 64) == ("item-to-4d/Item to 4D on a fleet", "fleet", 64 / item_runs.POLLS_PER_S)
    for pool in ("", "flet"):
        with pytest.raises(BadInput, match="one of: fleet, process-cpu"):
            item_deployment(pool, 1)


def test_a_worker_with_other_code_or_another_store_refuses_an_item(
    job: ConversionJob, reference: ArtifactRef, tmp_path: Path
) -> None:
    store = home.store()
    assert read_job(reference, code_version(), store, "") == job
    with pytest.raises(BackendUnavailable, match="another version of dg4d"):
        read_job(reference, "sha256:" + "0" * 64, store, "")
    with pytest.raises(BackendUnavailable, match="s3://theirs: set"):
        read_job(reference.model_copy(update={"digest": "sha256:" + "0" * 64}), code_version(), store, "s3://theirs")


@pytest.mark.parametrize(
    ("error", "kind", "may_heal"),
    [
        (StepOutOfMemory("fit_motion", "killed"), "StepOutOfMemory", True),
        (StepBadInput("prepare_subject", "ugly"), "StepBadInput", False),
        (BadInput("no"), "BadInput", False),
        (ZeroDivisionError("division by zero"), "Crashed", True),
    ],
)
def test_a_failure_is_the_same_here_and_elsewhere(error: Exception, kind: str, may_heal: bool) -> None:
    outcome = failure(error)
    assert (outcome.kind, outcome.may_heal) == (kind, may_heal)
    travelled = Outcome.model_validate_json(outcome.model_dump_json())
    assert failure(ItemFailed(travelled)) == outcome


def test_a_package_travels_whole_or_not_at_all(job: ConversionJob, package: ArtifactRef, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="no valid provenance"):
        unpack_package(package, tmp_path / "out", home.store())
    assert not (tmp_path / "out").exists()
    assert pack_package(tmp_path / "package", home.store()) == package  # equal folders, equal bytes


def test_what_travelled_a_day_ago_is_forgotten(job: ConversionJob, monkeypatch: pytest.MonkeyPatch) -> None:
    store = home.store()
    write_outcome(store, "old", Outcome(kind="Crashed"))
    remove_expired(store)
    assert read_outcome(store, "old") is not None
    tomorrow = store.now() + timedelta(days=1, seconds=1).total_seconds()
    monkeypatch.setattr(type(store), "now", lambda self: tomorrow)
    remove_expired(store)
    assert read_outcome(store, "old") is None


@pytest.mark.parametrize("kind", STEP_ERRORS)
def test_the_failure_of_a_step_passes_between_processes(kind: type[StepError]) -> None:
    picture = ArtifactRef(digest=f"sha256:{'0' * 64}", media_type="image/png", size_bytes=1)
    found = pickle.loads(pickle.dumps(kind("fit_motion", "no", {"last": picture})))
    assert type(found) is kind and str(found) == "fit_motion: no"
    assert (found.step, found.message, found.pictures) == ("fit_motion", "no", {"last": picture})


def test_the_failure_of_an_item_passes_between_processes() -> None:
    outcome = Outcome(kind="StepBadInput", message="no", step="fit_motion")
    found = pickle.loads(pickle.dumps(ItemFailed(outcome)))
    assert (type(found), str(found), found.outcome, found.step) == (ItemFailed, "no", outcome, "fit_motion")
