"""Order, width and publication of a conversion's tasks, with a real server and fake steps."""

import json
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from conversions import Run, job, ran, store_is_sound, tree
from fake_steps import picture
from prefect.client.orchestration import get_client
from waiting import wait_until

from flows import home
from flows.convert import convert_job
from flows.engine import executors
from flows.engine.events import StepEvent, listening
from flows.inputs.conversion_job import ConversionRequest
from flows.inputs.given_views import ViewsRequest, parse_views
from flows.packages import publish
from flows.stages import planned_steps
from steps.profiles import PREVIEW, revise
from steps.store.artifact_store import StoreUnreachable


def test_a_mesh_per_frame_is_made_in_as_many_parts_as_the_machine_has_slots(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = job("parts", tmp_path, **{"mesh.mode": "per_frame"})
    for slots, parts in ((3, 3), (1, 1), (8, 5)):  # of five frames
        monkeypatch.setenv("DG4D_CPUS", str(slots))
        convert_job(wanted, tmp_path / str(parts))
        report = json.loads((tmp_path / str(parts) / "report.json").read_text())
        assert sum(stage["step"].startswith("extract_mesh") for stage in report["steps"]) == parts
    assert len({(tmp_path / name / "asset.glb").read_bytes() for name in "135"}) == 1


def test_views_of_other_sides_reach_both_fits_and_belong_to_the_package(log: Path, tmp_path: Path) -> None:
    for name in ("front.png", "back.png"):
        (tmp_path / name).write_text(picture(name))
    sides = ViewsRequest(views=parse_views([f"180={tmp_path / 'back.png'}"]))
    front = tmp_path / "front.png"
    request = ConversionRequest(item="two", picture=front, mask=front, settings=PREVIEW, given_views=sides)
    convert_job(request.to_job(home.store()), tmp_path / "out")
    assert "prepare_views" in ran(log) and store_is_sound()
    steps = json.loads((tmp_path / "out" / "provenance.json").read_text())["steps"]
    inputs = {step["step"]: step["inputs"] for step in steps}
    assert inputs["prepare_views"]["mask"] == inputs["prepare_subject"]["mask"]
    assert inputs["fit_gaussians"]["known_views"] == inputs["fit_motion"]["known_views"]
    assert all("subject" not in given for step, given in inputs.items() if step.startswith("extract_mesh"))


@pytest.mark.parametrize("given", [False, True])
def test_drawn_views_reach_both_fits_and_give_way_to_the_users(given: bool, log: Path, tmp_path: Path) -> None:
    for name in ("front.png", "back.png"):
        (tmp_path / name).write_text(picture(f"{name} beside drawn views: {given}"))
    sides = ViewsRequest(views=parse_views([f"180={tmp_path / 'back.png'}"])) if given else ViewsRequest()
    settings = revise(PREVIEW, {"views.kind": "image_edit"})
    request = ConversionRequest(item="drawn", picture=tmp_path / "front.png", settings=settings, given_views=sides)
    wanted = request.to_job(home.store())
    assert ("generate_views" in planned_steps(wanted)) == (not given)
    convert_job(wanted, tmp_path / "out")
    assert [step for step in ran(log) if step.endswith("_views")] == ["prepare_views" if given else "generate_views"]
    steps = json.loads((tmp_path / "out" / "provenance.json").read_text())["steps"]
    inputs = {step["step"]: step["inputs"] for step in steps}
    assert inputs["fit_gaussians"]["known_views"] == inputs["fit_motion"]["known_views"]
    assert all("subject" not in given for step, given in inputs.items() if step.startswith("extract_mesh"))


def test_the_run_graph_has_every_edge(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DG4D_CPUS", "3")
    convert_job(job("linked", tmp_path, **{"mesh.mode": "per_frame"}), tmp_path / "out")
    record = json.loads((tmp_path / "out" / "provenance.json").read_text())
    maker, wanted = {record["recipe"]["source"]["digest"]: ""}, set()
    for step, run in zip(record["steps"], record["run"]["steps"], strict=True):
        wanted |= {(maker[digest], run["step"]) for digest in step["inputs"].values()}  # no input was made by nobody
        maker |= dict.fromkeys(step["outputs"].values(), run["step"])
    parts = {f"extract_mesh {number}/3" for number in (1, 2, 3)}
    assert {(part, "join_meshes") for part in parts} | {("join_meshes", "pack_asset")} <= wanted
    wanted |= {("pack_asset", "publish"), ("check_asset", "publish")}
    flow_run = record["run"]["flow_run"]
    wait_until(lambda: {edge for edge in wanted if edge[0]} <= drawn_edges(flow_run))  # the server notes runs later


def drawn_edges(flow_run: str) -> set[tuple[str, str]]:
    """Return the edges between steps in the run graph of the server."""
    with get_client(sync_client=True) as client:
        graph = client.request("GET", f"/flow_runs/{flow_run}/graph-v2").json()
    names = {node: facts["label"].partition(":")[0] for node, facts in graph["nodes"]}
    return {(names[node], names.get(child["id"], "")) for node, facts in graph["nodes"] for child in facts["children"]}


def test_every_frame_gets_a_mesh_where_one_cannot_follow(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DG4D_CPUS", "2")
    convert_job(job("flutters", tmp_path, **{"mesh.mode": "auto"}), tmp_path / "out")
    steps = ran(log)
    assert (steps.count("plan_mesh"), steps.count("extract_mesh")) == (1, 2)  # five frames in two parts
    convert_job(job("flutters", tmp_path, **{"mesh.mode": "tracked"}), tmp_path / "one")
    assert ran(log).count("extract_mesh") == 1


def test_a_model_of_the_users_own_takes_the_place_of_the_fit(log: Path, tmp_path: Path) -> None:
    (tmp_path / "a.glb").write_bytes(b"glTF model")
    (tmp_path / "a.png").write_text(picture("moved"))
    request = ConversionRequest(item="own", asset=tmp_path / "a.glb", settings=PREVIEW)
    convert_job(request.to_job(home.store()), tmp_path / "alone")
    assert ran(log) == ["prepare_asset", "drive_video", "animate_asset", "pack_asset", "check_asset"]
    with_picture = request.model_copy(update={"picture": tmp_path / "a.png"})
    convert_job(with_picture.to_job(home.store()), tmp_path / "pictured")
    steps = ran(log)
    assert sorted(steps[:3]) == ["drive_video", "prepare_asset", "prepare_subject"]
    assert steps[3:] == ["animate_asset", "pack_asset", "check_asset"]


def test_splats_of_the_users_own_get_a_mesh_as_fitted_ones_do(log: Path, tmp_path: Path) -> None:
    (tmp_path / "a.spz").write_bytes(b"\x1f\x8b splats")
    request = ConversionRequest(
        item="own", asset=tmp_path / "a.spz", settings=revise(PREVIEW, {"mesh.mode": "tracked"})
    )
    convert_job(request.to_job(home.store()), tmp_path / "out")
    assert ran(log)[2:5] == ["animate_asset", "plan_mesh", "extract_mesh"]


def test_parts_side_by_side_take_less_time_on_the_clock_than_to_compute(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DG4D_CPUS", "16")
    settings = revise(PREVIEW, {"mesh.mode": "per_frame"})
    (tmp_path / "a.png").write_text(picture("side by side extract_mesh=sleep:1"))
    convert_job(
        ConversionRequest(item="parts", picture=tmp_path / "a.png", settings=settings).to_job(home.store()),
        tmp_path / "out",
    )
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    parts = [stage for stage in report["steps"] if stage["step"].startswith("extract_mesh")]
    assert len(parts) == 5 and all(part["compute_s"] >= 1 for part in parts)
    assert report["wall_s"] < sum(part["wall_s"] for part in parts)


def test_independent_steps_and_the_meshes_of_all_frames_run_side_by_side(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DG4D_CPUS", "16")
    running: set[str] = set()
    most: dict[str, int] = {}

    def watch(event: StepEvent) -> None:
        if event.kind == "started":
            running.add(event.step)
        elif event.kind == "finished":
            running.discard(event.step)
        most[event.step.partition(" ")[0]] = max(most.get(event.step.partition(" ")[0], 0), len(running))

    words = "wide drive_video=sleep:1 fit_gaussians=sleep:1 extract_mesh=sleep:6 drive_video=frames:16"
    with listening(watch):
        convert_job(job(words, tmp_path, **{"mesh.mode": "per_frame"}), tmp_path / "out")
    assert max(most["drive_video"], most["fit_gaussians"]) == 2
    assert most["extract_mesh"] == ran(log).count("extract_mesh") == 16


def test_a_version_that_cannot_be_kept_leaves_the_earlier_package(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    convert_job(job("before", tmp_path), tmp_path / "out")
    (tmp_path / "out" / "mine.txt").write_text("of the user")
    before = tree(tmp_path / "out")

    def unreachable(*_: object) -> None:
        assert tree(tmp_path / "out") == before  # a command that is killed here leaves no package without a version
        raise StoreUnreachable("the store is away")

    request = ConversionRequest(item="fake", picture=tmp_path / "fake.png", settings=PREVIEW, seed=1)
    with monkeypatch.context() as patch:
        patch.setattr("flows.engine.publishing.versions.keep_version", unreachable)
        with pytest.raises(StoreUnreachable):
            convert_job(request.to_job(home.store()), tmp_path / "out")
    assert tree(tmp_path / "out") == before
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []
    with get_client(sync_client=True) as client:
        (newest,) = client.read_flow_runs(limit=1, sort="START_TIME_DESC")  # type: ignore[arg-type]
    assert newest.state is not None and newest.state.is_failed()
    convert_job(request.to_job(home.store()), tmp_path / "out")
    assert json.loads((tmp_path / "out" / "report.json").read_text())["seed"] == 1
    assert (tmp_path / "out" / "mine.txt").read_text() == "of the user"


def test_a_package_that_cannot_be_published_fails_the_run(dg4d: Run, log: Path, tmp_path: Path) -> None:
    (tmp_path / "x.png").write_text(picture("in the way pack_asset=sleep:1"))
    blocker = threading.Thread(target=lambda: (wait_until((tmp_path / "ran").exists), (tmp_path / "out").touch()))
    blocker.start()  # a file where the folder should be
    failed = dg4d("make", "x.png", "-o", "out")
    blocker.join()
    assert failed.exit_code == 65 and "out" in failed.stderr
    with get_client(sync_client=True) as client:
        (newest,) = client.read_flow_runs(limit=1, sort="START_TIME_DESC")  # type: ignore[arg-type]
    assert newest.state is not None and newest.state.is_failed()


def test_a_picture_passes_few_modules_on_its_way_to_the_steps_and_into_the_folder(
    log: Path, dg4d: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    passed: set[str] = set()

    def noting(work: Callable[..., Any]) -> Callable[..., Any]:
        def noted(*arguments: Any, **options: Any) -> Any:
            frame = sys._getframe()
            while frame := frame.f_back:  # type: ignore[assignment]
                passed.add(frame.f_globals["__name__"])
            return work(*arguments, **options)

        return noted

    monkeypatch.setitem(executors.EXECUTORS, "in_process", noting(executors.in_process))
    monkeypatch.setattr("flows.packages.publish._swap", noting(publish._swap))
    monkeypatch.setattr("flows.engine.versions.wait_for_collecting", noting(lambda _: False))
    (tmp_path / "x.png").write_text(picture("walk"))
    assert dg4d("make", "x.png").exit_code == 0
    ours = {module for module in passed if module.startswith("flows.")}
    assert {"flows.cli", "flows.pipeline", "flows.stages", "flows.packages.publish"} <= ours
    assert len(ours) <= 15, sorted(ours)


def test_textures_are_refined_by_a_step_only_where_a_model_is_asked_for(log: Path, tmp_path: Path) -> None:
    convert_job(job("refined", tmp_path), tmp_path / "out")
    assert "refine_texture" not in ran(log)


@pytest.mark.parametrize("maker", ["prepare_subject", "prepare_asset"])
def test_the_refinement_sees_the_input_picture_or_the_render_of_the_users_model(
    maker: str, log: Path, tmp_path: Path
) -> None:
    settings = revise(PREVIEW, {"refiner.kind": "video_to_video"})
    (tmp_path / "a.png").write_text(picture("refined by a model"))
    (tmp_path / "a.glb").write_bytes(b"glTF refined")
    own = {"asset": tmp_path / "a.glb"} if maker == "prepare_asset" else {"picture": tmp_path / "a.png"}
    request = ConversionRequest(item="refined", settings=settings, **own)
    convert_job(request.to_job(home.store()), tmp_path / "out")
    assert "refine_texture" in ran(log)
    steps = {step["step"]: step for step in json.loads((tmp_path / "out" / "provenance.json").read_text())["steps"]}
    assert steps["refine_texture"]["inputs"]["subject"] == steps[maker]["outputs"]["subject"]
