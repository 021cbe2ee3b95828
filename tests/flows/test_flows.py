"""The flows with a real server and steps that do next to nothing; one module, for every server costs seconds."""

import json
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fake_steps import picture
from inside import inside_a_flow
from prefect.client.orchestration import get_client
from typer.testing import CliRunner, Result
from waiting import start, wait_until

from flows import cli, home
from flows.catalog import convert_all
from flows.commands.make import make, make_motions, save_pictures
from flows.engine import tasks
from flows.engine.events import StepEvent, listening
from flows.engine.executors import StepBadInput, StepCrashed, StepDiverged, StepError, StepMissing, StepOutOfMemory
from flows.engine.orphans import settle_orphans
from flows.inputs.orders import Order, Wish
from flows.packages.publish import whole
from flows.packages.summary import NOT_ACCEPTED, Row, Tally
from flows.serving.server import Server
from steps.profiles import PREVIEW, revise

EVERY_STEP = [
    "prepare_subject", "drive_video", "fit_gaussians", "fit_motion", "extract_mesh", "refine_texture", "pack_asset",
    "check_asset",
]  # fmt: skip
RUN_FACTS = ("report.json", "report.html", "provenance.json", "ro-crate-metadata.json")  # these say when and how long
Run = Callable[..., Result]


@pytest.fixture(scope="module")
def place(server: Server) -> Iterator[None]:
    """Fake steps under the home folder of the server, for this process and those that it starts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DG4D_HOME", str(server.folder.parent))
        patch.setenv("DG4D_CATALOG", "fake_steps:STEPS")
        patch.setenv("DG4D_CODE_VERSION", "test")
        patch.setenv("PYTHONPATH", str(Path(__file__).parent))
        yield


@pytest.fixture
def log(place: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where fake steps say that they ran; steps run in this process, and nobody waits before trying again."""
    monkeypatch.setenv("FAKE_LOG", str(tmp_path / "ran"))
    monkeypatch.setenv("DG4D_EXECUTOR", "in_process")
    monkeypatch.setattr(tasks, "RETRY_DELAY_S", 0.01)
    return tmp_path / "ran"


def ran(log: Path) -> list[str]:
    steps = log.read_text().split() if log.exists() else []
    log.unlink(missing_ok=True)
    return steps


def order(words: str, folder: Path, *, name: str = "fake.png", item: str = "fake", **changes: object) -> Order:
    (folder / name).write_text(picture(words))
    return Wish(item=item, picture=folder / name, settings=revise(PREVIEW, dict(changes))).order(home.store())


def tree(folder: Path, *but: str) -> dict[str, bytes]:
    files = (p for p in sorted(folder.rglob("*")) if p.is_file() and p.name not in but)
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in files}


def test_a_flow_runs_every_step_once_and_then_none(log: Path, tmp_path: Path) -> None:
    wanted = order("twice", tmp_path)
    _, cached = make(wanted, tmp_path / "one")
    assert ran(log) == EVERY_STEP
    assert not cached
    _, cached = make(wanted, tmp_path / "two")
    assert ran(log) == []
    assert cached
    assert tree(tmp_path / "one", *RUN_FACTS) == tree(tmp_path / "two", *RUN_FACTS)
    one, two = (json.loads((tmp_path / name / "provenance.json").read_text()) for name in ("one", "two"))
    assert one.pop("run") != two.pop("run")
    assert one == two
    assert len(one["steps"]) == len(EVERY_STEP)


def test_a_changed_knob_runs_its_step_and_what_follows(log: Path, tmp_path: Path) -> None:
    make(order("knob", tmp_path), tmp_path / "out")
    ran(log)
    make(order("knob", tmp_path, **{"mesh.grid": 64}), tmp_path / "out")
    assert ran(log) == ["extract_mesh"]  # its output did not change, so what follows was there already


def test_gaussians_that_were_fine_tuned_take_the_place_of_the_others(log: Path, tmp_path: Path) -> None:
    make(order("tuned", tmp_path, **{"motion.fine_tune": True}), tmp_path / "out")
    record = json.loads((tmp_path / "out" / "provenance.json").read_text())
    steps = {step["step"]: step for step in record["steps"]}
    better = steps["fit_motion"]["outputs"]["gaussians"]
    assert better != steps["fit_gaussians"]["outputs"]["gaussians"] == steps["fit_motion"]["inputs"]["gaussians"]
    assert steps["extract_mesh"]["inputs"]["gaussians"] == steps["pack_asset"]["inputs"]["gaussians"] == better


