"""Creation of artifacts on a Prefect server that may be away for a while, because it was killed or restarts."""

import time

import httpx
from prefect.artifacts import create_markdown_artifact
from prefect.logging import get_run_logger
from prefect.settings import PREFECT_API_URL

from flows.serving import background
from flows.serving.server import Server

PATIENCE_S = 120.0  # as long as a server may take to start
POLL_S = 0.5
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


def revive() -> None:
    """Restart the background server at the address that this process has for it, unless it runs."""
    server = background.background_server()
    if server.is_at(str(PREFECT_API_URL.value())) and server.address() is None:
        server.start()
        _revived.append(server)
