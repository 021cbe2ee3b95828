"""A Prefect server on PostgreSQL for a test; the database may crash and come back."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from prefect.logging.handlers import APILogHandler
from prefect.settings import PREFECT_API_AUTH_STRING, temporary_settings

from benchmarks.postgresql import Database, free_port
from dg4d_lib.errors import BackendUnavailable
from flows.serving.server import SETTINGS, answers

SECRET = "test:a-secret-word"
START_S = 400.0  # on a machine that is busy with other things


@contextmanager
def server_on_postgresql(prefect_home: Path) -> Iterator[tuple[str, Database]]:
    """The product's Prefect server on a database of its own; where its API is.

    The database lies outside of the folders of pytest, which are closed to other users. Skips where there is none.
    """
    with tempfile.TemporaryDirectory(prefix="dg4d-postgresql-") as folder:
        try:
            database = Database(Path(folder))
        except BackendUnavailable as missing:
            pytest.skip(str(missing))
        database.start()
        port = free_port()
        server = subprocess.Popen(
            [sys.executable, "-m", "uvicorn", "--factory", "flows.serving.server_app:create_app", "--port", str(port),
             "--log-level", "critical"],
            env={
                **os.environ,
                **SETTINGS,
                "PREFECT_SERVER_API_AUTH_STRING": SECRET,
                "PREFECT_HOME": str(prefect_home),
                "PREFECT_API_DATABASE_CONNECTION_URL": database.address,
            },
        )  # fmt: skip
        try:
            deadline = time.monotonic() + START_S
            while not answers(f"http://127.0.0.1:{port}", timeout_s=5.0):
                assert server.poll() is None and time.monotonic() < deadline, "the server did not start"
                time.sleep(0.3)
            with pytest.MonkeyPatch.context() as patch, temporary_settings({PREFECT_API_AUTH_STRING: SECRET}):
                patch.setenv("PREFECT_API_AUTH_STRING", SECRET)
                yield f"http://127.0.0.1:{port}/api", database
                APILogHandler().flush()  # or the end of this process waits for a server that is gone
        finally:
            server.terminate()
            server.wait(60)
            database.crash()
