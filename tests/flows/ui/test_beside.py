"""Pages that are made while the flow goes on."""

import logging
import threading
from contextvars import ContextVar

import pytest

from flows.ui import showing
from flows.ui.showing import Beside, later

step: ContextVar[str] = ContextVar("step")


def test_a_page_is_made_at_once_where_no_flow_waits_for_it() -> None:
    made = []
    later(lambda: made.append(threading.current_thread()))
    assert made == [threading.current_thread()]


def test_pages_are_made_in_their_order_by_another_thread_and_know_whose_they_are() -> None:
    pages, go_on = Beside(), threading.Event()
    made: list[tuple[str, bool]] = []

    def make() -> None:
        assert go_on.wait(10)
        made.append((step.get(), threading.current_thread() is threading.main_thread()))

    with pages.offered():
        for name in ("fit_gaussians", "fit_motion"):
            step.set(name)
            later(make)
    assert made == []  # the flow has not waited
    go_on.set()
    pages.finish()
    assert made == [("fit_gaussians", False), ("fit_motion", False)]


def test_what_goes_wrong_with_a_page_is_in_the_log_and_stops_nothing(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(showing, "get_run_logger", lambda: logging.getLogger("run"))
    pages = Beside()
    made: list[str] = []

    def broken() -> None:
        raise KeyError("nothing")

    with pages.offered():
        later(broken)
        later(lambda: made.append("the next"))
    pages.finish()
    later(broken)
    assert made == ["the next"]
    assert caplog.text.count("a page is left out") == caplog.text.count("KeyError: 'nothing'") == 2


def test_a_flow_that_the_user_stopped_waits_only_for_the_page_in_hand() -> None:
    pages, begun, go_on = Beside(), threading.Event(), threading.Event()
    made: list[str] = []

    def slow() -> None:
        begun.set()
        assert go_on.wait(10)
        made.append("in hand")

    with pages.offered():
        later(slow)
        later(lambda: made.append("the next"))
    assert begun.wait(10)
    threading.Timer(0.05, go_on.set).start()
    pages.finish(stopped=True)
    assert made == ["in hand"]
