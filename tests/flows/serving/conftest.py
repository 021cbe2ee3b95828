"""A server with deployments, and a worker of its own that runs fake steps."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.settings import PREFECT_API_URL
from tiny_s3 import TinyS3
from waiting import wait_until

from flows.serving import registering
from flows.serving.pools import read_pools
from flows.serving.roots import SOURCES
from flows.serving.server import Server
from flows.serving.workers import Worker, running


@pytest.fixture(scope="module")
def client(server: Server) -> Iterator[SyncPrefectClient]:
    """Of a server that has the pool process-cpu and its deployments."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DG4D_HOME", str(server.folder.parent))
        patch.setenv("DG4D_CATALOG", "fake_steps:STEPS")
        patch.setenv("DG4D_CODE_VERSION", "test")
        patch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))
        patch.setenv("PREFECT_API_URL", str(PREFECT_API_URL.value()))
        registering.register(read_pools(), ["process-cpu"])
        with get_client(sync_client=True) as client:
            yield client


@pytest.fixture(scope="module")
def worker(
    client: SyncPrefectClient, server: Server, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[TinyS3, Path]]:
    """The object store that it sees, and the file in which its steps note that they ran."""
    place, objects = tmp_path_factory.mktemp("worker"), TinyS3()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DG4D_EXECUTOR", "in_process")
        patch.setenv("FAKE_LOG", str(place / "ran"))
        patch.setenv(SOURCES, f"{tmp_path_factory.getbasetemp()}{os.pathsep}s3://bucket/pictures")
        for name, value in objects.environment.items():
            patch.setenv(name, value)
        worker = Worker("process-cpu", server.folder)
        worker.start(str(PREFECT_API_URL.value()))
        try:
            wait_until(lambda: running(server.folder))
            worker.start(str(PREFECT_API_URL.value()))  # does nothing
            yield objects, place / "ran"
        finally:
            objects.stop()
            assert worker.stop()
    assert not running(server.folder)
    assert not worker.stop()
