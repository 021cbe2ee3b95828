"""Calls inside a flow run, for functions that need one."""

from collections.abc import Callable
from typing import Any

from prefect import flow
from prefect.settings import temporary_settings

from flows.engine.step_tasks import flow_settings


def inside_a_flow(call: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    """Call a function inside a flow run."""

    @flow(name="test", persist_result=False)
    def test() -> Any:
        return call(*arguments, **named)

    with temporary_settings(flow_settings()):
        return test()
