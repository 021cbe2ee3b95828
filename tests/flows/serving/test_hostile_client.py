"""Hostile clients of a real server with a real worker, and a browser of the user, which still gets everything."""

import json
import urllib.error
import urllib.request
from pathlib import Path

import pytest
from fake_steps import picture
from prefect.client.orchestration import SyncPrefectClient
from tiny_s3 import TinyS3
from waiting import wait_until

from flows.serving.server import Server
from steps.store.artifact_store import ArtifactStore
from tests.clients.node import run_node

PNG = Path(__file__).parents[3] / "examples" / "newt.png"


@pytest.fixture
def artifact(server: Server) -> str:
    """Path of a picture on the server."""
    ref = ArtifactStore(server.folder.parent / "store").put(PNG, "image/png")
    return f"/dg4d/artifacts/{ref.digest.removeprefix('sha256:')}/{ref.size_bytes}/subject.png"


def login(server: Server) -> str:
    return server.login_address(str(server.address()))


def test_a_program_without_the_secret_cannot_have_a_worker_run_a_command(
    worker: tuple[TinyS3, Path], client: SyncPrefectClient, server: Server, tmp_path: Path
) -> None:
    headers = {"Content-Type": "application/json", "Origin": "http://evil.example", "Host": "rebind.evil.example"}
    script = {"prefect.deployments.steps.run_shell_script": {"script": f"touch {tmp_path / 'run'}"}}
    before = {flow.name for flow in client.read_flows()}
    for path, body in (
        ("/api/flows/", {"name": "hostile"}),
        ("/api/deployments/", {"name": "hostile", "work_pool_name": "process-cpu", "pull_steps": [script]}),
        (f"/api/deployments/{client.read_deployment_by_name('picture-to-4d/Picture to 4D').id}/create_flow_run", {}),
        ("/api/flow_runs/filter", {}),
    ):
        for sent in (headers, {"Content-Type": "application/json"}):
            request = urllib.request.Request(f"{server.address()}{path}", json.dumps(body).encode(), sent)
            with pytest.raises(urllib.error.HTTPError) as refused:
                urllib.request.urlopen(request)
            refused.value.close()
            assert refused.value.code in {400, 401, 403}
    assert {flow.name for flow in client.read_flows()} == before
    assert not (tmp_path / "run").exists()


def test_a_page_on_another_port_gets_nothing_from_a_browser_that_is_signed_in(
    client: SyncPrefectClient, server: Server, artifact: str
) -> None:
    got = run_node("hostile_page.mjs", json.dumps({"login": login(server), "artifact": artifact}))
    assert got.pop("own") == 200
    assert set(got.values()) == {"refused"} and len(got) == 11, got
    assert "hostile" not in {flow.name for flow in client.read_flows()}


@pytest.mark.slow
def test_a_person_signs_in_fills_in_a_form_cancels_the_run_and_opens_an_artifact(
    worker: tuple[TinyS3, Path], client: SyncPrefectClient, server: Server, artifact: str, tmp_path: Path
) -> None:
    (tmp_path / "slow.png").write_text(picture(f"{tmp_path} fit_gaussians=sleep:60"))
    page = {
        "key": "hostile-browser",
        "type": "markdown",
        "data": f"# Page\n\n![](http://tracker.example/x.png) [open the file]({artifact.replace('.png', '.bin')})",
    }
    made = client.request("POST", "/artifacts/", json=page).json()
    deployment = client.read_deployment_by_name("picture-to-4d/Picture to 4D")
    seen = run_node(
        "prefect_run.mjs",
        json.dumps(
            {
                "login": login(server),
                "deployment": f"/v2/deployments/deployment/{deployment.id}",
                "picture": str(tmp_path / "slow.png"),
                "out": str(tmp_path / "out"),
                "artifact": f"/v2/artifacts/artifact/{made['id']}",
                "link": "open the file",
                "screenshot": str(tmp_path / "artifact.png"),
            }
        ),
        timeout_s=200,
    )
    assert seen["state"] in {"Cancelling", "Cancelled"}
    assert bytes.fromhex(seen["download"]) == PNG.read_bytes()[:8]
    assert seen["elsewhere"] == []
    assert seen["loggedOut"] == "/dg4d/login"
    (run,) = (run for run in client.read_flow_runs() if run.parameters.get("out") == str(tmp_path / "out"))
    assert wait_until(lambda: client.read_flow_run(run.id).state_name) in {"Cancelling", "Cancelled"}
