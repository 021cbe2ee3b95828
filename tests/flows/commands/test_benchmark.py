"""`dg4d score` and `dg4d bench` with a real server and steps that do next to nothing."""

import csv
import json
from collections.abc import Iterator
from io import StringIO
from pathlib import Path

import pytest
from fake_steps import PNG, bank_json, picture
from prefect.client.orchestration import get_client
from prefect.client.schemas.filters import ArtifactFilter, ArtifactFilterKey
from rich.console import Console
from typer.testing import CliRunner
from waiting import retry_after

from dg4d_lib.errors import BadInput
from flows import cli
from flows.commands.benchmark import bench, compute_seconds, frame_limit, put_ground_truth, request_of, score
from flows.packages.scores import Results
from flows.serving.server import Server
from flows.step_errors import StepError, StepMissing
from steps.artifacts.ground_truth import find_ground_truth
from steps.store.artifact_store import ArtifactStore

VIEWS = ("view_-75", "view_15")


@pytest.fixture(scope="module", autouse=True)
def place(server: Server, tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DG4D_HOME", str(tmp_path_factory.mktemp("home")))
        patch.setenv("DG4D_CATALOG", "fake_steps:STEPS")
        patch.setenv("DG4D_CODE_VERSION", "test")
        patch.setenv("DG4D_EXECUTOR", "in_process")
        retry_after(0.01, patch)
        patch.setattr("flows.convert.connect", lambda: None)  # this process is connected already
        yield


@pytest.fixture(autouse=True)
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("FAKE_LOG", str(tmp_path / "ran"))
    return tmp_path / "ran"


def ran(log: Path, step: str) -> int:
    return log.read_text().split().count(step) if log.exists() else 0


def thing(folder: Path, words: str, pattern: str = "{:03d}.png") -> Path:
    """An object of two frames; what steps should do stands in its pictures."""
    for name in ("input", *VIEWS):
        (folder / name).mkdir(parents=True)
        for i in range(2):
            content = picture(f"moving frame {i} of {name} {folder.name} {words} ")
            (folder / name / pattern.format(i)).write_text(content)
    return folder


def run(dataset: Path, out: Path, **options: object) -> Results:
    return bench(dataset, out, Console(file=StringIO()), **options)  # type: ignore[arg-type]


def test_a_benchmark_makes_judges_and_writes_everything_and_a_second_one_does_nothing(
    tmp_path: Path, log: Path
) -> None:
    for name in ("a", "b", "c"):
        thing(tmp_path / "data" / name, f"seen in {name} fit_motion=sleep:0.1")
    out = tmp_path / "out"
    results = run(tmp_path / "data", out, limit=2)
    assert [one.object for one in results.objects] == ["a", "b"]
    assert not results.failed
    assert results.mean["preview"]["psnr"] == 20
    assert results.mean["input_frozen"]["psnr"] == 10
    assert results.mean["preview"]["seconds"] >= 0
    assert "lpips" in results.missing

    written = Results.model_validate_json((out / "results.json").read_text())
    assert written == results
    rows = list(csv.DictReader(StringIO((out / "results.csv").read_text())))
    assert {(row["object"], row["method"], row["view"]) for row in rows} >= {
        ("a", "preview", "input"), ("a", "preview", "-75"), ("b", "preview", "mean"), ("b", "input_frozen", "15"),
    }  # fmt: skip
    table = (out / "table.md").read_text()
    assert "| method | LPIPS ↓ | CLIP ↑ | FVD (Consistent4D) ↓ | time, s ↓ |" in table
    assert "| preview | missing |" in table
    page = (out / "index.html").read_text()
    assert "&lt;gets it&gt;" in page
    for film in ("films/a/truth/view_-75.mp4", "films/b/ours/input.mp4"):
        assert (out / film).read_bytes() == b"film"
        assert film in page
    assert (out / "assets" / "a" / "provenance.json").is_file()
    with get_client(sync_client=True) as client:
        (artifact,) = client.read_artifacts(artifact_filter=ArtifactFilter(key=ArtifactFilterKey(any_=["benchmark"])))
    assert [row["method"] for row in json.loads(str(artifact.data))] == ["first input frame at every view", "preview"]

    made = ran(log, "pack_asset"), ran(log, "score_asset")
    assert made == (2, 4)
    assert run(tmp_path / "data", out, limit=2) == results
    assert (ran(log, "pack_asset"), ran(log, "score_asset")) == made


def test_frechet_distance_is_taken_over_all_films(tmp_path: Path) -> None:
    """Two objects with two views are four films, more than the one number that the fake network gives of a film."""
    for name in ("p", "qq"):
        thing(tmp_path / "data" / name, f"film of {name}")
    results = run(tmp_path / "data", tmp_path / "out")
    assert results.mean["preview"]["fvd"] == pytest.approx(4)  # every film 2 further than the truth's
    alone = run(tmp_path / "data", tmp_path / "alone", limit=1)
    assert alone.mean["preview"]["fvd"] == pytest.approx(4)


def test_an_object_that_fails_stops_no_other_and_is_left_out_of_the_means(tmp_path: Path) -> None:
    thing(tmp_path / "data" / "good", "all fine")
    thing(tmp_path / "data" / "ill", "fit_motion=bad:crooked .")
    thing(tmp_path / "data" / "odd", "score_asset=bad:strange .")
    results = run(tmp_path / "data", tmp_path / "out")
    assert {one.object: one.error for one in results.failed} == {
        "ill": "the picture is crooked",
        "odd": "the picture is strange",
    }
    assert results.mean["preview"]["psnr"] == 20
    assert "- ill failed: the picture is crooked" in (tmp_path / "out" / "table.md").read_text()
    assert "crooked" in (tmp_path / "out" / "index.html").read_text()


def test_a_finished_asset_is_judged_and_nothing_is_made(tmp_path: Path, log: Path) -> None:
    thing(tmp_path / "data" / "newt", "walks")
    run(tmp_path / "data", tmp_path / "out")
    before = ran(log, "pack_asset")
    file = tmp_path / "new" / "newt.json"
    asset, truth = tmp_path / "out" / "assets" / "newt", tmp_path / "data" / "newt"
    results = score(asset, truth, Console(file=StringIO()), out=file)
    assert results.mean["newt"]["psnr"] == 20
    assert Results.model_validate_json(file.read_text()) == results
    assert ran(log, "pack_asset") == before


def test_true_views_are_the_prior_where_the_bank_is_asked_for(tmp_path: Path) -> None:
    folder = thing(tmp_path / "data" / "newt", "with a bank")
    with pytest.raises(BadInput, match=r"ground-truth views, which these objects lack: newt"):
        run(tmp_path / "data", tmp_path / "out", bank=True)
    (folder / "bank").mkdir()
    (folder / "bank" / "bank.json").write_text(bank_json("a.png"))
    (folder / "bank" / "a.png").write_bytes(PNG)
    results = run(tmp_path / "data", tmp_path / "out", bank=True)
    assert results.settings["changes"] == {"prior.kind": "oracle"}
    for i in range(2, 4):
        for name in ("input", *VIEWS):
            (folder / name / f"{i:03d}.png").write_bytes(PNG)
    with pytest.raises(BadInput, match=r"only 3 frames would be used \(subject\.max_frames\): newt"):
        run(tmp_path / "data", tmp_path / "out", bank=True, changes=["subject.max_frames=3"])
    record = json.loads((tmp_path / "out" / "assets" / "newt" / "provenance.json").read_text())
    (fit,) = [step for step in record["steps"] if step["step"] == "fit_gaussians"]
    assert fit["settings"]["prior"]["kind"] == "oracle"
    assert "bank" in fit["inputs"]


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        (["score.sze=64"], r"score\.sze"),
        (["score.size=1"], "greater than or equal to 32"),
        (["score.clip_weights=./nowhere"], "no such folder"),
        (["motion.iteration=3"], "unknown setting"),
    ],
)
def test_a_wrong_setting_is_refused_before_any_work(tmp_path: Path, log: Path, changes: list[str], says: str) -> None:
    thing(tmp_path / "data" / "newt", "settings")
    with pytest.raises(BadInput, match=says):
        run(tmp_path / "data", tmp_path / "out", changes=changes)
    assert not log.exists()
    assert not (tmp_path / "out").exists()


