"""The flows with a real server and steps that do next to nothing; one module, for every server costs seconds."""

import json
import signal
from pathlib import Path

import pytest
from conversions import EVERY_STEP, RUN_FACTS, Run, job, ran, tree
from fake_steps import picture
from inside import inside_a_flow
from waiting import start, wait_until

from flows import home
from flows.catalog import convert_all
from flows.convert import convert_job, rank_motions, save_pictures
from flows.engine.events import StepEvent, listening
from flows.engine.orphans import settle_orphans
from flows.inputs.conversion_job import ConversionRequest
from flows.packages.publish import load_verified
from flows.packages.summary import NOT_ACCEPTED, BatchProgress, Row
from flows.serving import background
from flows.serving.server import Server
from flows.step_errors import StepBadInput, StepCrashed, StepDiverged, StepError, StepMissing, StepOutOfMemory
from steps.profiles import PREVIEW, revise


def test_a_flow_runs_every_step_once_and_then_none(log: Path, tmp_path: Path) -> None:
    wanted = job("twice", tmp_path)
    _, cached = convert_job(wanted, tmp_path / "one")
    assert sorted(ran(log)) == sorted(EVERY_STEP)
    assert not cached
    _, cached = convert_job(wanted, tmp_path / "two")
    assert ran(log) == []
    assert cached
    assert tree(tmp_path / "one", *RUN_FACTS) == tree(tmp_path / "two", *RUN_FACTS)
    one, two = (json.loads((tmp_path / name / "provenance.json").read_text()) for name in ("one", "two"))
    assert one.pop("run") != two.pop("run")
    assert one == two
    assert len(one["steps"]) == len(EVERY_STEP)


def test_a_changed_knob_runs_its_step_and_what_follows(log: Path, tmp_path: Path) -> None:
    convert_job(job("knob", tmp_path), tmp_path / "out")
    ran(log)
    convert_job(job("knob", tmp_path, **{"mesh.grid": 64}), tmp_path / "out")
    assert ran(log) == ["plan_mesh", "extract_mesh"]  # their outputs did not change, so what follows was there already


def test_gaussians_that_were_fine_tuned_take_the_place_of_the_others(log: Path, tmp_path: Path) -> None:
    convert_job(job("tuned", tmp_path, **{"motion.fine_tune": True}), tmp_path / "out")
    record = json.loads((tmp_path / "out" / "provenance.json").read_text())
    steps = {step["step"]: step for step in record["steps"]}
    better = steps["fit_motion"]["outputs"]["gaussians"]
    assert better != steps["fit_gaussians"]["outputs"]["gaussians"] == steps["fit_motion"]["inputs"]["gaussians"]
    assert steps["extract_mesh"]["inputs"]["gaussians"] == steps["pack_asset"]["inputs"]["gaussians"] == better


def test_a_lost_artifact_is_made_again(log: Path, tmp_path: Path) -> None:
    wanted = job("lost", tmp_path)
    convert_job(wanted, tmp_path / "out")
    ran(log)
    record = json.loads((tmp_path / "out" / "provenance.json").read_text())
    motion = next(step for step in record["steps"] if step["step"] == "fit_motion")["outputs"]["motion"]
    (blob,) = (home.store().root / "sha256").rglob(motion.removeprefix("sha256:"))
    blob.unlink()
    convert_job(wanted, tmp_path / "out")
    assert set(ran(log)) >= {"fit_motion"}
    assert blob.exists()


def test_a_video_moves_the_asset_and_a_picture_is_no_video(log: Path, tmp_path: Path) -> None:
    convert_job(job("moving film", tmp_path, name="film.mp4"), tmp_path / "out")
    assert "the motion follows the video" in (tmp_path / "out" / "report.json").read_text()
    with pytest.raises(StepBadInput, match=r"single picture.* give a longer one"):
        convert_job(job("still", tmp_path, name="still.mp4"), tmp_path / "still")
    assert not (tmp_path / "still").exists()


def test_words_become_a_picture_first(log: Path, tmp_path: Path) -> None:
    settings = revise(PREVIEW, {"text.weights": "somebody/pictures"})
    request = ConversionRequest(item="words", text="a  red\ndragon", settings=settings)
    convert_job(request.to_job(home.store()), tmp_path / "out")
    assert sorted(ran(log)) == sorted(["draw_picture", *EVERY_STEP])
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["banner"].startswith("Preview: the picture was generated from text; the motion was generated;")
    assert report["licenses"] == {"fake": "fake license: <free>"}
    assert "fake license: &lt;free&gt;" in (tmp_path / "out" / "report.html").read_text()
    record = json.loads((tmp_path / "out" / "provenance.json").read_text())
    assert record["licenses"] == report["licenses"]
    assert record["steps"][0]["weights"] == {"fake/unet.safetensors": "sha256:" + "e" * 64}
    convert_job(request.model_copy(update={"text": "a red dragon"}).to_job(home.store()), tmp_path / "again")
    assert ran(log) == []


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
    wanted = job(f"fit_motion={word}", tmp_path)
    with pytest.raises(error) as caught:
        convert_job(wanted, tmp_path / "out")
    assert ran(log).count("fit_motion") == attempts
    assert not (tmp_path / "out").exists()
    pictures = save_pictures(wanted, caught.value)
    assert [p.name for p in pictures] == (["fake-fit_motion-last_good.png"] if word == "diverge" else [])


