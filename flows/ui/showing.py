"""Artifacts for a Prefect server that may be away for a while, because it was killed or is started anew."""

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from contextvars import ContextVar, copy_context
from typing import Any

import httpx
from prefect.logging import get_run_logger
from prefect.settings import PREFECT_API_URL

from flows.serving import background
from flows.serving.server import HOST, Server

PATIENCE_S = 120.0  # as long as a server may take to start
POLL_S = 0.5
_revived: list[Server] = []  # they end when nobody uses them, and this process does


def show(create: Callable[..., Any], **what: Any) -> None:
    """Call what makes an artifact; if the server is away, start it if it is ours, and wait for it.

    A page is not worth a failed step: without an answer for `PATIENCE_S` seconds it is left out.
    """
    deadline = time.monotonic() + PATIENCE_S
    while True:
        revive()  # first, for clients of Prefect wait long, and longer each time, before they say that it is away
        try:
            create(**what)
        except httpx.TransportError as error:
            if time.monotonic() > deadline:
                get_run_logger().warning("the Prefect server does not answer; a page is left out: %s", error)
                return
            time.sleep(POLL_S)
        else:
            return


class Beside:
    """Makes pages while the flow goes on, one after the other, in a thread of its own."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="pages")

    @contextmanager
    def offered(self) -> Iterator[None]:
        """Let what runs in the block, in this thread, leave its pages to `later`."""
        token = _beside.set(self)
        try:
            yield
        finally:
            _beside.reset(token)

    def take(self, make: Callable[[], None]) -> None:
        """Call this when its turn comes, in the context of this moment."""
        self._thread.submit(copy_context().run, make)

    def finish(self, stopped: bool = False) -> None:
        """Wait for all of them, or only for the one in hand if the user stopped the flow."""
        self._thread.shutdown(cancel_futures=stopped)


_beside: ContextVar[Beside | None] = ContextVar("beside", default=None)


def later(make: Callable[[], None]) -> None:
    """Make pages beside what the flow does next; at once where no flow waits for them, as on another machine.

    A page is not worth a failed step: what goes wrong with it is in the log of the run.
    """

    def attempt() -> None:
        try:
            make()
        except Exception:
            get_run_logger().warning("a page is left out", exc_info=True)

    beside = _beside.get()
    if beside is None:
        attempt()
    else:
        beside.take(attempt)


def revive() -> None:
    """Start the background server again, at the address where this process knows it, unless it runs."""
    server = background.background_server()
    with suppress(OSError):
        port = (server.folder / "port").read_text(encoding="ascii").strip()
        if PREFECT_API_URL.value() == f"http://{HOST}:{port}/api" and server.address() is None:
            server.start()
            _revived.append(server)
