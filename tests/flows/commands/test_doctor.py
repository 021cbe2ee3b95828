"""`dg4d doctor`."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from flows import cli
from steps.profiles import PROFILES


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "home"))
    monkeypatch.delenv("DG4D_WEIGHTS", raising=False)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setenv("COLUMNS", "80")
    return tmp_path / "home"


def dg4d(*arguments: str) -> Result:
    return CliRunner().invoke(cli.app, ["doctor", *arguments])


def test_the_preview_can_run_here_and_every_line_fits() -> None:
    result = dg4d()
    assert result.exit_code == 0, result.output
    assert "preview: ready" in result.stdout
    for part in ("processor", "memory", "disk", "GPU", "driver", "gsplat kernels", "packages", *PROFILES):
        assert any(line.startswith(part) for line in result.stdout.splitlines()), part
    assert max(map(len, result.stdout.splitlines())) <= 80


def test_a_profile_without_its_weights_is_refused_with_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("steps.runtime.readiness._gpu_problem", lambda shown: "the CUDA driver shows no NVIDIA GPU")
    result = dg4d("--profile", "paper")
    assert result.exit_code == 69
    lines = result.stdout.splitlines()
    assert "paper: missing" in lines
    assert "  lacks weights svd" in lines
    assert any(line.endswith("dg4d weights pull paper") for line in lines)
    assert lines[-1] == "  Without a GPU its networks run on the CPU, which takes days."
    assert "for days" not in dg4d().stdout


def test_an_unknown_profile_is_bad_input() -> None:
    result = dg4d("--profile", "papr")
    assert result.exit_code == 65
    assert "unknown profile 'papr'" in result.stderr


def test_the_same_facts_are_told_to_programs() -> None:
    result = dg4d("--profile", "reference", "--json")
    facts = json.loads(result.stdout)
    assert result.exit_code == 69
    assert (facts["profile"], facts["state"]) == ("reference", "missing")
    assert list(facts["profiles"]) == list(PROFILES)
    assert facts["profiles"]["preview"]["state"] == "ready"
    needed = {one["name"]: one["state"] for one in facts["profiles"]["reference"]["weights"]}
    assert needed == dict.fromkeys(("svd", "stable-zero123", "lgm", "imagedream"), "missing")
    assert facts["machine"]["packages"]["torch"]


def test_the_answer_comes_without_torch() -> None:
    program = (
        "import sys; sys.argv = ['dg4d', 'doctor']\nfrom flows.cli import main\n"
        "try: main()\nexcept SystemExit: pass\n"
        "print([m for m in ('torch', 'numpy', 'prefect', 'diffusers', 'gsplat') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
