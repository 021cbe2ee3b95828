"""The terminal as a new user meets it: several pictures, what comes next, tables, progress."""

import io
import json
import os
import shlex
from pathlib import Path

import pytest
from conversions import Run, ran
from fake_steps import picture
from PIL import Image
from rich.console import Console

from flows import convert
from flows.commands import make
from flows.commands.terminal import print_next, print_tables, steps_shown
from flows.engine.events import StepEvent, emit
from flows.engine.schedule import Schedule
from flows.packages import publish
from flows.packages.scores import ObjectScores, Results, remarks, titled_tables
from flows.serving.results import Results as WatchedResults


def words(name: str, text: str) -> str:
    Path(name).write_text(picture(text))
    return name


def test_several_pictures_become_an_asset_each_and_a_bad_one_does_not_stop_the_others(dg4d: Run, log: Path) -> None:
    names = [words("a.png", "1"), words("b.png", "2 prepare_subject=bad:empty"), words("c.png", "3")]
    done = dg4d("make", *names, "-o", "all")
    assert done.exit_code == 1, done.output
    assert all(Path("all", name, "asset.glb").exists() for name in "ac") and not Path("all/b").exists()
    assert "2 of 3: b.png" in done.stdout and "failed: b: b.png: the picture is empty" in done.stdout
    assert "2 of 3 assets are in all" in done.stdout
    ran(log)
    again = dg4d("make", "a.png", "c.png", "-o", "all")
    assert again.exit_code == 0 and again.stdout.count("nothing to do") == 2 and ran(log) == []