def test_a_finished_asset_takes_no_knobs_of_the_conversion(tmp_path: Path) -> None:
    thing(tmp_path / "newt", "x")
    with pytest.raises(BadInput, match=r"only settings that begin with 'score\.'.*motion\.views"):
        score(tmp_path, tmp_path / "newt", Console(), changes=["motion.views=1"])
    with pytest.raises(BadInput, match="is not an asset"):
        score(tmp_path, tmp_path / "newt", Console())


def test_equal_truths_are_one_artifact_whatever_their_files_are_called(tmp_path: Path) -> None:
    store = ArtifactStore(tmp_path / "store")
    first, second = thing(tmp_path / "1" / "newt", "x"), thing(tmp_path / "2" / "newt", "x", "{}.png")
    assert put_ground_truth(find_ground_truth(first), store) == put_ground_truth(find_ground_truth(second), store)
    (second / VIEWS[0] / "0.png").write_text(picture("another picture"))
    assert put_ground_truth(find_ground_truth(first), store) != put_ground_truth(find_ground_truth(second), store)


def test_a_truth_that_cannot_be_judged_against_is_bad_input_and_no_table_is_written(tmp_path: Path) -> None:
    thing(tmp_path / "data" / "newt", "walks too")
    run(tmp_path / "data", tmp_path / "out")
    asset = tmp_path / "out" / "assets" / "newt"
    for words, error in (("bad:strange", BadInput), ("missing", StepMissing), ("crash", StepError)):
        truth = thing(tmp_path / words.replace(":", "-"), f"score_asset={words} .")
        with pytest.raises(error, match=r"strange|no cuda|division"):
            score(asset, truth, Console(file=StringIO()), out=tmp_path / "scores.json")
    assert not (tmp_path / "scores.json").exists()


