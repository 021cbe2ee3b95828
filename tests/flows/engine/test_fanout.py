"""Batches across processes by Prefect's own engines: a Dask cluster, and two workers on one PostgreSQL server."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fake_steps import picture
from postgresql import free_port, server_on_postgresql
from prefect.client.orchestration import get_client
from prefect.settings import PREFECT_API_URL, temporary_settings
from prefect.task_runners import ThreadPoolTaskRunner
from waiting import wait_until

from dg4d_lib.errors import BackendUnavailable, BadInput
from flows.engine.orphans import LABEL
from flows.engine.runners import item_runner
from flows.inputs.places import Where, parse_where
from flows.serving import registering
from flows.serving.pools import read_pools
from flows.serving.server import Server
from flows.serving.workers import environment

FAKES = {
    "DG4D_CATALOG": "fake_steps:STEPS",
    "DG4D_CODE_VERSION": "test",
    "DG4D_EXECUTOR": "in_process",
    "DG4D_CPUS": "2",
    "PYTHONPATH": str(Path(__file__).parents[1]),
}


@pytest.fixture
def place(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Fake steps for this process and those that it starts; a folder of two pictures."""
    monkeypatch.setenv("DG4D_HOME", str(server.folder.parent))
    for name, value in FAKES.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("FAKE_LOG", str(tmp_path / "ran"))
    (tmp_path / "in").mkdir()
    for name in ("one", "two"):
        (tmp_path / "in" / f"{name}.png").write_text(picture(f"{name} of {tmp_path} fit_motion=sleep:2"))
    return tmp_path


@pytest.mark.parametrize(
    ("given", "preset", "where"),
    [
        ("", "", Where("local")),
        ("local", "dask://a:1", Where("local")),
        ("", "dask://a:1", Where("dask", "a:1")),
        ("dask", "dask://a:1", Where("dask", "a:1")),
        ("dask://b:2", "dask://a:1", Where("dask", "b:2")),
        ("deployment", "", Where("deployment")),
        ("deployment:fleet", "", Where("deployment", "fleet")),
        ("", "deployment: fleet", Where("deployment", "fleet")),
    ],
)
def test_a_place_for_items_is_an_option_or_a_variable(
    given: str, preset: str, where: Where, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DG4D_RUNNER", preset)
    assert parse_where(given) == where


def test_threads_make_the_items_unless_a_cluster_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for kind in ("local", "deployment"):
        assert isinstance(item_runner(parse_where(kind), 3), ThreadPoolTaskRunner)
    for wrong in ("ray://127.0.0.1:1", "dask", "dask://", "deployment:", "Local"):
        monkeypatch.setenv("DG4D_RUNNER", wrong)
        with pytest.raises(BadInput, match="DG4D_RUNNER"):
            parse_where()
        with pytest.raises(BadInput, match="--where"):
            parse_where(wrong)
    monkeypatch.setitem(sys.modules, "prefect_dask.task_runners", None)
    with pytest.raises(BackendUnavailable, match="prefect-dask"):
        item_runner(parse_where("dask://127.0.0.1:1"), 3)


@pytest.fixture
def cluster(place: Path) -> Iterator[str]:
    """The address of a scheduler with two workers, each a process with one thread."""
    pytest.importorskip("prefect_dask", reason="prefect-dask is not installed; run `make setup`")
    port = free_port()
    api = {**os.environ, "PREFECT_API_URL": str(PREFECT_API_URL.value())}
    commands = [["scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard"]]
    commands += [["worker", f"tcp://127.0.0.1:{port}", "--nthreads", "1", "--no-dashboard"]] * 2
    running = [
        subprocess.Popen([sys.executable, "-m", "distributed.cli.dask_" + name, *words], env=api, cwd=place)
        for name, *words in commands
    ]
    yield f"dask://127.0.0.1:{port}"
    end(running)


@pytest.mark.slow
def test_a_dask_cluster_of_two_workers_makes_a_batch(
    cluster: str, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "flows.cli", "batch", str(place / "in"), "-o", str(place / "out"), "--workers", "2"],
        env={**os.environ, "DG4D_RUNNER": cluster, "PREFECT_API_URL": str(PREFECT_API_URL.value())},
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    items = json.loads((place / "out" / "summary.json").read_text())["items"]
    assert [item["status"] for item in items] == ["done", "done"]
    makers = {
        json.loads((place / "out" / name / "provenance.json").read_text())["run"]["flow_run"] for name in ("one", "two")
    }
    with get_client(sync_client=True) as client:
        runs = [client.read_flow_run(run) for run in makers]
    assert len({run.labels[LABEL] for run in runs}) == 2  # two processes made them
    assert all(run.tags == ["preview"] for run in runs)


@pytest.mark.slow
def test_two_workers_on_one_postgresql_server_make_an_item_each(place: Path) -> None:
    running: list[subprocess.Popen[bytes]] = []
    try:
        with (
            server_on_postgresql(place / "prefect") as (api_url, _),
            temporary_settings({PREFECT_API_URL: api_url}),
            pytest.MonkeyPatch.context() as patch,
        ):
            patch.setenv("PREFECT_API_URL", api_url)
            registering.register(read_pools(), ["process-cpu"])
            own = {**os.environ, **environment(api_url), "PREFECT_HOME": str(place / "prefect")}
            own["DG4D_SOURCES"] = str(place)  # a run has an empty folder of its own, whatever the folder of the worker
            worker = [sys.executable, "-m", "prefect", "worker", "start", "--pool", "process-cpu", "--limit", "1"]
            running += [
                subprocess.Popen([*worker, "--name", name], env=own, cwd=place, stdout=subprocess.DEVNULL)
                for name in ("a", "b")
            ]
            with get_client(sync_client=True) as client:
                wait_until(lambda: len(client.read_workers_for_work_pool("process-cpu")) == 2)
                deployment = client.read_deployment_by_name("picture-to-4d/Picture to 4D")
                for name in ("one", "two"):
                    wanted = {"picture": str(place / "in" / f"{name}.png"), "out": str(place / "out" / name)}
                    client.create_flow_run_from_deployment(deployment.id, parameters=wanted)
                runs = wait_until(lambda: all_ended(client.read_flow_runs()))
            end(running)
        ours = [run for run in runs if run.deployment_id == deployment.id]
        assert [run.state.is_completed() for run in ours] == [True, True]
        assert all((place / "out" / name / "asset.glb").exists() for name in ("one", "two"))
    finally:
        end(running)


def end(running: list["subprocess.Popen[bytes]"]) -> None:
    for process in reversed(running):
        process.terminate()
    for process in running:
        process.wait(60)


def all_ended(runs: list[Any]) -> list[Any]:
    return runs if len(runs) == 4 and all(run.state.is_final() for run in runs) else []
