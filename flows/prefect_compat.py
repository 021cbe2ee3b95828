"""Adapters to internals of Prefect's server, whose version is pinned in `pyproject.toml`; imported by the server only.

`PARTS` lists the internals. The server loads this module as `PREFECT_SERVER_EVENTS_CAUSAL_ORDERING` too.
"""

from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from datetime import UTC, datetime
from typing import Any
from uuid import UUID

from fastapi import FastAPI, Request, Response
from fastapi.responses import PlainTextResponse
from prefect.plugins import load_prefect_collections
from prefect.server.api import server
from prefect.server.database import configurations, dependencies, provide_database_interface
from prefect.server.events.ordering import memory
from prefect.server.events.schemas.events import ReceivedEvent
from prefect.server.models.block_registration import run_block_auto_registration
from prefect.settings import PREFECT_API_DATABASE_CONNECTION_URL
from sqlalchemy.ext.asyncio import AsyncSession, AsyncSessionTransaction

PARTS = (  # module:attribute
    "prefect.plugins:load_prefect_collections",
    "prefect.server.api.server:create_app",
    "prefect.server.api.server:custom_internal_exception_handler",
    "prefect.server.database:provide_database_interface",
    "prefect.server.database.configurations:AioSqliteConfiguration.begin_transaction",
    "prefect.server.database.dependencies:MODELS_DEPENDENCIES",
    "prefect.server.database.interface:PrefectDBInterface.FlowRunState",
    "prefect.server.database.interface:PrefectDBInterface.session_context",
    "prefect.server.database.interface:PrefectDBInterface.create_db",
    "prefect.server.events.ordering.memory:CausalOrdering.event_has_been_seen",
    "prefect.server.events.ordering.memory:CausalOrdering.wait_for_leader",
    "prefect.server.events.schemas.events:ReceivedEvent",
    "prefect.server.concurrency.lease_storage.filesystem:ConcurrencyLeaseStorage",
    "prefect.server.models.block_registration:run_block_auto_registration",
)
BEGAN = datetime.now(UTC)


class OneWriter(configurations.AioSqliteConfiguration):
    """SQLite configuration whose transactions take the write lock when they begin.

    Otherwise a transaction that reads and then writes fails if another one has written in between; the server answers
    503 and the client retries after two seconds or more, which took half the time of a batch.
    """

    @asynccontextmanager
    async def begin_transaction(
        self, session: AsyncSession, with_for_update: bool = False
    ) -> AsyncGenerator[AsyncSessionTransaction, None]:
        """Begin a transaction with the lock for writing."""
        async with super().begin_transaction(session, with_for_update=True) as transaction:
            yield transaction


class CausalOrdering(memory.CausalOrdering):
    """Causal ordering of events that does not wait for events from before the start of this server.

    Prefect's own forgets seen events at a restart, and an event that follows an unseen one waits 15 minutes, which
    would delay the restart of a crashed run.
    """

    async def wait_for_leader(self, event: ReceivedEvent) -> None:
        """Return when an event may be processed.

        Raises:
            EventArrivedEarly: the event that it follows was not processed yet.
        """
        leader = event.follows
        if leader is None or await self.event_has_been_seen(leader) or not await _is_from_before(leader):
            await super().wait_for_leader(event)


async def _is_from_before(event: UUID) -> bool:
    """Return true if an event belongs to a run state, which has its id, from before the start of this server."""
    database = provide_database_interface()
    async with database.session_context() as session:
        state = await session.get(database.FlowRunState, event)
    return state is not None and state.timestamp < BEGAN


async def fill_database() -> None:
    """Create the database of PREFECT_HOME with the block types that a server registers when it starts."""
    database = provide_database_interface()
    await database.create_db()
    load_prefect_collections()
    async with database.session_context() as session:
        await run_block_auto_registration(session)


def create_app() -> FastAPI:
    """Build Prefect's application; it answers 503 (retryable) while its database is unavailable."""
    database = PREFECT_API_DATABASE_CONNECTION_URL.value()
    if database.startswith("sqlite"):
        dependencies.MODELS_DEPENDENCIES["database_config"] = OneWriter(connection_url=database)
    application = server.create_app(final=True)
    for route in application.router.routes:
        if isinstance(part := getattr(route, "app", None), FastAPI):
            part.add_exception_handler(ConnectionError, database_away)
    application.add_exception_handler(Exception, _unavailable)  # Prefect's CSRF check reads the database before its API
    return application


def add_first(application: FastAPI, path: str, answer: Callable[..., object], **options: Any) -> None:
    """Add a route before that of the user interface, which matches every path."""
    routes = application.router.routes
    application.add_api_route(path, answer, response_class=Response, include_in_schema=False, **options)
    routes.insert(0, routes.pop())


def database_away(request: Request, error: Exception) -> Response:
    """Return 503 (retryable) while the database starts."""
    return PlainTextResponse("the database does not answer", 503)


async def _unavailable(request: Request, error: Exception) -> Response:
    """Answer an error outside of the API with 503 if the request may be retried, else with 500."""
    if isinstance(error, ConnectionError):
        return database_away(request, error)
    return await server.custom_internal_exception_handler(request, error)
