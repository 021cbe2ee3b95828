import errno
import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest
from fake_steps import PNG, bank_json, picture
from typer.testing import CliRunner, Result

from flows import cli
from steps.artifacts import packages, rendering
from steps.store import artifact_store as store_module


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("DG4D_CATALOG", "fake_steps:STEPS")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cat.png").write_text(picture("a cat"))

    def no_server(*_: object) -> None:
        pytest.fail("bad input must be refused before a server is started")

    monkeypatch.setattr("flows.convert.connect", no_server)
    return tmp_path


def dg4d(*arguments: str) -> Result:
    return CliRunner().invoke(cli.app, [*arguments])


def refused(result: Result, says: str, status: int = 65) -> None:
    assert result.exit_code == status, result.output
    assert says in result.stderr
    assert "Traceback" not in result.output
    assert len(result.stderr.strip().splitlines()) == 1
    assert not Path("out").exists()


def test_a_missing_file() -> None:
    refused(dg4d("make", "dog.png", "-o", "out"), "dog.png does not exist")


@pytest.mark.parametrize(
    ("options", "cropped", "whole", "says"),
    [
        ([], 3, 60.0, "edge: 3; --fit"),
        ([], 3, None, "edge: 3; make the asset again with this dg4d, then --fit"),
        ([], 0, 60.0, ""),
        (["--fit"], 3, 60.0, ""),
    ],
)
def test_cropped_renders_are_told(
    monkeypatch: pytest.MonkeyPatch, options: list[str], cropped: int, whole: float | None, says: str
) -> None:
    def render_package(*_: object, fit: bool) -> rendering.Renders:
        assert fit == ("--fit" in options)
        return rendering.Renders([Path("out/view_0")], cropped)

    monkeypatch.setattr(rendering, "render_package", render_package)
    manifest = SimpleNamespace(camera=packages.Camera(whole_fov_y_deg=whole))
    monkeypatch.setattr(packages, "read_manifest", lambda _: manifest)
    result = dg4d("render", ".", "-o", "out", *options)
    assert result.stdout == "out/view_0\n"
    assert says in result.stderr if says else not result.stderr


@pytest.mark.parametrize(
    "command", [("render", "-o", "out"), ("compose", "-o", "out/a.glb"), ("view",), ("verify",), ("rebuild",)]
)
def test_a_package_that_does_not_exist(command: tuple[str, ...]) -> None:
    refused(dg4d(*command, "nowhere"), "nowhere does not exist; give a folder that `dg4d make` wrote")


def test_a_file_of_a_package_instead_of_its_folder() -> None:
    Path("fox").mkdir()
    Path("fox/asset.glb").touch()
    refused(dg4d("render", "fox/asset.glb", "-o", "out"), "fox/asset.glb is a file; give its folder fox")


def test_ground_truth_that_does_not_exist() -> None:
    says = "--truth: nowhere does not exist; give a folder of an object, or a picture"
    refused(dg4d("score", "fox", "--truth", "nowhere"), says)


def test_a_folder_to_watch_is_checked_before_a_server_is_asked() -> None:
    refused(dg4d("watch", "nowhere", "-o", "out"), "nowhere does not exist; give a folder into which")
    refused(dg4d("watch", "cat.png", "-o", "out"), "cat.png is not a folder; give a folder into which")


def test_a_folder_instead_of_a_file() -> None:
    Path("pets").mkdir()
    refused(dg4d("make", "pets", "-o", "out"), "dg4d batch pets")


