"""One Prefect server for all tests of a process: starting one takes seconds, and clients remember where it was."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from conversions import Run
from prefect.logging.handlers import APILogHandler
from prefect.settings import PREFECT_API_AUTH_STRING, PREFECT_API_URL, temporary_settings
from typer.testing import CliRunner
from waiting import retry_after

from flows import cli
from flows.engine import resources
from flows.serving import background
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
        running = background.background_server()
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


@pytest.fixture(scope="module")
def place(server: Server) -> Iterator[None]:
    """Fake steps in the home folder of the server, for this process and its children."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DG4D_HOME", str(server.folder.parent))
        patch.setenv("DG4D_CATALOG", "fake_steps:STEPS")
        patch.setenv("DG4D_CODE_VERSION", "test")
        patch.setenv("PYTHONPATH", str(Path(__file__).parent))
        yield


@pytest.fixture
def log(place: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Log of fake steps, which run in this process; retries have no delay."""
    monkeypatch.setenv("FAKE_LOG", str(tmp_path / "ran"))
    monkeypatch.setenv("DG4D_EXECUTOR", "in_process")
    retry_after(0.01, monkeypatch)
    return tmp_path / "ran"


@pytest.fixture
def dg4d(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Command `dg4d`, run in this process, which is connected to the server."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("flows.convert.connect", lambda: None)
    return lambda *arguments: CliRunner().invoke(cli.app, arguments)
