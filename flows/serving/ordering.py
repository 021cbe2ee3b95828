"""The order in which a server looks at events: Prefect's own, which forgets at its start what it has seen before.

An event that follows one which was not seen waits a quarter of an hour for it. The run of a machine that was killed
soon after the run had begun would go on that much later.
"""

from datetime import UTC, datetime
from uuid import UUID

from prefect.server.database import provide_database_interface
from prefect.server.events.ordering import memory
from prefect.server.events.schemas.events import ReceivedEvent

BEGAN = datetime.now(UTC)


class CausalOrdering(memory.CausalOrdering):
    """As Prefect's, but what a run did before this server was started needs not be waited for."""

    async def wait_for_leader(self, event: ReceivedEvent) -> None:
        """Return when an event may be looked at.

        Raises:
            EventArrivedEarly: what it follows has not been seen; it is looked at when that has arrived.
        """
        leader = event.follows
        if leader is None or await self.event_has_been_seen(leader) or not await _is_from_before(leader):
            await super().wait_for_leader(event)


async def _is_from_before(event: UUID) -> bool:
    """Whether an event says that a run had a new state, before this server was started; both have the same number."""
    database = provide_database_interface()
    async with database.session_context() as session:
        state = await session.get(database.FlowRunState, event)
    return state is not None and state.timestamp < BEGAN
