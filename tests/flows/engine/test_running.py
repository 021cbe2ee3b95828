"""Events of steps that did not finish."""

import pytest

from flows.engine import resources
from flows.engine.events import StepEvent, listening
from flows.engine.running import fail_step, may_succeed
from flows.step_errors import (
    StepBadInput,
    StepCrashed,
    StepDiverged,
    StepError,
    StepLost,
    StepOutOfMemory,
    StepTimedOut,
    StepUnreachable,
)


@pytest.mark.parametrize(("stopped", "told"), [(True, ("note", "interrupted after 2.9 s")), (False, ("failed", ""))])
def test_a_step_that_the_user_stopped_is_not_called_failed(stopped: bool, told: tuple[str, str]) -> None:
    if stopped:
        resources.stopping.set()
    events: list[StepEvent] = []
    with listening(events.append):
        fail_step("newt", "fit_motion", 2.9)
    assert [(event.kind, event.text) for event in events] == [told]


def test_a_step_that_was_interrupted_is_not_called_failed() -> None:
    events: list[StepEvent] = []
    with listening(events.append):
        fail_step("newt", "fit_motion", 2.9, interrupted=True)
    assert [(event.kind, event.text) for event in events] == [("note", "interrupted after 2.9 s")]


@pytest.mark.parametrize(
    ("kind", "first", "second"),
    [
        (StepOutOfMemory, True, True),
        (StepUnreachable, True, True),
        (StepCrashed, True, False),
        (StepBadInput, False, False),
        (StepLost, False, False),
        (StepDiverged, False, False),
        (StepTimedOut, False, False),
    ],
)
def test_only_memory_and_the_store_are_waited_for_more_than_once(
    kind: type[StepError], first: bool, second: bool
) -> None:
    error = kind("fit_motion", "failed")
    assert (may_succeed(error, 1), may_succeed(error, 2)) == (first, second)
    resources.stopping.set()
    assert not may_succeed(error, 1)


def test_a_file_that_cannot_be_written_gets_one_retry_and_other_errors_none() -> None:
    assert [may_succeed(OSError("busy"), attempt) for attempt in (1, 2)] == [True, False]
    assert not may_succeed(ValueError("ours"), 1) and not may_succeed(None, 1)
