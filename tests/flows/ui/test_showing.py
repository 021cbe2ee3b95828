from collections.abc import Callable

import httpx
import pytest
from prefect.concurrency.asyncio import ConcurrencySlotAcquisitionError

from flows.engine import step_tasks
from flows.serving.server import ServerUnavailable
from flows.ui import showing


class Client:
    """Client of a server that answers every second time it is asked."""

    asked = 0

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *_: object) -> None: ...

    def api_healthcheck(self) -> Exception | None:
        Client.asked += 1
        return None if Client.asked % 2 == 0 else httpx.ConnectError("refused")


@pytest.fixture
def revived(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Notes of every attempt to start the server again."""
    notes: list[str] = []
    monkeypatch.setattr(showing, "revive", lambda: notes.append("revived"))
    monkeypatch.setattr(showing, "get_client", lambda **_: Client())
    monkeypatch.setattr(showing, "POLL_S", 0.0)
    monkeypatch.setattr(Client, "asked", 0)
    return notes


def failing(times: int, raise_error: Callable[[], None], notes: list[str]) -> Callable[[], str]:
    def flow() -> str:
        notes.append("flow")
        if notes.count("flow") <= times:
            raise_error()
        return "done"

    return flow


def unreachable() -> None:
    raise httpx.ConnectError("refused")


def without_slot() -> None:
    raise ConcurrencySlotAcquisitionError("no slot") from httpx.ConnectError("refused")


@pytest.mark.parametrize("error", [unreachable, without_slot])
def test_a_flow_whose_server_was_away_begins_again_when_it_answers(
    error: Callable[[], None], revived: list[str]
) -> None:
    assert showing.run_again(failing(1, error, revived)) == "done"
    assert revived == ["flow", "revived", "revived", "flow"]


def test_a_flow_begins_again_a_few_times_only(revived: list[str]) -> None:
    with pytest.raises(httpx.ConnectError):
        showing.run_again(failing(100, unreachable, revived))
    assert revived.count("flow") == showing.MOST_STARTS


def test_another_error_of_a_flow_is_passed_on(revived: list[str]) -> None:
    def no_such_limit() -> None:
        raise ConcurrencySlotAcquisitionError("no slot") from ValueError("no such limit")

    with pytest.raises(ConcurrencySlotAcquisitionError):
        showing.run_again(failing(1, no_such_limit, revived))
    assert revived == ["flow"]


def test_a_server_that_stays_away_is_an_error_that_says_what_to_do(
    revived: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(showing, "PATIENCE_S", -1.0)
    with pytest.raises(ServerUnavailable, match=r"any more \(refused\).* run the same command again"):
        showing.run_again(failing(1, unreachable, revived))


def test_the_server_is_started_again_before_a_flow_reports_its_end(
    revived: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(step_tasks, "revive", showing.revive)
    monkeypatch.setattr(step_tasks, "claim_run", unreachable)
    monkeypatch.setenv("PREFECT__RUNTIME__FLOW_RUN__ID", "00000000-0000-0000-0000-000000000000")
    with pytest.raises(httpx.ConnectError), step_tasks.steps_of_flow():
        pytest.fail("the run was not claimed")
    assert revived == ["revived"]
