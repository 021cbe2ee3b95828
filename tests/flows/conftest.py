"""One Prefect server for all tests of a process: starting one takes seconds, and clients remember where it was."""

from collections.abc import Iterator

import pytest
from prefect.logging.handlers import APILogHandler
from prefect.settings import PREFECT_API_AUTH_STRING, PREFECT_API_URL, temporary_settings

from flows import home
from flows.engine import resources
from flows.serving.server import Server


@pytest.fixture(autouse=True)
def going_on() -> Iterator[None]:
    """Let steps of later tests begin where a test stopped a run in this process."""
    yield
    resources.stopping.clear()


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """The product's own server, under a home folder of its own, which is `server.folder.parent`."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DG4D_HOME", str(tmp_path_factory.mktemp("home")))
        running = home.background_server()
        running.start()
    with (
        temporary_settings({PREFECT_API_URL: running.wait(), PREFECT_API_AUTH_STRING: running.auth_string()}),
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setenv("PREFECT_API_AUTH_STRING", running.auth_string())  # for commands and workers
        yield running
        APILogHandler().flush()  # what is not sent yet would be tried again for a minute
    running.release()
    running.stop()
