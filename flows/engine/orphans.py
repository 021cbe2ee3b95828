"""Runs whose process was killed: nobody told the server, so the next command does."""

import os

from prefect.client.orchestration import get_client
from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterState, FlowRunFilterStateType
from prefect.client.schemas.objects import StateType
from prefect.states import Crashed

from flows.processes import place, start_of


def process_tag() -> str:
    """A tag that names this process, and no other that has its number later."""
    return _tag(os.getpid())


def settle_orphans() -> int:
    """Mark running flow runs of this machine whose process is gone as crashed; how many there were."""
    mine = process_tag().rpartition(":")[0].rpartition(":")[0] + ":"
    running = FlowRunFilter(state=FlowRunFilterState(type=FlowRunFilterStateType(any_=[StateType.RUNNING])))
    settled = 0
    with get_client(sync_client=True) as client:
        for run in client.read_flow_runs(flow_run_filter=running):
            owner = next((tag for tag in run.tags if tag.startswith(mine)), None)
            if owner is not None and _tag(int(owner.split(":")[-2])) != owner:
                client.set_flow_run_state(run.id, Crashed(message="the process was killed"), force=True)
                settled += 1
    return settled


def _tag(pid: int) -> str:
    return f"process:{place()}:{pid}:{start_of(pid)}"
