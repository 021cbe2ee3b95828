"""A catalog on several machines: workers with a home and an identity each, one server, one object store."""

import json
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from conversions import EVERY_STEP
from fake_steps import picture
from prefect.client.orchestration import get_client
from prefect.client.schemas.filters import FlowFilter, FlowFilterName
from prefect.settings import PREFECT_API_URL
from tiny_s3 import TinyS3
from waiting import wait_until

from benchmarks.fleet import POOL, Machine
from flows.engine.item_runs import FLOW
from flows.engine.orphans import settle_orphans
from flows.packages.publish import load_verified
from flows.serving import registering
from flows.serving.pools import read_pools
from flows.serving.server import Server
from flows.serving.workers import environment

ITEMS = 9


@pytest.fixture
def shared(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, str]]:
    """Variables of every machine; the pool of fleets is registered."""
    api_url, objects = str(PREFECT_API_URL.value()), TinyS3()
    monkeypatch.setenv("DG4D_HOME", str(server.folder.parent))
    monkeypatch.setenv("PREFECT_API_URL", api_url)
    registering.register(read_pools(), [POOL])
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("DG4D_")}
    yield {
        **inherited,
        **environment(api_url),
        **objects.environment,
        "DG4D_STORE": "s3://bucket/store",
        "DG4D_CATALOG": "fake_steps:STEPS",
        "DG4D_CODE_VERSION": tmp_path.name,
        "DG4D_EXECUTOR": "in_process",
        "DG4D_CPUS": "2",
        "PYTHONPATH": str(Path(__file__).parents[1]),
    }
    objects.stop()


def begin(folder: Path, shared: dict[str, str]) -> "subprocess.Popen[str]":
    """Begin the command, on a machine without a worker."""
    own = {"DG4D_HOME": str(folder / "home"), "DG4D_HOST_ID": "catalog", "FAKE_LOG": str(folder / "none")}
    inputs = [str(folder / "in"), "-o", str(folder / "out"), "--where", f"deployment:{POOL}", "--workers", str(ITEMS)]
    return subprocess.Popen(
        [sys.executable, "-m", "flows.cli", "batch", *inputs],
        env={**shared, **own},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def finished(machines: list[Machine]) -> Counter[str]:
    return Counter(step for machine in machines for step in machine.steps)


def item_runs() -> int:
    """Return the number of items that were begun."""
    with get_client(sync_client=True) as client:
        runs = client.read_flow_runs(flow_filter=FlowFilter(name=FlowFilterName(any_=[FLOW])))
    return len(runs)


def _all_begun(command: "subprocess.Popen[str]", earlier: int) -> bool:
    assert command.poll() is None, command.communicate()[0]  # it waits for the items
    return item_runs() == earlier + ITEMS


@pytest.mark.slow
def test_machines_share_a_catalog_and_a_machine_and_a_catalog_that_are_killed_cost_no_item_and_no_step(
    shared: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "in").mkdir()
    for i in range(ITEMS):
        words = f"fit_motion=sleep:2 named={i} {tmp_path}{' torn' * (i == 3)}"
        (tmp_path / "in" / f"{i}.png").write_text(picture(words))
    machines = [Machine(name, tmp_path / name, shared) for name in ("one", "two", "three")]
    earlier = item_runs()  # of other tests, on the same server
    command = begin(tmp_path, shared)
    try:
        wait_until(lambda: _all_begun(command, earlier) and finished(machines).total() > len(EVERY_STEP))
        command.kill()  # what it asked for goes on
        command.communicate()
        wait_until(machines[2].sleeps)
        machines[2].kill()
        command = begin(tmp_path, shared)
        monkeypatch.setenv("DG4D_HOST_ID", "three")
        wait_until(settle_orphans)  # as a command does when this machine is there again
        said, _ = command.communicate(timeout=300)
    finally:
        command.kill()
        for machine in machines:
            machine.stop()
    assert command.returncode == 0, said
    assert finished(machines) == {f"{step}:{i}": 1 for step in EVERY_STEP for i in range(ITEMS)}
    for i in range(ITEMS):
        load_verified(tmp_path / "out" / str(i))
    rows = {row["item"]: row for row in json.loads((tmp_path / "out" / "summary.json").read_text())["items"]}
    assert {row["status"] for row in rows.values()} <= {"done", "unchanged"}
    assert rows["3"]["failing"] == ["silhouette"]
    assert not (tmp_path / "none").exists()  # the machine of the command did no step
    assert "other weights" not in said
