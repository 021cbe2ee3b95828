"""Deployments on a real server: what a form asks for, what the server refuses, runs by a worker, hostile clients."""

import json
import re
import signal
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any, get_args

import pytest
from conversions import Run
from fake_steps import picture
from prefect.client.orchestration import SyncPrefectClient
from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterParentFlowRunId
from prefect.exceptions import PrefectHTTPStatusError, TerminationSignal
from prefect.flow_engine import run_flow
from prefect.states import Cancelling, Failed, Pending
from pydantic import ValidationError
from tiny_s3 import TinyS3
from waiting import wait_until

from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.input_settings import WarpSettings
from flows import deployments
from flows.engine.cancellation import stay_cancelled
from flows.packages.publish import load_verified
from flows.serving import registering, watching
from flows.serving.pools import read_pools
from flows.serving.roots import SOURCES
from flows.serving.server import Server
from flows.serving.watching import announce
from flows.serving.workers import Worker
from steps.profiles import PREVIEW, PROFILES, revise
from steps.store.artifact_store import ArtifactStore
from tests.clients.node import run_node

PNG = Path(__file__).parents[3] / "examples" / "newt.png"
NAMES = {
    "picture-to-4d": "Picture to 4D",
    "video-to-4d": "Video to 4D",
    "model-to-4d": "Model to 4D",
    "benchmark": "Benchmark",
    "catalog-to-4d": "Catalog to 4D",
    "item-to-4d": "Item to 4D",
}


def test_the_form_offers_every_profile() -> None:
    assert set(get_args(deployments.Options.model_fields["profile"].annotation)) == set(PROFILES)


@pytest.mark.parametrize(
    ("name", "titles"),
    [
        ("picture-to-4d", ["Picture", "Output folder", "Options", "Other sides", "Cut-out and depth"]),
        ("video-to-4d", ["Video", "Output folder", "Options", "Other sides", "Cut-out and depth"]),
        ("model-to-4d", ["Model", "Output folder", "Picture", "Options"]),
        ("catalog-to-4d", ["Pictures and videos", "Output folder", "Items at a time", "Where items run",
                           "Stop at the first failed gate", "Options"]),
        ("benchmark", ["Data set", "Output folder", "Maximum number of objects", "Score the meshes",
                       "Ground-truth views as the prior", "Items at a time", "Options"]),
    ],
)  # fmt: skip
def test_a_form_has_a_plain_field_for_everything_in_a_sensible_order(
    client: SyncPrefectClient, name: str, titles: list[str]
) -> None:
    form = client.read_deployment_by_name(f"{name}/{NAMES[name]}").parameter_openapi_schema
    assert form is not None
    assert [field["title"] for field in in_order(form)] == titles
    assert [field["title"] for field in in_order(form) if "default" not in field] == titles[:2]
    pictures = name in {"picture-to-4d", "model-to-4d", "catalog-to-4d"}
    options = form["definitions"]["PictureOptions" if pictures else "Options"]
    assert [field["title"] for field in in_order(options)] == [
        "Profile", *(["Motion"] if pictures else []), "Triangles", "Texture size", "Frames per second", "Seed",
        "Commercial use only", "Further settings",
    ]  # fmt: skip
    plain = [field for field in in_order(form) if field["title"] not in {"Options", "Other sides", "Cut-out and depth"}]
    for field in [*plain, *in_order(options)]:
        assert field["description"] and field["title"][0].isupper()
        assert field["type"] in {"string", "integer", "number", "boolean", "array"}  # a choice of types is a riddle
        assert field.get("default", "") is not None
        bounds = [field[bound] for bound in ("minimum", "maximum") if field.get(bound)]
        assert all({f"{bound:g}", str(bound)} & set(re.findall(r"\d+", field["description"])) for bound in bounds)
    assert form["properties"]["options"]["default"] == {
        "profile": "preview", "seed": 0, "commercial_only": False, "settings": [],
    }  # fmt: skip


def in_order(schema: dict[str, Any]) -> list[dict[str, Any]]:
    """The fields as forms show them."""
    fields = list(schema["properties"].values())
    assert sorted(field["position"] for field in fields) == list(range(len(fields)))
    return sorted(fields, key=lambda field: int(field["position"]))


