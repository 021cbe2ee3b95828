import errno
import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from fake_steps import picture
from typer.testing import CliRunner, Result

from flows import cli
from steps import store as store_module


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

    monkeypatch.setattr("flows.commands.make.connect", no_server)
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


def test_a_folder_instead_of_a_file() -> None:
    Path("pets").mkdir()
    refused(dg4d("make", "pets", "-o", "out"), "dg4d batch pets")


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
    refused(dg4d("make", "cat.png", "--video", "run.mp4", "-o", "out"), "run.mp4 does not exist")
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
        ("motion.iterations", "knob=value"),
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
    Path("bank/bank.json").write_text('{"views": [{"file": "a.png"}]}')
    Path("bank/a.png").write_text(picture("a view"))
    refused(dg4d("make", "cat.png", "--bank", "bank", "-o", "out"), "prior.kind=oracle")
    refused(dg4d("make", "cat.png", "--set", "prior.kind=oracle", "-o", "out"), "--bank DIR")


def test_a_pick_where_a_video_is_followed() -> None:
    refused(dg4d("make", "cat.png", "--video", "cat.png", "--pick", "2", "-o", "out"), "--pick")


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
