"""Artifacts and flows on a Prefect server that may be unavailable for a while, because it was killed or restarts."""

import time
from collections.abc import Callable
from typing import TypeVar

import httpx
from prefect.artifacts import create_markdown_artifact
from prefect.client.orchestration import get_client
from prefect.concurrency.asyncio import ConcurrencySlotAcquisitionError
from prefect.logging import get_run_logger
from prefect.settings import PREFECT_API_URL

from flows.serving import background
from flows.serving.server import Server, ServerUnavailable

PATIENCE_S = 120.0  # as long as a server may take to start
POLL_S = 0.5
MOST_STARTS = 3  # starts of a flow while its server restarts

Result = TypeVar("Result")

_revived: list[Server] = []  # kept alive: a server ends when no process uses it


def create_page(key: str, page: str, description: str) -> None:
    """Create a Markdown artifact; wait for a server that is away, and start it again if it is the background server.

    A page is not worth a failed step: it is left out if the server does not answer for `PATIENCE_S` seconds.
    """
    deadline = time.monotonic() + PATIENCE_S
    while True:
        revive()  # Prefect's client retries with growing pauses before it raises, so the server is checked first
        try:
            create_markdown_artifact(page, key=key, description=description)
        except httpx.TransportError as error:
            if time.monotonic() > deadline:
                get_run_logger().warning("the Prefect server does not answer; a page is left out: %s", error)
                return
            time.sleep(POLL_S)
        else:
            return


def run_again(flow: Callable[[], Result]) -> Result:
    """Return the result of a flow; if the server restarts meanwhile, start the flow again when it answers.

    Raises:
        ServerUnavailable: it did not answer for `PATIENCE_S` seconds.
    """
    for _ in range(MOST_STARTS - 1):
        try:
            return flow()
        except (httpx.TransportError, ConcurrencySlotAcquisitionError) as error:
            if not isinstance(error, httpx.TransportError) and not isinstance(error.__cause__, httpx.TransportError):
                raise
            _wait_for_server()
    return flow()


def revive() -> None:
    """Restart the background server at the address that this process has for it, unless it runs."""
    server = background.background_server()
    if server.is_at(str(PREFECT_API_URL.value())) and server.address() is None:
        server.start()
        _revived.append(server)


def _wait_for_server() -> None:
    deadline = time.monotonic() + PATIENCE_S
    while True:
        revive()
        with get_client(sync_client=True) as client:
            error = client.api_healthcheck()
        if error is None:
            return
        if time.monotonic() > deadline:
            raise ServerUnavailable(
                f"the Prefect server does not answer any more ({error}); when it does, run the same command again to "
                "continue after the last finished step"
            ) from error
        time.sleep(POLL_S)
