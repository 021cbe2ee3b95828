"""Cancellation of flow runs of deployments."""

from typing import Any

from prefect import Flow
from prefect.client.orchestration import get_client
from prefect.client.schemas.objects import FlowRun, State
from prefect.states import Cancelled


def stay_cancelled(flow: Flow[..., Any], flow_run: FlowRun, state: State[Any]) -> None:
    """Mark a crashed run as cancelled if it was asked to end; a hook for `on_crashed`.

    Prefect cancels a run by a signal. The engine reports a crash if the worker did not reach it before the signal, as
    on a loaded machine; the worker reports the cancellation once the process is gone, which may be after the automation
    of flows/serving/registering.py has started the crashed run again.

    Args:
        flow: unused, as Prefect passes it.
        flow_run: crashed run.
        state: unused, as Prefect passes it.
    """
    with get_client(sync_client=True) as client:
        earlier = [known for known in client.read_flow_run_states(flow_run.id) if not known.is_crashed()]
        if earlier and earlier[-1].is_cancelling():
            client.set_flow_run_state(flow_run.id, Cancelled(message=earlier[-1].message), force=True)
