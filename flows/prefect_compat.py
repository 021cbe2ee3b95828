"""Everything that depends on the inside of Prefect's server, pinned in `pyproject.toml`; only the server imports it.

`PARTS` names what Prefect may change without notice. As `PREFECT_SERVER_EVENTS_CAUSAL_ORDERING` this module gives the
server its order of events.
"""

from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from datetime import UTC, datetime
from uuid import UUID

from fastapi import FastAPI, Request, Response
from fastapi.responses import PlainTextResponse
from prefect.server.api import server
from prefect.server.database import configurations, dependencies, provide_database_interface
from prefect.server.events.ordering import memory
from prefect.server.events.schemas.events import ReceivedEvent
from prefect.settings import PREFECT_API_DATABASE_CONNECTION_URL
from sqlalchemy.ext.asyncio import AsyncSession, AsyncSessionTransaction

PARTS = (  # module:attribute
    "prefect.server.api.server:create_app",
    "prefect.server.api.server:custom_internal_exception_handler",
    "prefect.server.database:provide_database_interface",
    "prefect.server.database.configurations:AioSqliteConfiguration.begin_transaction",
    "prefect.server.database.dependencies:MODELS_DEPENDENCIES",
    "prefect.server.database.interface:PrefectDBInterface.FlowRunState",
    "prefect.server.database.interface:PrefectDBInterface.session_context",
    "prefect.server.events.ordering.memory:CausalOrdering.event_has_been_seen",
    "prefect.server.events.ordering.memory:CausalOrdering.wait_for_leader",
    "prefect.server.events.schemas.events:ReceivedEvent",
    "prefect.server.concurrency.lease_storage.filesystem:ConcurrencyLeaseStorage",
)
BEGAN = datetime.now(UTC)


class OneWriter(configurations.AioSqliteConfiguration):
    """SQLite whose transactions take the lock for writing when they begin.

    A transaction that writes after it has read is refused if another has written in between; the server then answers
    503, and the client waits two seconds and more before it asks again: half the time of a batch.
    """

    @asynccontextmanager
    async def begin_transaction(
        self, session: AsyncSession, with_for_update: bool = False
    ) -> AsyncGenerator[AsyncSessionTransaction, None]:
        """Begin a transaction with the lock for writing."""
        async with super().begin_transaction(session, with_for_update=True) as transaction:
            yield transaction


class CausalOrdering(memory.CausalOrdering):
    """Order of events that does not wait for what a run did before this server was started.

    Prefect's forgets at its start what it has seen, and an event that follows an unseen one waits a quarter of an hour:
    the run of a machine that was killed would go on that much later.
    """

    async def wait_for_leader(self, event: ReceivedEvent) -> None:
        """Return when an event may be processed.

        Raises:
            EventArrivedEarly: the event that it follows has not been seen.
        """
        leader = event.follows
        if leader is None or await self.event_has_been_seen(leader) or not await _is_from_before(leader):
            await super().wait_for_leader(event)


async def _is_from_before(event: UUID) -> bool:
    """Return whether an event tells of a state of a run, which has its number, from before this server was started."""
    database = provide_database_interface()
    async with database.session_context() as session:
        state = await session.get(database.FlowRunState, event)
    return state is not None and state.timestamp < BEGAN


def create_app() -> FastAPI:
    """Build Prefect's application; it answers 503 (retryable) while its database is away."""
    database = PREFECT_API_DATABASE_CONNECTION_URL.value()
    if database.startswith("sqlite"):
        dependencies.MODELS_DEPENDENCIES["database_config"] = OneWriter(connection_url=database)
    application = server.create_app(final=True)
    for route in application.router.routes:
        if isinstance(part := getattr(route, "app", None), FastAPI):
            part.add_exception_handler(ConnectionError, database_away)
    application.add_exception_handler(Exception, _unavailable)  # Prefect's CSRF check reads the database before its API
    return application


def add_first(application: FastAPI, path: str, answer: Callable[..., object], **options: object) -> None:
    """Add a route before the user interface, which answers to every address."""
    routes = application.router.routes
    application.add_api_route(path, answer, response_class=Response, include_in_schema=False, **options)  # type: ignore[arg-type]
    routes.insert(0, routes.pop())


def database_away(request: Request, error: Exception) -> Response:
    """Return 503 (retryable) while the database starts."""
    return PlainTextResponse("the database does not answer", 503)


async def _unavailable(request: Request, error: Exception) -> Response:
    """Answer an error outside of the API: 503 if the request may be repeated, else 500."""
    if isinstance(error, ConnectionError):
        return database_away(request, error)
    return await server.custom_internal_exception_handler(request, error)