@pytest.mark.parametrize("name", ["DG4D_HOME", "DG4D_STORE", "DG4D_WEIGHTS"])
def test_processes_that_a_command_starts_get_absolute_folders(
    place: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setenv(name, "here")
    assert dg4d("settings", "static").exit_code == 0
    assert os.environ[name] == str(place / "here")


def test_an_empty_picture() -> None:
    Path("none.png").touch()
    refused(dg4d("make", "none.png", "-o", "out"), "empty (0 bytes)")


@pytest.mark.parametrize("command", [("make", "cat.png"), ("batch", "."), ("motions", "cat.png")])
def test_a_folder_in_which_nothing_may_be_written(place: Path, command: tuple[str, str]) -> None:
    (place / "kept").mkdir(mode=0o555)
    as_others = ["setpriv", "--bounding-set=-dac_override"] if os.geteuid() == 0 else []  # root may write everywhere
    program = [*as_others, sys.executable, "-m", "flows.cli", *command, "-o", "kept/out"]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert done.returncode == 65, done.stderr
    assert "cannot be written: Permission denied" in done.stderr and "choose another with -o" in done.stderr
    assert list((place / "kept").iterdir()) == []


def test_a_video_that_is_missing_or_has_one_frame() -> None:
    refused(
        dg4d("make", "cat.png", "--video", "run.mp4", "-o", "out"), "--video: run.mp4 does not exist; give a video or"
    )
    refused(
        dg4d("make", "cat.png", "--turntable", "run", "-o", "out"), "--turntable: run does not exist; give a video or"
    )
    Path("run").mkdir()
    Path("run/000.png").write_text(picture("x"))
    refused(dg4d("make", "cat.png", "--video", "run", "-o", "out"), "holds 1 picture")


def test_an_unknown_profile() -> None:
    refused(dg4d("make", "cat.png", "--profile", "perfect", "-o", "out"), "choose one of: ")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("motion.iteration=5", "motion.iteration"),
        ("motion.iterations=0", "greater than or equal to 1"),
        ("motion.iterations=many", "many"),
        ("motion.iterations", "NAME=VALUE"),
        ("mesh.mode=round", "'tracked', 'per_frame' or 'auto'"),
        ("prior.kind=crystal", "crystal"),
    ],
)
def test_a_misspelt_or_wrong_setting(change: str, says: str) -> None:
    refused(dg4d("make", "cat.png", "--set", change, "-o", "out"), says)


def test_an_output_that_is_a_file_or_lies_under_one() -> None:
    refused(dg4d("make", "cat.png", "-o", "cat.png"), "is a file")
    refused(dg4d("make", "cat.png", "-o", "cat.png/out"), "cannot be written")
    refused(dg4d("batch", ".", "-o", "cat.png/out"), "cannot be written")


def test_an_output_that_holds_other_things() -> None:
    Path("thesis").mkdir()
    Path("thesis/one.doc").touch()
    refused(dg4d("make", "cat.png", "-o", "thesis"), "one.doc")
    assert Path("thesis/one.doc").exists()


def test_a_full_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(store_module.os, "fsync", full)
    refused(dg4d("make", "cat.png", "-o", "out"), "free some space")


def test_a_bank_without_the_oracle_and_the_oracle_without_a_bank() -> None:
    Path("bank").mkdir()
    Path("bank/bank.json").write_text(bank_json("a.png"))
    Path("bank/a.png").write_bytes(PNG)
    refused(dg4d("make", "cat.png", "--bank", "bank", "-o", "out"), "prior.kind=oracle")
    refused(dg4d("make", "cat.png", "--set", "prior.kind=oracle", "-o", "out"), "--bank DIR")


@pytest.mark.parametrize("source", [("cat.png", "--video", "walk.mp4"), ("walk.mp4",)])
def test_a_pick_where_a_video_is_followed(source: tuple[str, ...]) -> None:
    Path("walk.mp4").write_text(picture("walk"))
    refused(dg4d("make", *source, "--pick", "2", "-o", "out"), "--pick chooses a generated motion, and walk.mp4")


def test_wrong_usage() -> None:
    assert dg4d("make").exit_code == 2
    assert dg4d("make", "cat.png", "--speed", "9").exit_code == 2
    assert dg4d("make", "cat.png", "--seed", "-1").exit_code == 2
    assert dg4d("batch", ".").exit_code == 2
    assert dg4d("render", ".", "--azimuths=left", "-o", "out").exit_code == 2