def test_a_lost_artifact_is_made_again(log: Path, tmp_path: Path) -> None:
    wanted = order("lost", tmp_path)
    make(wanted, tmp_path / "out")
    ran(log)
    record = json.loads((tmp_path / "out" / "provenance.json").read_text())
    motion = next(step for step in record["steps"] if step["step"] == "fit_motion")["outputs"]["motion"]
    (blob,) = (home.store().root / "sha256").rglob(motion.removeprefix("sha256:"))
    blob.unlink()
    make(wanted, tmp_path / "out")
    assert set(ran(log)) >= {"fit_motion"}
    assert blob.exists()


def test_a_video_moves_the_asset_and_a_picture_is_no_video(log: Path, tmp_path: Path) -> None:
    make(order("moving film", tmp_path, name="film.mp4"), tmp_path / "out")
    assert "the motion follows the video" in (tmp_path / "out" / "report.json").read_text()
    with pytest.raises(StepBadInput, match="single picture"):
        make(order("still", tmp_path, name="still.mp4"), tmp_path / "still")
    assert not (tmp_path / "still").exists()


def test_words_become_a_picture_first(log: Path, tmp_path: Path) -> None:
    settings = revise(PREVIEW, {"text.weights": "somebody/pictures"})
    wish = Wish(item="words", text="a  red\ndragon", settings=settings)
    make(wish.order(home.store()), tmp_path / "out")
    assert ran(log) == ["draw_picture", *EVERY_STEP]
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["banner"].startswith("Preview: the picture was drawn by a model; the motion was made up;")
    assert report["licenses"] == {"fake": "fake license: <free>"}
    assert "fake license: &lt;free&gt;" in (tmp_path / "out" / "report.html").read_text()
    record = json.loads((tmp_path / "out" / "provenance.json").read_text())
    assert record["licenses"] == report["licenses"]
    assert record["steps"][0]["weights"] == {"fake/unet.safetensors": "sha256:" + "e" * 64}
    make(wish.model_copy(update={"text": "a red dragon"}).order(home.store()), tmp_path / "again")
    assert ran(log) == []


def test_a_mesh_per_frame_is_made_in_parts_and_joined(log: Path, tmp_path: Path) -> None:
    knobs = {"mesh.mode": "per_frame", "mesh.frames_per_task": 2}
    make(order("parts", tmp_path, **knobs), tmp_path / "two")
    assert ran(log).count("extract_mesh") == 3  # five frames, two at a time
    make(order("parts", tmp_path, **{**knobs, "mesh.frames_per_task": 5}), tmp_path / "five")
    assert ran(log).count("extract_mesh") == 1
    assert (tmp_path / "two" / "asset.glb").read_bytes() == (tmp_path / "five" / "asset.glb").read_bytes()


def test_every_step_of_a_conversion_in_parts_is_linked_to_those_that_made_its_inputs(log: Path, tmp_path: Path) -> None:
    make(order("linked", tmp_path, **{"mesh.mode": "per_frame", "mesh.frames_per_task": 2}), tmp_path / "out")
    record = json.loads((tmp_path / "out" / "provenance.json").read_text())
    maker, wanted = {record["recipe"]["source"]["digest"]: ""}, set()
    for step, run in zip(record["steps"], record["run"]["steps"], strict=True):
        wanted |= {(maker[digest], run["step"]) for digest in step["inputs"].values()}  # no input was made by nobody
        maker |= dict.fromkeys(step["outputs"].values(), run["step"])
    parts = {f"extract_mesh {number}/3" for number in (1, 2, 3)}
    assert {(part, "join_meshes") for part in parts} | {("join_meshes", "refine_texture")} <= wanted
    flow_run = record["run"]["flow_run"]
    wait_until(lambda: {edge for edge in wanted if edge[0]} <= drawn_edges(flow_run))  # the server notes runs later


def drawn_edges(flow_run: str) -> set[tuple[str, str]]:
    """Return the edges between steps in the run graph of the server."""
    with get_client(sync_client=True) as client:
        graph = client.request("GET", f"/flow_runs/{flow_run}/graph-v2").json()
    names = {node: facts["label"].partition(":")[0] for node, facts in graph["nodes"]}
    return {(names[node], names.get(child["id"], "")) for node, facts in graph["nodes"] for child in facts["children"]}


def test_every_frame_gets_a_mesh_where_one_cannot_follow(log: Path, tmp_path: Path) -> None:
    make(order("flutters", tmp_path, **{"mesh.mode": "auto", "mesh.frames_per_task": 3}), tmp_path / "out")
    assert ran(log).count("extract_mesh") == 3  # once to see that it does not follow, then five frames in two parts
    make(order("flutters", tmp_path, **{"mesh.mode": "tracked"}), tmp_path / "one")
    assert ran(log).count("extract_mesh") == 1


