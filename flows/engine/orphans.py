"""Orphaned flow runs: the server shows them as running, but their process was killed.

The next command on the same machine marks them as crashed. A run carries the identity of its process in a label.
"""

import os
from uuid import UUID

from prefect import runtime
from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterState, FlowRunFilterStateType
from prefect.client.schemas.objects import FlowRun, StateType
from prefect.states import Crashed

from flows.processes import host_id, start_of

LABEL = "dg4d.process"  # of a flow run: HOST:PID:START
PAGE = 200  # runs in one answer of the server


def claim_run() -> None:
    """Label the current flow run as executed by this process."""
    run_id = runtime.flow_run.id
    if run_id is not None:
        with get_client(sync_client=True) as client:
            client.update_flow_run_labels(UUID(run_id), {LABEL: process_identity()})


def process_identity(pid: int | None = None) -> str:
    """Return HOST:PID:START of a process, by default this one; a later process with the same PID differs in START."""
    pid = pid or os.getpid()
    return f"{host_id()}:{pid}:{start_of(pid)}"


def settle_orphans() -> int:
    """Mark running flow runs of this machine whose process is gone as crashed; return their number."""
    settled = 0
    with get_client(sync_client=True) as client:
        for run in _running(client):
            if _is_orphan(str(run.labels.get(LABEL, ""))):
                client.set_flow_run_state(run.id, Crashed(message="the process was killed"), force=True)
                settled += 1
    return settled


def _running(client: SyncPrefectClient) -> list[FlowRun]:
    """Return every run in the state Running."""
    wanted = FlowRunFilter(state=FlowRunFilterState(type=FlowRunFilterStateType(any_=[StateType.RUNNING])))
    runs: list[FlowRun] = []
    while page := client.read_flow_runs(flow_run_filter=wanted, limit=PAGE, offset=len(runs)):
        runs += page
    return runs


def _is_orphan(identity: str) -> bool:
    """Return true if a process belongs to this machine and has ended."""
    machine, _, process = identity.rpartition(":")[0].rpartition(":")
    return machine == host_id() and process.isdigit() and process_identity(int(process)) != identity