@pytest.mark.parametrize("field", [{"seed": 2**63}, {"seed": -1}, {"fps": 0}, {"fps": 241}, {"fps": "nan"}])
def test_numbers_out_of_range_are_no_form(field: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        deployments.PictureOptions.model_validate(field)


def test_what_a_form_asks_for_reaches_the_knobs() -> None:
    filled = {"triangles": 400, "fps": None, "motion": "wave", "settings": ["mesh.max_faces=7", "subject.size = 64"]}
    options = deployments.PictureOptions.model_validate(filled)
    assert options.changes() == {"mesh.max_faces": 400, "driving.motion": "wave", "subject.size": 64}
    driving = revise(PREVIEW, options.changes()).driving
    assert isinstance(driving, WarpSettings) and driving.motion == "wave"


def test_registering_again_changes_nothing(client: SyncPrefectClient) -> None:
    def there() -> tuple[list[Any], list[str]]:
        found = [(one.id, one.parameters, one.work_pool_name) for one in client.read_deployments()]
        return sorted(found, key=str), sorted(one.name for one in client.read_automations())

    before = there()
    assert registering.register(read_pools(), ["process-cpu"]) == [f"{flow}/{name}" for flow, name in NAMES.items()]
    assert there() == before
    assert {automation.name for automation in registering.AUTOMATIONS} <= set(before[1])


def test_automations_that_two_commands_made_twice_are_one_again(client: SyncPrefectClient) -> None:
    one = registering.AUTOMATIONS[0]
    client.create_automation(one)
    assert len(client.read_automations_by_name(one.name)) == 2
    registering._automate(client)
    assert len(client.read_automations_by_name(one.name)) == 1


def test_automations_of_an_earlier_version_are_removed(client: SyncPrefectClient) -> None:
    for one, name in zip(registering.AUTOMATIONS, registering.RENAMED, strict=True):
        client.create_automation(one.model_copy(update={"name": name}))
    registering._automate(client)
    there = [automation.name for automation in client.read_automations()]
    assert not {*there} & {*registering.RENAMED}
    assert all(there.count(automation.name) == 1 for automation in registering.AUTOMATIONS)


def test_commands_register_one_after_the_other(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path))
    monkeypatch.setattr(registering, "PATIENCE_S", 0.0)
    begun: list[str] = []

    def register(pools: object, chosen: list[str]) -> list[str]:
        begun.append("first")
        with pytest.raises(BackendUnavailable, match="another `dg4d up`"):
            registering.register({}, [])
        return chosen

    monkeypatch.setattr(registering, "_register", register)
    assert registering.register({}, ["pool"]) == ["pool"]
    assert begun == ["first"]


@pytest.mark.slow
def test_a_server_goes_on_following_the_runs_that_it_followed_when_it_is_registered_again(
    client: SyncPrefectClient,
) -> None:
    def followers() -> dict[str, str]:
        found = client.request("POST", "/automations/filter", json={}).json()
        return {one["name"]: one["trigger"]["id"] for one in found if one["name"] in names}

    names = {automation.name for automation in registering.AUTOMATIONS}
    before = followers()
    assert set(before) == names
    registering.register(read_pools(), ["process-cpu"])
    assert followers() == before  # what it knows of runs is kept under these
    one = registering.AUTOMATIONS[0]
    known = client.find_automation(one.name)
    assert known is not None
    client.update_automation(known.id, one.model_copy(update={"description": "of an older dg4d"}))
    registering.register(read_pools(), ["process-cpu"])
    again = client.find_automation(one.name)
    assert again is not None and again.description == one.description


@pytest.mark.parametrize("where", ["dask://127.0.0.1:8786", "ray", "deployment:", "local "])
def test_the_server_refuses_places_for_items_that_only_the_user_of_the_worker_may_name(
    client: SyncPrefectClient, where: str
) -> None:
    catalog = client.read_deployment_by_name("catalog-to-4d/Catalog to 4D")
    with pytest.raises(PrefectHTTPStatusError, match=r"409|422"):
        client.create_flow_run_from_deployment(catalog.id, parameters={"inputs": "in", "out": "out", "where": where})


@pytest.mark.parametrize(
    "options",
    [{"seed": -1}, {"texture": 63}, {"profile": "papre"}, {"triangles": "many"}, {"tecture": 64},
     {"motion": "swim"}, {"settings": ["motion.iterations"]}, {"settings": "seed=1"}],
)  # fmt: skip
def test_the_server_refuses_options_that_cannot_be(client: SyncPrefectClient, options: dict[str, Any]) -> None:
    catalog = client.read_deployment_by_name("catalog-to-4d/Catalog to 4D")
    wanted = {"inputs": "in", "out": "out", "options": options}
    with pytest.raises(PrefectHTTPStatusError, match=r"409|422"):
        client.create_flow_run_from_deployment(catalog.id, parameters=wanted)


