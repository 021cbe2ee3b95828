"""Whole conversions of the demo and of two moving objects: how sound their meshes are, at rest and in every frame."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.meshes import measure
from benchmarks.objects.specimens import render_specimen
from steps.artifacts.media import write_png

pytestmark = pytest.mark.slow  # a minute or two each

DEMO = Path(__file__).parents[2] / "examples/newt.png"
FRAMES = 8
FLIPPED = {"demo": 0.0, "parrot": 0.05, "excavator": 0.05}  # percent of the triangles in the worst frame, at most


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    environment = {**os.environ, "DG4D_HOME": str(tmp_path_factory.mktemp("home"))}
    yield environment
    subprocess.run([sys.executable, "-m", "flows.cli", "down"], env=environment, check=False, capture_output=True)


@pytest.mark.parametrize("name", FLIPPED)
def test_meshes_stay_within_the_limits(home: dict[str, str], tmp_path: Path, name: str) -> None:
    words = [str(DEMO)]
    if name != "demo":
        footage = tmp_path / "footage"
        footage.mkdir()
        for frame, picture in enumerate(render_specimen(name, FRAMES, 256).cutouts):
            write_png(footage / f"{frame:03d}.png", picture)
        words = [str(footage / "000.png"), "--video", str(footage)]
    made = subprocess.run(
        [sys.executable, "-m", "flows.cli", "make", *words, "-o", str(tmp_path / "out")],
        env=home, capture_output=True, text=True, timeout=1200, check=False,
    )  # fmt: skip
    assert (tmp_path / "out/asset.json").is_file(), made.stderr
    rows = {row.moment: row for row in measure(tmp_path / "out")}
    assert rows["mean"].crossing < 0.1 and rows["mean"].folds < 0.1
    assert rows["worst"].flipped <= FLIPPED[name]
    assert rows["worst"].crossing < 0.2 and rows["worst"].genus <= 1