def test_memory_that_is_free_again_is_enough(log: Path, tmp_path: Path) -> None:
    convert_job(job("fit_motion=memory-once", tmp_path), tmp_path / "out")
    assert ran(log).count("fit_motion") == 2


def test_a_killed_command_goes_on_where_it_was_and_gives_the_same_bytes(log: Path, tmp_path: Path) -> None:
    (tmp_path / "x.png").write_text(picture("kill fit_motion=sleep-once:60"))
    command = start("make", str(tmp_path / "x.png"), "-o", str(tmp_path / "out"))
    wait_until(lambda: log.exists() and "fit_motion" in log.read_text())
    command.send_signal(signal.SIGKILL)
    command.communicate()
    assert sorted(ran(log)) == sorted(EVERY_STEP[:4])
    assert not (tmp_path / "out").exists()
    assert settle_orphans() == 1
    assert settle_orphans() == 0
    command = start("make", str(tmp_path / "x.png"), "-o", str(tmp_path / "out"))
    said, trouble = command.communicate()
    assert command.returncode == 0, trouble
    assert ran(log) == EVERY_STEP[3:]
    assert "prepare_subject: cached" in said
    convert_job(job("undisturbed", tmp_path), tmp_path / "other")
    assert set(tree(tmp_path / "out")) == set(tree(tmp_path / "other"))


@pytest.mark.slow
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
    assert sum("no step was run" in text for text in said) == 1
    load_verified(tmp_path / "out")


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


def test_an_asset_of_another_source_with_the_same_name_is_replaced_with_a_note(dg4d: Run, log: Path) -> None:
    for folder in ("a", "b"):
        Path(folder).mkdir()
        Path(folder, "x.png").write_text(picture(f"same name {folder}"))
    assert "note: " not in dg4d("make", "a/x.png").stdout
    assert "note: out/x holds the asset x of another source; it is replaced" in dg4d("make", "b/x.png").stdout
    assert "note: " not in dg4d("make", "b/x.png", "--seed", "1").stdout


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
    says = {"out/x": "nothing to do: every step was already done", "out/y": "no step was run: the package was written"}
    for out, line in says.items():
        done = dg4d("make", "x.png", "-o", out)
        assert done.exit_code == 0
        assert [word for word in says.values() if word in done.stdout] == [line]
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


def test_a_video_needs_no_picture_and_names_its_asset(dg4d: Run, log: Path, tmp_path: Path) -> None:
    (tmp_path / "run.v2").mkdir()
    for number in range(2):
        (tmp_path / "run.v2" / f"{number}.png").write_text(picture(f"moving alone {number}"))
    assert dg4d("make", "--video", "run.v2").exit_code == 0
    assert (tmp_path / "out" / "run.v2" / "asset.glb").is_file()


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
    other = background.background_server()
    other.start()
    assert other.wait() == server.wait() == f"{server.address()}/api"
    other.release()


def test_a_strict_batch_begins_nothing_after_an_item_that_is_not_accepted(log: Path, tmp_path: Path) -> None:
    names = ("first", "torn", "last")
    jobs = [job(f"strict {name}", tmp_path, name=f"{name}.png", item=name) for name in names]
    progress = BatchProgress(3)
    inside_a_flow(convert_all, jobs, tmp_path / "out", 1, "strict", progress, strict=True)
    rows = list(progress.rows.values())
    assert [(row.item, row.status, row.failing) for row in rows] == [
        ("first", "done", []),
        ("torn", "failed", ["silhouette"]),
        ("last", "skipped", None),
    ]
    assert "torn was not accepted" in rows[2].message
    assert (tmp_path / "out" / "torn" / "report.html").exists()
    assert not (tmp_path / "out" / "last").exists()
    made_before = Row(item="torn", status="failed", kind=NOT_ACCEPTED, failing=["silhouette"])
    progress = BatchProgress(2)
    inside_a_flow(convert_all, [made_before, jobs[2]], tmp_path / "out", 1, "refused before", progress, strict=True)
    assert [row.status for row in progress.rows.values()] == ["failed", "skipped"]
    progress = BatchProgress(3)
    inside_a_flow(convert_all, jobs, tmp_path / "out", 1, "lenient", progress)
    rows = list(progress.rows.values())
    assert [(row.status, row.failing) for row in rows] == [("done", []), ("done", ["silhouette"]), ("done", [])]


def test_the_report_says_what_the_gates_say(log: Path, tmp_path: Path) -> None:
    convert_job(job("torn thing", tmp_path), tmp_path / "out")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["acceptance"]["failing"] == ["silhouette"]
    assert "fit it &lt;again&gt;" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize("command", ["make", "motions"])
def test_the_cut_out_can_be_looked_at_while_the_next_step_runs(command: str, log: Path, tmp_path: Path) -> None:
    wanted = job(f"guess {command}", tmp_path, item="fox/red", **{"driving.candidates": 2})
    happened: list[tuple[str, str, bool]] = []

    def listen(event: StepEvent) -> None:
        happened.append((event.step, event.kind, bool(list(home.cutouts().glob("fox-red-*.png")))))
        if event.kind == "remark":
            assert event.text.startswith("This asset is a fake. Source, matte and cut-out: ")
            assert Path(event.text.rpartition(": ")[2]).read_bytes().startswith(b"\x89PNG")

    with listening(listen):
        (convert_job if command == "make" else rank_motions)(wanted, tmp_path / "out")
    assert happened.index(("prepare_subject", "remark", True)) < happened.index(("drive_video", "started", True))
    for saved in home.cutouts().glob("fox-red-*.png"):
        saved.unlink()
