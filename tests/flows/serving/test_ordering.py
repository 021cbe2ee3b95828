"""Events that follow others wait for these, unless a server that is gone has looked at them."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace
from uuid import UUID, uuid4

import pytest
from prefect.server.events.ordering import EventArrivedEarly
from prefect.server.events.schemas.events import ReceivedEvent, Resource

from flows.serving import ordering

EARLIER, LATER = uuid4(), uuid4()  # states that a run had before, and since, the server was started
STATES = {EARLIER: ordering.BEGAN - timedelta(seconds=1), LATER: ordering.BEGAN + timedelta(seconds=1)}


@pytest.fixture(autouse=True)
def database(monkeypatch: pytest.MonkeyPatch) -> None:
    """It knows the two states."""

    async def get(_: object, number: UUID) -> SimpleNamespace | None:
        return SimpleNamespace(timestamp=STATES[number]) if number in STATES else None

    @asynccontextmanager
    async def session() -> AsyncIterator[SimpleNamespace]:
        yield SimpleNamespace(get=get)

    found = SimpleNamespace(session_context=session, FlowRunState=None)
    monkeypatch.setattr(ordering, "provide_database_interface", lambda: found)


def waits(follows: UUID | None, seen: bool = False) -> bool:
    event = ReceivedEvent(
        occurred=datetime.now(UTC),
        event="prefect.flow-run.Crashed",
        resource=Resource({"prefect.resource.id": "prefect.flow-run.1"}),
        id=uuid4(),
        follows=follows,
    )

    async def look() -> None:
        order = ordering.CausalOrdering(str(event.id))
        if seen and follows is not None:
            await order.record_event_as_seen(event.model_copy(update={"id": follows}))
        await order.wait_for_leader(event)

    try:
        asyncio.run(look())
    except EventArrivedEarly:
        return True
    return False


def test_what_happened_before_the_server_was_started_is_not_waited_for() -> None:
    assert not waits(EARLIER)


def test_what_happens_now_is_waited_for_until_it_was_seen() -> None:
    assert waits(LATER)
    assert not waits(LATER, seen=True)
    assert waits(uuid4())  # an event that nobody knows yet
    assert not waits(None)