@pytest.mark.parametrize(
    ("words", "status"),
    [
        ({"a": "fine", "b": "well"}, 0),
        ({"a": "score_asset=bad:strange .", "b": "well"}, 1),
        ({"a": "score_asset=bad:strange .", "b": "fit_motion=bad:crooked ."}, 65),
        ({"a": "score_asset=bad:strange .", "b": "score_asset=missing ."}, 1),
    ],
)
def test_the_exit_status_says_whether_every_object_has_scores(
    tmp_path: Path, words: dict[str, str], status: int
) -> None:
    for name, said in words.items():
        thing(tmp_path / "data" / name, said)
    result = CliRunner().invoke(cli.app, ["bench", str(tmp_path / "data"), "-o", str(tmp_path / "out")])
    assert result.exit_code == status, result.output
    for name, said in words.items():
        assert (f"failed: {name}: " in result.output) == ("=" in said)
    assert ("PSNR, dB" in result.output) == ("well" in words.values())


@pytest.mark.parametrize(
    ("frames", "views", "changes", "framing"),
    [
        (2, (), {}, "keep"),
        (1, VIEWS, {}, "keep"),
        (1, (), {}, "auto"),
        (2, VIEWS, {"subject.framing": "center"}, "center"),
    ],
)
def test_frames_with_a_known_camera_are_used_uncropped(
    tmp_path: Path, frames: int, views: tuple[str, ...], changes: dict[str, str], framing: str
) -> None:
    for name in ("input", *views):
        (tmp_path / "newt" / name).mkdir(parents=True)
        for i in range(frames):
            (tmp_path / "newt" / name / f"{i}.png").write_bytes(PNG)
    request = request_of(find_ground_truth(tmp_path / "newt"), False, changes, "preview", 0)
    assert request.settings.subject.framing == framing


def test_a_benchmark_in_which_every_object_fails_says_why(tmp_path: Path) -> None:
    thing(tmp_path / "data" / "ill", "fit_motion=bad:bent .")
    results = run(tmp_path / "data", tmp_path / "out")
    written = Results.model_validate_json((tmp_path / "out" / "results.json").read_text())
    assert written == results and [one.error for one in written.failed] == ["the picture is bent"]


@pytest.mark.parametrize(("mesh", "seconds"), [(False, 7.0), (True, 127.0)])
def test_times_hold_what_is_scored_and_no_more(mesh: bool, seconds: float) -> None:
    durations = {
        "prepare_subject": 1,
        "fit_gaussians": 2,
        "fit_motion": 4,
        "plan_mesh": 8,
        "extract_mesh 1/2": 16,
        "extract_mesh 2/2": 32,
        "refine_texture": 64,
        "pack_asset": 128,
        "check_asset": 256,
    }
    steps = [{"step": step, "duration_s": duration} for step, duration in durations.items()]
    assert compute_seconds({"run": {"steps": steps}}, mesh) == seconds


def test_a_step_without_a_name_has_a_time() -> None:
    assert compute_seconds({"run": {"steps": [{"step": "", "duration_s": 3}]}}, mesh=False) == 3


@pytest.mark.parametrize(
    "recipe", [{}, None, {"settings": {"subject": {"max_frames": 1}}}, {"settings": {"subject": {"max_frames": "x"}}}]
)
def test_a_record_without_the_number_of_frames_of_its_video_is_refused(recipe: object) -> None:
    steps = [{"step": "prepare_subject", "outputs": {"footage": "sha256:0"}}]
    for record in ({"steps": steps, "recipe": recipe}, {"steps": [{"step": "prepare_subject"}]}):
        with pytest.raises(BadInput, match=r"to how many frames its video was sampled.*make the asset again"):
            frame_limit(record)


@pytest.mark.parametrize(("port", "most"), [("footage", 16), ("subject", 0)])
def test_the_score_knows_to_how_many_frames_a_video_was_sampled(port: str, most: int) -> None:
    steps = [{"step": "prepare_subject", "outputs": {port: "sha256:0"}}]
    recipe = {"settings": {"subject": {"max_frames": 16}}}
    assert frame_limit({"steps": steps, "recipe": recipe}) == most
