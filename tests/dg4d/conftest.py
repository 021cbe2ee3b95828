"""A small package for the API, and fake steps that need no server."""

import sys
from pathlib import Path

import pytest
from recording import add_record

sys.path.insert(0, str(Path(__file__).parents[1] / "flows"))  # fake steps, and helpers of those tests


@pytest.fixture(scope="session")
def gem(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A package of nine Gaussians and a gem that slide along x for three frames, with a record."""
    from tests.steps.small_package import packed

    folder = packed(tmp_path_factory.mktemp("gem"))
    add_record(folder)
    return folder


@pytest.fixture
def alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Fake steps in this process under a home of their own; the log of the steps."""
    values = {"HOME": "home", "CATALOG": "fake_steps:STEPS", "CODE_VERSION": "test", "EXECUTOR": "in_process"}
    for name, value in values.items():
        monkeypatch.setenv(f"DG4D_{name}", str(tmp_path / value) if name == "HOME" else value)
    monkeypatch.setenv("FAKE_LOG", str(tmp_path / "ran"))
    monkeypatch.chdir(tmp_path)
    return tmp_path / "ran"