@pytest.mark.parametrize(
    ("word", "error", "attempts"),
    [
        ("bad:ugly", StepBadInput, 1),
        ("missing", StepMissing, 1),
        ("diverge", StepDiverged, 1),
        ("crash", StepCrashed, 2),
        ("memory", StepOutOfMemory, 3),
    ],
)
def test_only_what_may_heal_is_tried_again(
    log: Path, tmp_path: Path, word: str, error: type[StepError], attempts: int
) -> None:
    wanted = order(f"fit_motion={word}", tmp_path)
    with pytest.raises(error) as caught:
        make(wanted, tmp_path / "out")
    assert ran(log).count("fit_motion") == attempts
    assert not (tmp_path / "out").exists()
    pictures = save_pictures(wanted, caught.value)
    assert [p.name for p in pictures] == (["fake-fit_motion-last_good.png"] if word == "diverge" else [])


def test_memory_that_is_free_again_is_enough(log: Path, tmp_path: Path) -> None:
    make(order("fit_motion=memory-once", tmp_path), tmp_path / "out")
    assert ran(log).count("fit_motion") == 2


@pytest.fixture
def dg4d(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """The command in this process, which is connected already."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("flows.commands.make.connect", lambda: None)
    return lambda *arguments: CliRunner().invoke(cli.app, arguments)


def test_a_killed_command_goes_on_where_it_was_and_gives_the_same_bytes(log: Path, tmp_path: Path) -> None:
    (tmp_path / "x.png").write_text(picture("kill fit_motion=sleep-once:60"))
    command = start("make", str(tmp_path / "x.png"), "-o", str(tmp_path / "out"))
    wait_until(lambda: log.exists() and "fit_motion" in log.read_text())
    command.send_signal(signal.SIGKILL)
    command.communicate()
    assert ran(log) == EVERY_STEP[:4]
    assert not (tmp_path / "out").exists()
    assert settle_orphans() == 1
    assert settle_orphans() == 0
    command = start("make", str(tmp_path / "x.png"), "-o", str(tmp_path / "out"))
    said, trouble = command.communicate()
    assert command.returncode == 0, trouble
    assert ran(log) == EVERY_STEP[3:]
    assert "prepare_subject: cached" in said
    make(order("undisturbed", tmp_path), tmp_path / "other")
    assert set(tree(tmp_path / "out")) == set(tree(tmp_path / "other"))


def test_two_commands_at_once_do_the_work_once(log: Path, tmp_path: Path) -> None:
    (tmp_path / "x.png").write_text(picture("both fit_gaussians=sleep:1"))
    both = [start("make", str(tmp_path / "x.png"), "-o", str(tmp_path / out)) for out in ("a", "b")]
    for command in both:
        _, trouble = command.communicate()
        assert command.returncode == 0, trouble
    assert sorted(ran(log)) == sorted(EVERY_STEP)
    assert tree(tmp_path / "a", *RUN_FACTS) == tree(tmp_path / "b", *RUN_FACTS)


def test_two_runs_into_one_folder_take_turns_and_the_second_finds_it_done(log: Path, tmp_path: Path) -> None:
    (tmp_path / "x.png").write_text(picture("turns fit_gaussians=sleep:2"))
    both = [start("make", str(tmp_path / "x.png"), "-o", str(tmp_path / "out")) for _ in range(2)]
    said = [command.communicate()[0] for command in both]
    assert [command.returncode for command in both] == [0, 0]
    assert sorted(ran(log)) == sorted(EVERY_STEP)
    assert sum("waiting for another run" in text for text in said) == 1
    assert sum("nothing to do" in text for text in said) == 1
    whole(tmp_path / "out")


def test_a_package_of_another_asset_is_replaced_only_by_force(dg4d: Run, log: Path, tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / f"{name}.png").write_text(picture(f"{name} by force"))
    assert dg4d("make", "one.png", "-o", "same").exit_code == 0
    before = tree(tmp_path / "same")
    refused = dg4d("make", "two.png", "-o", "same")
    assert refused.exit_code == 65 and "'one'" in refused.output and "--force" in refused.output
    assert tree(tmp_path / "same") == before
    assert dg4d("make", "two.png", "-o", "same", "--force").exit_code == 0
    assert json.loads((tmp_path / "same" / "provenance.json").read_text())["item"] == "two"


def test_what_a_gate_does_not_let_pass_is_said_at_the_end(dg4d: Run, log: Path, tmp_path: Path) -> None:
    for words, told in (("torn again", True), ("fine again", False)):
        (tmp_path / "x.png").write_text(picture(words))
        done = dg4d("make", "x.png")
        assert done.exit_code == 0
        assert ("not accepted: silhouette; the report says what to do" in done.stdout) == told


def test_a_command_with_nothing_to_do_says_so(dg4d: Run, log: Path, tmp_path: Path) -> None:
    (tmp_path / "x.png").write_text(picture("nothing"))
    assert "nothing to do" not in dg4d("make", "x.png").output
    ran(log)
    before = tree(tmp_path / "out" / "x")
    for out in ("out/x", "out/y"):
        done = dg4d("make", "x.png", "-o", out)
        assert done.exit_code == 0
        assert "nothing to do: every step was already done" in done.stdout
    assert ran(log) == []
    assert tree(tmp_path / "out" / "x") == before
    assert tree(tmp_path / "out" / "y", *RUN_FACTS) == {k: v for k, v in before.items() if k not in RUN_FACTS}


def test_motions_are_shown_without_an_asset_being_made(dg4d: Run, log: Path, tmp_path: Path) -> None:
    (tmp_path / "x.png").write_text(picture("choose"))
    done = dg4d("motions", "x.png", "--candidates", "3")
    assert done.exit_code == 0, done.output
    assert ran(log) == EVERY_STEP[:2]
    files = tree(tmp_path / "out" / "x-motions")
    assert set(files) == {"motions.png", "motions.json", "1.mp4", "2.mp4", "3.mp4"}
    assert [line.split()[0] for line in done.stdout.splitlines() if "still" in line] == ["1", "2", "3"]
    assert "motions.png" in done.stdout


def test_a_video_has_its_motion_already(dg4d: Run, tmp_path: Path) -> None:
    (tmp_path / "x.png").write_text(picture("moving"))
    done = dg4d("motions", "x.png")
    assert done.exit_code == 65 and "x.png" in done.stderr and "motion already" in done.stderr


def test_a_pick_is_a_knob_of_the_driving_video(dg4d: Run, log: Path, tmp_path: Path) -> None:
    (tmp_path / "x.png").write_text(picture("pick"))
    assert dg4d("make", "x.png", "--pick", "3", "-o", "picked").exit_code == 0
    ran(log)
    record = json.loads((tmp_path / "picked" / "provenance.json").read_text())
    drive = next(step for step in record["steps"] if step["step"] == "drive_video")
    assert drive["settings"]["driving"]["pick"] == 3
    done = dg4d("make", "x.png", "--set", "driving.pick=3", "-o", "picked")
    assert done.exit_code == 0 and "nothing to do" in done.stdout
    assert dg4d("make", "x.png", "--pick", "0").exit_code == 2


def test_bad_input_that_a_step_finds_is_one_message(dg4d: Run, tmp_path: Path) -> None:
    (tmp_path / "x.png").write_text(picture("prepare_subject=bad:ugly"))
    done = dg4d("make", "x.png", "-o", "out")
    assert done.exit_code == 65
    assert done.stderr == "dg4d: x.png: the picture is ugly\n"
    assert not (tmp_path / "out").exists()


def test_a_fit_that_diverged_says_where_and_shows_the_last_good_state(dg4d: Run, tmp_path: Path) -> None:
    (tmp_path / "x.png").write_text(picture("fit_motion=diverge"))
    done = dg4d("make", "x.png", "-o", "out")
    assert done.exit_code == 65
    assert "iteration 7" in done.stderr
    (saved,) = (word for word in done.stderr.split() if word.endswith(".png"))
    assert Path(saved).is_file()
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("word", "status"), [("missing", 69), ("full", 65), ("crash", 1)])
def test_the_exit_status_of_the_command_follows_the_step(dg4d: Run, tmp_path: Path, word: str, status: int) -> None:
    (tmp_path / "x.png").write_text(picture(f"prepare_subject={word}"))
    assert dg4d("make", "x.png", "-o", "out").exit_code == status
    assert not (tmp_path / "out").exists()


def test_a_batch_makes_what_it_can_and_leaves_alone_what_is_made(dg4d: Run, tmp_path: Path, log: Path) -> None:
    (tmp_path / "in" / "deep").mkdir(parents=True)
    for name, words in {"a": "one", "deep/b": "two", "bad": "prepare_subject=bad:ugly"}.items():
        (tmp_path / "in" / f"{name}.png").write_text(picture(words))
    done = dg4d("batch", "in", "-o", "out", "--workers", "2")
    assert done.exit_code == 1, done.output
    status = {row["item"]: row["status"] for row in json.loads((tmp_path / "out/summary.json").read_text())["items"]}
    assert status == {"a": "done", "bad": "failed", "deep/b": "done"}
    assert (tmp_path / "out/deep/b/asset.glb").exists()
    assert not (tmp_path / "out/bad").exists()
    ran(log)
    (tmp_path / "in" / "bad.png").write_text(picture("good"))
    (tmp_path / "in" / "a.png").write_text(picture("one changed"))
    assert dg4d("batch", "in", "-o", "out").exit_code == 0
    assert sorted(ran(log)) == sorted(EVERY_STEP * 2)
    again = dg4d("batch", "in", "-o", "out")
    assert again.exit_code == 0
    assert "nothing to do" in again.stdout
    assert ran(log) == []


def test_there_is_one_server(place: None, server: Server) -> None:
    other = home.background_server()
    other.start()
    assert other.wait() == server.wait() == f"{server.address()}/api"
    other.release()


def test_a_strict_batch_begins_nothing_after_an_item_that_is_not_accepted(log: Path, tmp_path: Path) -> None:
    names = ("first", "torn", "last")
    orders = [order(f"strict {name}", tmp_path, name=f"{name}.png", item=name) for name in names]
    tally = Tally(3)
    inside_a_flow(convert_all, orders, tmp_path / "out", 1, "strict", tally, strict=True)
    rows = list(tally.rows.values())
    assert [(row.item, row.status, row.failing) for row in rows] == [
        ("first", "done", []),
        ("torn", "failed", ["silhouette"]),
        ("last", "skipped", None),
    ]
    assert "torn was not accepted" in rows[2].message
    assert (tmp_path / "out" / "torn" / "report.html").exists()
    assert not (tmp_path / "out" / "last").exists()
    made_before = Row(item="torn", status="failed", kind=NOT_ACCEPTED, failing=["silhouette"])
    tally = Tally(2)
    inside_a_flow(convert_all, [made_before, orders[2]], tmp_path / "out", 1, "refused before", tally, strict=True)
    assert [row.status for row in tally.rows.values()] == ["failed", "skipped"]
    tally = Tally(3)
    inside_a_flow(convert_all, orders, tmp_path / "out", 1, "lenient", tally)
    rows = list(tally.rows.values())
    assert [(row.status, row.failing) for row in rows] == [("done", []), ("done", ["silhouette"]), ("done", [])]


def test_the_report_says_what_the_gates_say(log: Path, tmp_path: Path) -> None:
    make(order("torn thing", tmp_path), tmp_path / "out")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["acceptance"]["failing"] == ["silhouette"]
    assert "fit it &lt;again&gt;" in (tmp_path / "out" / "report.html").read_text()


def test_parts_side_by_side_take_less_time_on_the_clock_than_to_compute(log: Path, tmp_path: Path) -> None:
    settings = revise(PREVIEW, {"mesh.mode": "per_frame", "mesh.frames_per_task": 1})
    (tmp_path / "a.png").write_text(picture("side by side extract_mesh=sleep:1"))
    make(Wish(item="parts", picture=tmp_path / "a.png", settings=settings).order(home.store()), tmp_path / "out")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    parts = [stage for stage in report["steps"] if stage["step"].startswith("extract_mesh")]
    assert len(parts) == 5 and all(part["compute_s"] >= 1 for part in parts)
    ends = [part["wall_s"] for part in parts]
    assert ends[-1] > ends[0] + 1  # two at a time: the first ends long before the last
    assert max(ends) <= report["wall_s"] < sum(ends)


@pytest.mark.parametrize("command", ["make", "motions"])
def test_the_cut_out_can_be_looked_at_while_the_next_step_runs(command: str, log: Path, tmp_path: Path) -> None:
    wanted = order(f"guess {command}", tmp_path, item="fox/red", **{"driving.candidates": 2})
    happened: list[tuple[str, str, bool]] = []

    def listen(event: StepEvent) -> None:
        happened.append((event.step, event.kind, bool(list(home.cutouts().glob("fox-red-*.png")))))
        if event.kind == "remark":
            assert event.text.startswith("This asset is a fake. Source, matte and cut-out: ")
            assert Path(event.text.rpartition(": ")[2]).read_bytes().startswith(b"\x89PNG")

    with listening(listen):
        (make if command == "make" else make_motions)(wanted, tmp_path / "out")
    assert happened.index(("prepare_subject", "remark", True)) < happened.index(("drive_video", "started", True))
    for saved in home.cutouts().glob("fox-red-*.png"):
        saved.unlink()
