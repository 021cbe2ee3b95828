"""Runs of processes that were killed: found by a label, told apart from those of other machines."""

import os
import subprocess
from collections.abc import Callable

import pytest
from prefect import flow
from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.client.schemas.objects import FlowRun
from prefect.runtime import flow_run
from prefect.states import Running

from flows.engine import orphans
from flows.engine.orphans import LABEL, claim_run, process_identity, settle_orphans
from flows.processes import host_id
from flows.serving.server import Server

Begin = Callable[[str], FlowRun]


@flow(name="claimed", persist_result=False)
def claimed() -> str:
    claim_run()
    return str(flow_run.id)


@pytest.fixture
def begin(server: Server) -> Begin:
    """Create a run that the server takes for running, with this process in its label."""

    def begun(identity: str) -> FlowRun:
        with get_client(sync_client=True) as client:
            run = client.create_flow_run(claimed, state=Running())
            client.update_flow_run_labels(run.id, {LABEL: identity})
            return run

    return begun


def dead_process() -> str:
    process = subprocess.Popen(["sleep", "60"])
    identity = process_identity(process.pid)
    process.kill()
    process.wait()
    return identity


def state_of(client: SyncPrefectClient, run: FlowRun) -> str:
    return client.read_flow_run(run.id).state_name or ""


def test_runs_of_dead_processes_of_this_machine_are_crashed_and_no_others(
    begin: Begin, monkeypatch: pytest.MonkeyPatch
) -> None:
    settle_orphans()
    monkeypatch.setattr(orphans, "PAGE", 2)
    dead = dead_process()
    runs = {
        "mine": begin(process_identity()),
        "dead": begin(dead),
        "dead too": begin(dead),
        "number used again": begin(f"{host_id()}:{os.getpid()}:1"),
        "elsewhere": begin(dead.replace(host_id(), "another")),
        "nobody": begin(""),
        "strange": begin("no:identity"),
    }
    assert settle_orphans() == 3
    assert settle_orphans() == 0
    with get_client(sync_client=True) as client:
        crashed = {name for name, run in runs.items() if state_of(client, run) == "Crashed"}
        assert crashed == {"dead", "dead too", "number used again"}
        monkeypatch.setenv("DG4D_HOST_ID", "another")
        assert settle_orphans() == 1
        assert state_of(client, runs["elsewhere"]) == "Crashed"
        for name in ("mine", "nobody", "strange"):
            client.delete_flow_run(runs[name].id)


def test_a_run_tells_its_process_in_a_label_and_not_in_its_tags(server: Server) -> None:
    with get_client(sync_client=True) as client:
        run = client.read_flow_run(claimed())
    assert run.labels[LABEL] == process_identity()
    assert run.tags == []