def ask(client: SyncPrefectClient, name: str, **parameters: Any) -> Any:
    """Ask for a run as a form does; the run, once it is over."""
    deployment = client.read_deployment_by_name(f"{name}/{NAMES[name]}")
    client.create_flow_run_from_deployment(deployment.id, parameters=parameters)
    return wait_until(lambda: ended(client, parameters["out"]))


def ended(client: SyncPrefectClient, out: str) -> Any:
    """The run that was asked for `out`, once it is over for good."""
    runs = [run for run in client.read_flow_runs() if run.parameters.get("out") == out]
    over = (run for run in runs if run.state is not None and (run.state.is_completed() or run.state.is_failed()))
    return next(over, None)


@pytest.mark.parametrize("missing", ["DEPLOYMENT", "TRIGGER"])
def test_a_folder_is_not_watched_on_a_server_that_would_lose_its_files(
    client: SyncPrefectClient, dg4d: Run, monkeypatch: pytest.MonkeyPatch, missing: str
) -> None:
    watching.check_registered()
    monkeypatch.setattr(watching, missing, "catalog-to-4d/Nothing")
    monkeypatch.setattr(watching.Watcher, "poll", lambda *_: pytest.fail("it is watched"))
    Path("in").mkdir()
    done = dg4d("watch", "in", "-o", "out")
    assert done.exit_code == 69 and "run `dg4d up` first" in done.stderr


def test_the_failed_runs_of_a_watched_folder_are_known(client: SyncPrefectClient, tmp_path: Path) -> None:
    catalog = client.read_deployment_by_name(watching.DEPLOYMENT)
    runs = watching.FailedRuns(tmp_path / "out")
    for out, message in (("out", "no items"), ("elsewhere", "another")):
        given = {"inputs": "in", "out": str(tmp_path / out)}
        client.create_flow_run_from_deployment(catalog.id, name="in", parameters=given, state=Failed(message=message))
    assert runs.poll() == ["failed: run in: no items"]
    assert runs.poll() == watching.FailedRuns(tmp_path / "out").poll() == []


@pytest.mark.slow
def test_what_is_dropped_into_a_folder_is_converted_by_a_worker(
    worker: tuple[TinyS3, Path], client: SyncPrefectClient, tmp_path: Path
) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "dropped.png").write_text(picture("dropped"))
    (tmp_path / "in" / "list.csv").write_text("path\ndropped.png\n")
    announce(tmp_path / "in", tmp_path / "in" / "list.csv", tmp_path / "out", "sha256:0")
    run = wait_until(lambda: ended(client, str(tmp_path / "out")))
    assert run.parameters["inputs"] == str(tmp_path / "in" / "list.csv")
    assert run.state.is_completed() and run.state.message == f"1 of 1 items are in {tmp_path / 'out'}"
    status = json.loads((tmp_path / "out" / "summary.json").read_text())["items"][0]["status"]
    assert status == "done"
    (conversion,) = client.read_flow_runs(
        flow_run_filter=FlowRunFilter(parent_flow_run_id=FlowRunFilterParentFlowRunId(any_=[run.id]))
    )
    assert (conversion.name, conversion.tags) == ("dropped", ["preview"])  # nothing lies between the two
    wanted = {"artifacts": {"flow_run_id": {"any_": [str(run.id)]}}}
    pages = client.request("POST", "/artifacts/filter", json=wanted).json()
    assert [page["type"] for page in pages if page["type"] != "progress"] == ["markdown"]
    assert any("[dropped](/artifacts/key/asset-dropped-" in str(page["data"]) for page in pages)


@pytest.mark.slow
def test_a_run_whose_process_was_killed_goes_on_after_its_last_finished_step(
    worker: tuple[TinyS3, Path], client: SyncPrefectClient, tmp_path: Path
) -> None:
    (tmp_path / "killed.png").write_text(picture(f"{tmp_path} fit_gaussians=sleep:2 fit_motion=die-once"))
    _, log = worker
    before = len(log.read_text().split()) if log.exists() else 0
    run = ask(client, "picture-to-4d", picture=str(tmp_path / "killed.png"), out=str(tmp_path / "out"))
    assert run.state.is_completed() and run.run_count == 2
    steps = log.read_text().split()[before:]
    assert steps[0] == "prepare_subject"
    assert {*steps[1:3]} == {"drive_video", "fit_gaussians"}  # side by side
    assert steps[3:] == ["fit_motion", "fit_motion", "plan_mesh", "extract_mesh", "pack_asset", "check_asset"]
    load_verified(tmp_path / "out")


