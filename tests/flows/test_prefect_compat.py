"""The inside of Prefect that we depend on: its names, its order of events, its transactions."""

import asyncio
import pkgutil
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from uuid import UUID, uuid4

import pytest
from prefect.server.database.configurations import AioSqliteConfiguration
from prefect.server.events.ordering import EventArrivedEarly
from prefect.server.events.schemas.events import ReceivedEvent, Resource
from sqlalchemy import text
from sqlalchemy.exc import OperationalError

from flows import prefect_compat

EARLIER, LATER = uuid4(), uuid4()  # states that a run had before, and since, the server was started
STATES = {EARLIER: prefect_compat.BEGAN - timedelta(seconds=1), LATER: prefect_compat.BEGAN + timedelta(seconds=1)}


@pytest.mark.parametrize("part", prefect_compat.PARTS)
def test_this_prefect_has_the_part_that_we_depend_on(part: str) -> None:
    try:
        pkgutil.resolve_name(part)
    except (ImportError, AttributeError) as error:
        pytest.fail(f"Prefect has no {part} any more ({error}); see what {prefect_compat.__name__} does with it")


def test_no_other_module_imports_the_inside_of_prefect() -> None:
    flows = Path(prefect_compat.__file__).parent
    inside = re.compile(r"^\s*(from|import) prefect\.(server|_|\S*\._)", re.MULTILINE)
    assert [path.name for path in flows.rglob("*.py") if inside.search(path.read_text())] == ["prefect_compat.py"]


@pytest.fixture
def database(monkeypatch: pytest.MonkeyPatch) -> None:
    """It knows the two states."""

    async def get(_: object, number: UUID) -> SimpleNamespace | None:
        return SimpleNamespace(timestamp=STATES[number]) if number in STATES else None

    @asynccontextmanager
    async def session() -> AsyncIterator[SimpleNamespace]:
        yield SimpleNamespace(get=get)

    found = SimpleNamespace(session_context=session, FlowRunState=None)
    monkeypatch.setattr(prefect_compat, "provide_database_interface", lambda: found)


def waits(follows: UUID | None, seen: bool = False) -> bool:
    event = ReceivedEvent(
        occurred=datetime.now(UTC),
        event="prefect.flow-run.Crashed",
        resource=Resource({"prefect.resource.id": "prefect.flow-run.1"}),
        id=uuid4(),
        follows=follows,
    )

    async def look() -> None:
        order = prefect_compat.CausalOrdering(str(event.id))
        if seen and follows is not None:
            await order.record_event_as_seen(event.model_copy(update={"id": follows}))
        await order.wait_for_leader(event)

    try:
        asyncio.run(look())
    except EventArrivedEarly:
        return True
    return False


@pytest.mark.usefixtures("database")
def test_what_happened_before_the_server_was_started_is_not_waited_for() -> None:
    assert not waits(EARLIER)


@pytest.mark.usefixtures("database")
def test_what_happens_now_is_waited_for_until_it_was_seen() -> None:
    assert waits(LATER)
    assert not waits(LATER, seen=True)
    assert waits(uuid4())  # an event that nobody knows yet
    assert not waits(None)


def test_transactions_that_read_before_they_write_take_turns(tmp_path: Path) -> None:
    assert asyncio.run(_both_add_one(prefect_compat.OneWriter, tmp_path)) == 2


def test_what_prefect_does_otherwise(tmp_path: Path) -> None:
    with pytest.raises(OperationalError, match="locked"):
        asyncio.run(_both_add_one(AioSqliteConfiguration, tmp_path))


async def _both_add_one(kind: type[AioSqliteConfiguration], folder: Path) -> int:
    """Two at once read a number, wait for each other a while, and add one to it."""
    database = kind(connection_url=f"sqlite+aiosqlite:///{folder / 'numbers.db'}")
    engine = await database.engine()
    read = asyncio.Barrier(2)

    async def add_one() -> None:
        async with await database.session(engine) as session, database.begin_transaction(session):
            await session.execute(text("SELECT value FROM number"))
            with_company = asyncio.wait_for(read.wait(), 0.5)
            await asyncio.gather(with_company, return_exceptions=True)  # whoever has the lock waits alone
            await session.execute(text("UPDATE number SET value = value + 1"))

    async with await database.session(engine) as session, session.begin():
        await session.execute(text("CREATE TABLE number AS SELECT 0 AS value"))
    try:
        await asyncio.gather(add_one(), add_one())
        async with await database.session(engine) as session:
            return int((await session.execute(text("SELECT value FROM number"))).scalar_one())
    finally:
        await engine.dispose()
