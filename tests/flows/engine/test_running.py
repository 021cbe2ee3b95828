"""Events of steps that did not finish."""

import pytest

from flows.engine import resources
from flows.engine.events import StepEvent, listening
from flows.engine.running import fail_step


@pytest.mark.parametrize(("stopped", "told"), [(True, ("note", "interrupted after 2.9 s")), (False, ("failed", ""))])
def test_a_step_that_the_user_stopped_is_not_called_failed(stopped: bool, told: tuple[str, str]) -> None:
    if stopped:
        resources.stopping.set()
    events: list[StepEvent] = []
    with listening(events.append):
        fail_step("newt", "fit_motion", 2.9)
    assert [(event.kind, event.text) for event in events] == [told]