@pytest.mark.slow
def test_a_worker_knows_how_many_runs_would_end_with_it(
    worker: tuple[TinyS3, Path], client: SyncPrefectClient, server: Server, tmp_path: Path
) -> None:
    (tmp_path / "counted.png").write_text(picture(f"{tmp_path} fit_gaussians=sleep:3"))
    counted = Worker("process-cpu", server.folder)
    wait_until(lambda: counted.runs() == 0)  # the process of an earlier run may just be ending
    deployment = client.read_deployment_by_name("picture-to-4d/Picture to 4D")
    parameters = {"picture": str(tmp_path / "counted.png"), "out": str(tmp_path / "out")}
    client.create_flow_run_from_deployment(deployment.id, parameters=parameters)
    wait_until(lambda: counted.runs() == 1)
    wait_until(lambda: ended(client, parameters["out"]))
    wait_until(lambda: counted.runs() == 0)


@pytest.mark.parametrize(("asked", "left"), [(True, "CANCELLED"), (False, "CRASHED")])
def test_a_run_that_a_signal_ends_is_cancelled_if_its_end_was_asked_for(
    client: SyncPrefectClient, monkeypatch: pytest.MonkeyPatch, asked: bool, left: str
) -> None:
    deployment = client.read_deployment_by_name(f"picture-to-4d/{NAMES['picture-to-4d']}")
    given = {"picture": "in.png", "out": "out"}
    run = client.create_flow_run_from_deployment(deployment.id, parameters=given, state=Pending())

    def end() -> None:
        if asked:
            client.set_flow_run_state(run.id, Cancelling(message="by a person"), force=True)
        raise TerminationSignal(signal.SIGTERM)

    monkeypatch.setattr(deployments, "_start", end)
    before = signal.signal(signal.SIGTERM, lambda *_: None)  # Prefect sends the signal again after the flow
    try:
        with pytest.raises(TerminationSignal):
            run_flow(deployments.picture_to_4d, run, given)
    finally:
        signal.signal(signal.SIGTERM, before)
    state = client.read_flow_run(run.id).state
    assert state is not None and state.type.name == left


def test_every_deployment_keeps_a_cancelled_run_cancelled() -> None:
    for name in NAMES:
        assert stay_cancelled in getattr(deployments, name.replace("-", "_")).on_crashed_hooks


def test_a_run_that_was_begun_too_often_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PREFECT__RUNTIME__FLOW_RUN__RUN_COUNT", str(deployments.MOST_STARTS + 1))
    with pytest.raises(BackendUnavailable, match="started 3 times"):
        deployments.picture_to_4d.fn("in.png", "out")


def test_a_picture_of_an_object_store_is_fetched_and_converted(
    worker: tuple[TinyS3, Path], client: SyncPrefectClient, tmp_path: Path
) -> None:
    objects, _ = worker
    objects.objects["pictures/a fox.png"] = picture(f"a fox of {tmp_path}").encode(), time.time()
    run = ask(client, "picture-to-4d", picture="s3://bucket/pictures/a fox.png", out=str(tmp_path / "fox"))
    assert run.state.is_completed(), run.state.message
    record = json.loads((tmp_path / "fox" / "provenance.json").read_text())
    assert record["item"] == "a fox"
    objects.objects.clear()
    run = ask(client, "picture-to-4d", picture="s3://bucket/pictures/a fox.png", out=str(tmp_path / "gone"))
    assert run.state.is_failed() and "a fox.png" in run.state.message
    assert not (tmp_path / "gone").exists()


def test_the_name_of_a_run_tells_no_signature(
    client: SyncPrefectClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(SOURCES, str(tmp_path))
    with pytest.raises(BadInput, match="cannot be fetched"):
        deployments.picture_to_4d("http://user:word@127.0.0.1:1/fox.png?signature=key", str(tmp_path / "out"))
    (run,) = (run for run in client.read_flow_runs() if run.parameters.get("out") == str(tmp_path / "out"))
    assert run.name == "http://127.0.0.1/fox.png"


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
