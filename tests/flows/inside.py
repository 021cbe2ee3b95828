"""Calls inside a flow run, for functions that need one."""

from collections.abc import Callable
from typing import Any

from prefect import flow

from flows.engine.step_tasks import flow_context


def inside_a_flow(call: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    """Call a function inside a flow run."""

    @flow(name="test", persist_result=False)
    def test() -> Any:
        return call(*arguments, **named)

    with flow_context():
        return test()
