"""Deployments on a real server: what a form asks for, what the server refuses, and runs by a worker."""

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.exceptions import PrefectHTTPStatusError
from prefect.settings import PREFECT_API_URL
from prefect.utilities.callables import parameter_schema

from flows import deployments, registering
from flows.pools import read_pools
from flows.server import Server
from flows.watching import announce
from flows.workers import Worker, running
from steps.profiles import PROFILES

FLOWS = ["image-to-4d", "video-to-4d", "catalog", "benchmark"]


@pytest.fixture(scope="module")
def client(server: Server) -> Iterator[SyncPrefectClient]:
    """Of a server that has the pool process-cpu and its deployments."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DG4D_HOME", str(server.folder.parent))
        patch.setenv("DG4D_CATALOG", "fake_steps:STEPS")
        patch.setenv("DG4D_CODE_VERSION", "test")
        patch.setenv("PYTHONPATH", str(Path(__file__).parent))
        patch.setenv("PREFECT_API_URL", str(PREFECT_API_URL.value()))
        registering.register(read_pools(), ["process-cpu"])
        with get_client(sync_client=True) as client:
            yield client


def wait_until(happens: Callable[[], Any], timeout_s: float = 200) -> Any:
    deadline = time.monotonic() + timeout_s
    while not (found := happens()):
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.3)
    return found


def test_the_form_offers_every_profile() -> None:
    assert set(get_args(deployments.Options.model_fields["profile"].annotation)) == set(PROFILES)


@pytest.mark.parametrize("name", ["image_to_4d", "video_to_4d", "catalog", "benchmark"])
def test_everything_that_a_form_asks_for_is_explained(name: str) -> None:
    schema = parameter_schema(getattr(deployments, name)).model_dump_for_openapi()
    assert all(field.get("description") for field in schema["properties"].values())
    assert all(field["description"] for field in schema["definitions"]["Options"]["properties"].values())


def test_registering_again_changes_nothing(client: SyncPrefectClient) -> None:
    def there() -> tuple[list[Any], list[str]]:
        found = [(one.id, one.parameters, one.work_pool_name) for one in client.read_deployments()]
        return sorted(found, key=str), sorted(one.name for one in client.read_automations())

    before = there()
    assert registering.register(read_pools(), ["process-cpu"]) == [
        "image-to-4d/local", "video-to-4d/local", "benchmark/local", "catalog/local",
    ]  # fmt: skip
    assert there() == before
    assert registering.DEAD in before[1]


@pytest.mark.parametrize(
    "options", [{"seed": -1}, {"texture": 63}, {"profile": "papre"}, {"triangles": "many"}, {"tecture": 64}]
)
def test_the_server_refuses_options_that_cannot_be(client: SyncPrefectClient, options: dict[str, Any]) -> None:
    catalog = client.read_deployment_by_name("catalog/local")
    wanted = {"inputs": "in", "out": "out", "options": options}
    with pytest.raises(PrefectHTTPStatusError, match=r"409|422"):
        client.create_flow_run_from_deployment(catalog.id, parameters=wanted)


def test_what_is_dropped_into_a_folder_is_converted_by_a_worker(
    client: SyncPrefectClient, server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DG4D_EXECUTOR", "in_process")
    monkeypatch.setenv("FAKE_LOG", str(tmp_path / "ran"))
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "dropped.png").write_text("dropped")
    api_url = str(PREFECT_API_URL.value())
    worker = Worker("process-cpu", server.folder)
    worker.start(api_url)
    try:
        wait_until(lambda: running(server.folder))
        worker.start(api_url)  # does nothing
        announce(tmp_path / "in", tmp_path / "out", "sha256:0")
        run = wait_until(lambda: ended(client, str(tmp_path / "out")))
        assert run.parameters["inputs"] == str(tmp_path / "in")
        assert run.state.is_completed() and run.state.message == f"1 of 1 items are in {tmp_path / 'out'}"
        status = json.loads((tmp_path / "out" / "summary.json").read_text())["items"][0]["status"]
        assert status == "done"
    finally:
        assert worker.stop()
    assert not running(server.folder)
    assert not worker.stop()


def ended(client: SyncPrefectClient, out: str) -> Any:
    """The run that was asked for `out`, once it is over."""
    runs = [run for run in client.read_flow_runs() if run.parameters.get("out") == out]
    return next((run for run in runs if run.state is not None and run.state.is_final()), None)
