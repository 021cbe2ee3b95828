"""Wheel and source distribution, built with the project's own backend."""

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
INSTALLED = ("dg4d", "dg4d_lib", "flows", "steps")  # names at top level; DECISIONS.md has the reason
BUILD = "import sys, setuptools.build_meta as backend; getattr(backend, sys.argv[1])(sys.argv[2])"


def build(tree: Path, hook: str, out: Path) -> tuple[Path, str]:
    """Call a hook of the build backend in a tree; return what it wrote and said."""
    out.mkdir(exist_ok=True)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    done = subprocess.run(
        [sys.executable, "-W", "error::DeprecationWarning", "-c", BUILD, hook, str(out)],
        cwd=tree, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    (written,) = out.iterdir()
    return written, done.stdout + done.stderr


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, str]]:
    """The source distribution of a copy of the tree, and the wheel of the unpacked source distribution."""
    place = tmp_path_factory.mktemp("build")
    tree = place / "tree"
    for name in (*INSTALLED, "deploy"):
        shutil.copytree(ROOT / name, tree / name, ignore=shutil.ignore_patterns("__pycache__", "node_modules"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copyfile(ROOT / name, tree / name)
    sdist = build(tree, "build_sdist", place / "sdist")
    with tarfile.open(sdist[0]) as archive:
        archive.extractall(place / "unpacked", filter="data")
    (unpacked,) = (place / "unpacked").iterdir()
    return {"sdist": sdist, "wheel": build(unpacked, "build_wheel", place / "wheel")}


@pytest.mark.parametrize("kind", ["sdist", "wheel"])
def test_distributions_are_built_without_warnings(built: dict[str, tuple[Path, str]], kind: str) -> None:
    lines = [line for line in built[kind][1].splitlines() if "warn" in line.lower() or "deprecat" in line.lower()]
    assert not [line for line in lines if "manifest_maker" not in line], lines


def test_the_wheel_has_every_module_and_data_file_and_no_other_name(built: dict[str, tuple[Path, str]]) -> None:
    with zipfile.ZipFile(built["wheel"][0]) as archive:
        names = set(archive.namelist())
    top = {name.split("/")[0] for name in names if ".data/" not in name and ".dist-info/" not in name}
    assert top == set(INSTALLED)
    modules = {
        path.relative_to(ROOT).as_posix()
        for package in INSTALLED
        for path in (ROOT / package).rglob("*.py")
        if "viewer/" not in path.relative_to(ROOT).as_posix()
    }
    assert modules <= names
    data = ("dg4d/py.typed", "dg4d_lib/assets/viewer/page.html", "flows/serving/login.html")
    assert not [name for name in (*data, "flows/packages/templates/report.html") if name not in names]
    assert any(name.endswith("share/dg4d/pools.yaml") for name in names)
    weights = ROOT / "dg4d_lib/shape_prior/weights.safetensors"
    assert not weights.exists() or "dg4d_lib/shape_prior/weights.safetensors" in names


def test_the_wheel_alone_is_the_api(built: dict[str, tuple[Path, str]], tmp_path: Path) -> None:
    """Unpacked, away from the tree, it imports, and refuses a foreign package that hides one of its own."""
    with zipfile.ZipFile(built["wheel"][0]) as archive:
        archive.extractall(tmp_path / "site")
    (tmp_path / "steps.py").write_text("")
    program = "import sys; sys.path[:0] = sys.argv[1:]; import dg4d; print(dg4d.make.__module__, dg4d.__file__)"

    def run(*places: Path) -> "subprocess.CompletedProcess[str]":
        command = [sys.executable, "-P", "-c", program, *map(str, places)]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)

    alone = run(tmp_path / "site")
    assert alone.stdout.split() == ["dg4d.making", str(tmp_path / "site" / "dg4d" / "__init__.py")], alone.stderr
    hidden = run(tmp_path, tmp_path / "site")
    assert hidden.returncode != 0
    assert f"ImportError: {tmp_path / 'steps.py'} hides the package 'steps' of dg4d" in hidden.stderr