def test_an_unexpected_error_of_a_picture_does_not_stop_the_others(dg4d: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def check_folder(folder: Path, item: str, force: bool) -> None:
        if item == "b":
            raise RuntimeError("nobody thought of this")
        publish.check_folder(folder, item, force)

    monkeypatch.setattr(make, "check_folder", check_folder)
    done = dg4d("make", *(words(f"{name}.png", name) for name in "abc"), "-o", "all")
    assert done.exit_code == 1 and "failed: b: internal error (RuntimeError: nobody thought of this)" in done.stdout
    assert "2 of 3 assets are in all" in done.stdout


def test_pictures_of_one_name_get_folders_of_their_own(dg4d: Run) -> None:
    Path("x").mkdir()
    assert dg4d("make", words("a.png", "1"), words("x/a.png", "2")).exit_code == 0
    assert sorted(path.name for path in Path("out").iterdir()) == ["a-png", "a-png-2"]


@pytest.mark.parametrize("option", [("--text", "a fox"), ("--video", "a.png"), ("--mask", "a.png")])
def test_options_for_one_asset_are_refused_with_several_pictures(dg4d: Run, option: tuple[str, str]) -> None:
    done = dg4d("make", words("a.png", "1"), words("b.png", "2"), *option)
    assert done.exit_code == 65 and f"{option[0]} makes one asset, and 2 pictures are given" in done.stderr


def test_the_end_names_the_viewer_and_the_command_that_opens_it(dg4d: Run) -> None:
    done = dg4d("make", words("my fox.png", "1"))
    assert "viewer: out/my fox/viewer.html (open it with `dg4d view 'out/my fox'`)" in done.stdout
    assert "report: out/my fox/report.html" in done.stdout


def test_a_folder_without_a_viewer_names_none(tmp_path: Path) -> None:
    screen = io.StringIO()
    print_next(Console(file=screen), tmp_path)
    assert screen.getvalue() == ""


def test_motions_have_a_header_and_say_how_to_use_one(dg4d: Run) -> None:
    done = dg4d("motions", words("fox.png", "1"), "--candidates", "3")
    assert done.exit_code == 0, done.output
    lines = done.stdout.splitlines()
    header = next(i for i, line in enumerate(lines) if line.split() == ["pick", "score", "motion,", "best", "first"])
    assert [line.split()[0] for line in lines[header + 1 : header + 4]] == ["1", "2", "3"]
    assert lines[header].index("score") == lines[header + 1].index("1.00")
    assert lines[-1].endswith(": dg4d make --pick 1 fox.png")


def test_motions_of_a_video_are_refused_before_any_step(dg4d: Run, log: Path) -> None:
    done = dg4d("motions", words("walk.mp4", "1"))
    assert done.exit_code == 65 and "walk.mp4 is a video; give a picture" in done.stderr
    assert ran(log) == []


def test_the_command_after_motions_makes_the_motion_that_was_shown(dg4d: Run) -> None:
    Image.new("L", (8, 6), 255).save("my mask.png")
    options = ["--set", "driving.motion=bend", "--set", "driving.fps=9", "--profile", "video-fast", "--seed", "7",
               "--mask", "my mask.png", "--box", "1,1,4,4", "--layers", "my mask.png", "--commercial-only"]  # fmt: skip
    warp = ["--set", "driving.kind=warp", "--set", "prior.kind=geometric", "--set", "refiner.kind=identity"]
    done = dg4d("motions", *warp, *options, "--candidates", "3", "-o", "sheet", "--", words("-fox.png", "1"))
    assert done.exit_code == 0, done.output
    _, _, command = done.stdout.splitlines()[-1].partition(": dg4d make ")
    given = shlex.split(command)
    assert given[-2:] == ["--", "-fox.png"]
    assert sorted(given[:-2]) == sorted([*warp, *options, "--pick", "1"])


def test_a_forced_name_counts_for_an_equal_picture(dg4d: Run) -> None:
    assert dg4d("make", words("fox.png", "1"), "-o", "pk").exit_code == 0
    done = dg4d("make", words("wolf.png", "1"), "-o", "pk", "--force")
    assert done.exit_code == 0, done.output
    assert json.loads(Path("pk/provenance.json").read_text())["item"] == "wolf"


def test_lines_of_a_log_count_steps_and_tell_the_time_left() -> None:
    screen = io.StringIO()
    schedule = Schedule(["prepare_subject", "fit_motion"], {"prepare_subject": 1.0, "fit_motion": 39.0})
    with steps_shown(Console(file=screen, width=100), schedule):
        emit(StepEvent("newt", "prepare_subject", "started"))
        emit(StepEvent("newt", "prepare_subject", "finished", seconds=1.0))
        emit(StepEvent("newt", "join_meshes", "started"))
    first, _, other = screen.getvalue().splitlines()
    assert first == "prepare_subject: started, step 1 of 2, about 40 s left"
    assert other.startswith("join_meshes: started, about ")


@pytest.mark.parametrize("width", [60, 140])
def test_a_terminal_shows_the_whole_above_the_steps(width: int) -> None:
    screen = io.StringIO()
    schedule = Schedule(["prepare_subject", "fit_motion"], {"prepare_subject": 1.0, "fit_motion": 100.0})
    with steps_shown(Console(file=screen, width=width, force_terminal=True, color_system=None), schedule):
        emit(StepEvent("newt", "prepare_subject", "started"))
        emit(StepEvent("newt", "prepare_subject", "finished", seconds=1.0))
        emit(StepEvent("newt", "fit_motion", "started"))
    text = screen.getvalue()
    assert "step 2 of 2" in text and "s left" in text and "…" not in text
    assert text.rindex("step 2 of 2") < text.rindex("fit_motion")


def test_the_first_start_says_what_it_does(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    class Server:
        def __init__(self, runs: bool, database: bool) -> None:
            self.runs, self.database = runs, database

        def address(self) -> str | None:
            return "http://127.0.0.1:1" if self.runs else None

        def has_database(self) -> bool:
            return self.database

        def start(self) -> None: ...

        def wait(self) -> None: ...

        def wait_for_address(self) -> str:
            return "http://127.0.0.1:1"

    monkeypatch.setenv("DG4D_HOME", str(tmp_path))
    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    monkeypatch.setattr(convert.background, "set_own_server", lambda *_: None)
    monkeypatch.setattr("flows.engine.orphans.settle_orphans", lambda: 0)
    for server, first in (
        (Server(False, False), "starting the Prefect server; the first start creates its database, about 10 s"),
        (Server(False, True), "starting the Prefect server"),
        (Server(True, True), "importing the flows"),
    ):
        monkeypatch.setattr(convert.background, "background_server", lambda server=server: server)
        said: list[str] = []
        with convert.announcing(said.append):
            convert.connect()
        assert said[0] == first and said[-1] == "waiting for the Prefect server"
    assert "PREFECT_API_URL" not in os.environ


def results(objects: int) -> Results:
    row = {"mean": {"psnr": 20.5, "iou": 0.75}, "views": {}}
    scored = [ObjectScores(object=f"o{i}|<x>", rows={"ours": row}, notes=["noted"]) for i in range(objects)]
    return Results(
        title="T", ours="ours", drawn="splats", objects=scored, mean={"ours": row["mean"]}, missing={"lpips": "pull it"}
    )


def test_scores_are_tables_and_no_markdown() -> None:
    screen = io.StringIO()
    console = Console(file=screen, width=100)
    print_tables(console, titled_tables(results(2)))
    text = screen.getvalue()
    assert "T: means over 2 objects, splats" in text and "20.50" in text and "0.750" in text
    assert "o1|<x>: ours" in text and "| ---" not in text and "#" not in text
    assert len(titled_tables(results(1))) == 1
    assert remarks(results(1)) == ["lpips is missing: pull it", "o0|<x>: noted"]


def test_a_watched_folder_reports_packages_and_failures_once(tmp_path: Path) -> None:
    out = tmp_path / "out"
    for name in ("old", ".old.incoming-7"):
        (out / name).mkdir(parents=True)
        (out / name / "provenance.json").write_text("{}")
    watched = WatchedResults(out)
    assert watched.poll() == []
    (out / "deep/fox").mkdir(parents=True)
    (out / "deep/fox/provenance.json").write_text("{}")
    (out / "deep/fox/report.json").write_text(json.dumps({"acceptance": {"failing": ["flaws"]}}))
    failed = [{"item": "cat\x1b", "status": "failed", "message": "no subject"}, {"item": "fox", "status": "done"}]
    (out / "summary.json").write_text(json.dumps({"items": failed}))
    assert watched.poll() == [f"done: {out}/deep/fox (not accepted: flaws)", r"failed: cat\x1b: no subject"]
    assert watched.poll() == []
    os.utime(out / "old" / "provenance.json", (1, 1))
    (out / "summary.json").write_text("torn")
    assert watched.poll() == [f"done: {out}/old"]