def test_the_version() -> None:
    result = dg4d("--version")
    declared = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text(encoding="utf-8"))["project"][
        "version"
    ]
    assert (result.exit_code, result.stdout) == (0, f"dg4d {declared}\n")


def test_a_batch_of_nothing() -> None:
    Path("empty").mkdir()
    refused(dg4d("batch", "empty", "-o", "out"), "no pictures or videos")
    refused(dg4d("batch", "cat.png", "-o", "out"), "dg4d make")


def test_a_batch_of_bad_items_fails_without_a_server_and_says_why(place: Path) -> None:
    Path("m.json").write_text(json.dumps([{"path": "dog.png"}, {"path": "cat.png", "mesh.grid": 1}]))
    result = dg4d("batch", "m.json", "-o", "out")
    assert result.exit_code == 65
    summary = json.loads(Path("out/summary.json").read_text())
    assert [item["status"] for item in summary["items"]] == ["failed", "failed"]
    assert "does not exist" in summary["items"][0]["message"]
    assert "dog" in Path("out/index.html").read_text()


def test_the_server_that_the_user_names_must_answer(place: Path) -> None:
    environment = {**os.environ, "PREFECT_API_URL": "http://127.0.0.1:9/api"}
    command = [sys.executable, "-m", "flows.cli", "make", "cat.png", "-o", "out"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 69
    assert "PREFECT_API_URL is http://127.0.0.1:9/api" in done.stderr
    assert not Path("out").exists()


def test_help_imports_neither_torch_nor_prefect_nor_the_steps() -> None:
    program = (
        "import sys; sys.argv = ['dg4d', '--help']\nfrom flows.cli import main\n"
        "try: main()\nexcept SystemExit: pass\n"
        "print([m for m in ('torch', 'numpy', 'prefect', 'pydantic', 'steps', 'OpenImageIO') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


LONG = "x" * 251


def named(name: bytes) -> str:
    """A picture whose name has these bytes."""
    Path(os.fsdecode(name)).write_text(os.fsdecode(b"a cat"))
    return os.fsdecode(name)


@pytest.mark.parametrize("command", ["make", "motions"])
@pytest.mark.parametrize("options", [(), ("-o", "out")])
def test_a_file_name_that_no_record_can_hold(command: str, options: tuple[str, ...]) -> None:
    refused(dg4d(command, named(b"caf\xe9.png"), *options), "is not UTF-8")
    refused(dg4d(command, named(f"{LONG}.png".encode()), *options), "251 bytes in UTF-8, and at most 230")
    refused(dg4d(command, named("猫".encode() * 83 + b".png"), *options), "249 bytes in UTF-8")
    refused(dg4d(command, f"{LONG}/cat.png", *options), "does not exist")
    refused(dg4d(command, "x" * 256, *options), "File name too long")
    refused(dg4d(command, "a/" * 2500, *options), "File name too long")


def test_a_video_or_a_bank_of_such_a_name() -> None:
    refused(dg4d("make", "cat.png", "--video", named(b"caf\xe9.mp4")), "is not UTF-8")
    refused(dg4d("make", "cat.png", "--bank", "x" * 256), "File name too long")
    refused(dg4d("make", "--text", "a f\udce9x"), "the text 'a f\\udce9x' is not UTF-8")


def test_an_output_folder_whose_name_leaves_no_room() -> None:
    for folder, says in ((LONG, "251 bytes"), ("x" * 256, "256 bytes"), ("a/" * 2500, "its path has")):
        refused(dg4d("make", "cat.png", "-o", folder), says)


def test_a_file_name_of_control_characters_is_not_shown_raw() -> None:
    result = dg4d("make", named(b"\x1b[31mred\x07.txt\n") + "gone")
    assert (result.exit_code, "\x1b" in result.output, "\x07" in result.output) == (65, False, False)
    assert r"\x1b[31mred\x07.txt" in result.stderr


def test_a_batch_goes_on_after_every_bad_name_and_row(place: Path) -> None:
    Path("in").mkdir()
    for name in (
        b"caf\xe9.png",
        b"caf\xe8.png",
        f"{LONG}.png".encode(),
        b"summary.json.png",
        b"a\nb\x1b[1m.png",
        b"z.png",
    ):
        (place / "in" / os.fsdecode(name)).touch()  # empty, so that none is made
    result = dg4d("batch", "in", "-o", "out")
    assert result.exit_code == 65, result.output
    summary = json.loads(Path("out/summary.json").read_text())
    told = {item["item"]: item["message"] for item in summary["items"]}
    assert set(told) == {"caf", "caf-png", "caf-png-2", LONG, "summary.json", "ab[1m", "z"} - {"caf"}
    assert "is not UTF-8" in told["caf-png"] and "is not UTF-8" in told["caf-png-2"]
    assert "251 bytes" in told[LONG] and "every batch writes" in told["summary.json"]
    assert "empty" in told["z"] and "empty" in told["ab[1m"]
    assert "\x1b" not in result.output
    assert "\\udce9" in Path("out/index.html").read_text() and "\\udce9" in Path("out/summary.csv").read_text()


def test_a_row_that_breaks_what_nobody_thought_of_fails_alone(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(path: Path) -> None:
        raise ZeroDivisionError(f"oh {path}")

    monkeypatch.setattr("flows.inputs.sources.check_file", broken)
    result = dg4d("batch", ".", "-o", "out")
    assert (result.exit_code, "failed: cat: ZeroDivisionError: oh" in result.output) == (1, True)


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("--seed", "99999999999999999999999"), ("--seed", str(2**63)), ("--fps", "0"), ("--fps", "241"),
        ("--fps", "0.5"), ("--fps", "nan"), ("--fps", "inf"), ("--fps", "-1"),
        ("--height-m", "0"), ("--height-m", "nan"), ("--height-m", "2000"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("command", [("make", "cat.png"), ("batch", ".")])
def test_numbers_out_of_range_are_wrong_usage(command: tuple[str, str], option: str, value: str) -> None:
    result = dg4d(*command, option, value, "-o", "out")
    assert (result.exit_code, option in result.stderr) == (2, True), result.output


@pytest.mark.parametrize(
    "arguments",
    [
        ("render", ".", "-o", "out", "--azimuths=0,nan"), ("render", ".", "-o", "out", "--elevation=nan"),
        ("compose", ".", "-o", "x.glb", "--spacing=nan"), ("batch", ".", "-o", "out", "--price-per-hour=nan"),
        ("watch", ".", "-o", "out", "--rest=nan"),
    ],
)  # fmt: skip
def test_nan_lies_in_no_range(arguments: tuple[str, ...]) -> None:
    assert dg4d(*arguments).exit_code == 2


DEEP = "[" * 5000 + "]" * 5000


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (f"mesh.grid={DEEP}", "nested more than 100 deep"),
        (f"mesh.grid={DEEP[:-1]}", "mesh.grid = "),
        ("mesh.grid=" + "9" * 5000, "5000 digits"),
        ("mesh.max_faces=" + "9" * 40, "out of range"),
        ("pack.fps=NaN", "NaN"), ("pack.fps=1e999", "too large"), ("pack.fps=0.5", "1 to 240"),
        ("text.suffix=\"\\ud800\"", "half a character"), ('mesh={"grid": 3, "grid": 4}', "there twice"),
    ],
)  # fmt: skip
def test_a_setting_that_no_file_can_hold(change: str, says: str) -> None:
    result = dg4d("make", "cat.png", "--set", change, "-o", "out")
    refused(result, says)
    assert len(result.stderr) < 400


@pytest.mark.parametrize(
    "text",
    [
        '{"files": ' + DEEP + "}",
        '{"files": {}, "steps": ' + DEEP + "}",
        DEEP,
        '{"files": {"\\ud800": 1}}',
        '{"files": {}, "beside": 7}',
        '{"files": {}, "steps": [1], "run": 7}',
        '{"files": {"a": 1}, "steps": 7}',
        "NaN",
        "",
        '{"files": {}, "x": ' + "9" * 5000 + "}",
    ],
)
@pytest.mark.parametrize(
    "command",
    [("verify",), ("rebuild",), ("view", "--no-open"), ("score", "--truth", "cat.png"), ("compose", "-o", "x.glb")],
)
def test_a_record_that_is_nested_or_of_another_form(command: tuple[str, ...], text: str) -> None:
    Path("asset").mkdir()
    Path("asset/provenance.json").write_text(text)
    result = dg4d(command[0], "asset", *command[1:])
    assert result.exit_code == 65, result.output
    assert "Traceback" not in result.output and "internal error" not in result.output


@pytest.mark.parametrize(
    "text",
    [
        DEEP,
        '{"items": ' + DEEP + "}",
        '{"items": [{"package": "\\ud800"}]}',
        '{"items": [{"package": "a\\u0000"}]}',
        '{"items": [{"package": "' + LONG * 2 + '"}]}',
    ],
)
def test_a_scene_file_that_no_system_can_hold(text: str) -> None:
    Path("scene.json").write_text(text)
    refused(dg4d("compose", "--scene", "scene.json", "-o", "x.glb"), "")


def test_a_scene_of_another_suffix_is_refused_before_anything_is_loaded() -> None:
    program = (
        "import sys; sys.argv = ['dg4d', 'compose', 'asset', '-o', 'x.foo']\nfrom flows.cli import main\n"
        "try: main()\nexcept SystemExit as end: print(end.code)\n"
        "print([m for m in ('torch', 'numpy', 'prefect', 'steps.compose_scene') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["65", "[]"]
    assert "a scene is written as .glb or .usdz" in done.stderr


def test_a_data_set_with_nothing_in_it() -> None:
    Path("empty/gt").mkdir(parents=True)
    refused(dg4d("bench", "empty", "-o", "out"), "holds no objects")
    refused(dg4d("bench", "nowhere", "-o", "out"), "is not a data set")
    Path("one/thing/input").mkdir(parents=True)
    refused(dg4d("bench", "one", "-o", "out"), "has no input frames")


@pytest.mark.parametrize(
    ("code", "status", "says"),
    [
        (errno.EACCES, 65, "Permission denied: a; choose another path"), (errno.ENAMETOOLONG, 65, "choose another"),
        (errno.ENOSPC, 65, "free some space"), (errno.EROFS, 65, "Read-only file system: a; choose another"),
        (errno.EPIPE, 1, "internal error"),
    ],
)  # fmt: skip
def test_what_the_system_refuses_is_said_in_a_line(
    monkeypatch: pytest.MonkeyPatch, code: int, status: int, says: str
) -> None:
    def refuse(path: Path) -> None:
        raise OSError(code, os.strerror(code), "a")

    monkeypatch.setattr("flows.packages.publish.check_folder_name", refuse)
    refused(dg4d("make", "cat.png", "-o", "out"), says, status)


@pytest.mark.parametrize(
    "record",
    [{}, {"recipe": 7, "run": {"names": 3}}, {"recipe": [], "run": []}, {"recipe": {"seed": 10**23}, "run": {}}],
)
def test_a_record_without_a_recipe_is_not_made_again(record: dict[str, object]) -> None:
    Path("asset").mkdir()
    Path("asset/provenance.json").write_text(json.dumps({"files": {}, **record}))
    refused(dg4d("rebuild", "asset"), "")
