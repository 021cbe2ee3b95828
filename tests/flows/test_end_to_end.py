"""The command with the real steps and small numbers: a picture becomes a package, then nothing is left to do."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

from dg4d_lib.assets.formats.glb import read_glb
from dg4d_lib.gaussians.ply import read_ply
from steps.artifacts.media import read_png, write_png

pytestmark = pytest.mark.slow

TINY = {
    "subject.size": 64,
    "driving.frames": 3,
    "static.iterations": 4,
    "static.views": 1,
    "static.start.points": 400,
    "static.reference_size": 48,
    "static.resolution_schedule": '[{"until": 1.0, "size": 48}]',
    "motion.iterations": 3,
    "motion.reference_size": 48,
    "motion.resolution_schedule": '[{"until": 1.0, "size": 48}]',
    "mesh.grid": 32,
    "mesh.edge_length": 0.06,
    "mesh.texture_size": 128,
    "mesh.render_size": 96,
    "pack.preview_size": 64,
    "pack.preview_turns": 1,
    "pack.sheet_size": 48,
    "pack.sheet_frames": 2,
}
Command = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def dg4d(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Command]:
    place = tmp_path_factory.mktemp("home")
    environment = {**os.environ, "DG4D_HOME": str(place)}

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "flows.cli", *words],
            env=environment,
            cwd=place,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )

    yield run
    run("down")


@pytest.fixture(scope="module")
def egg(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rows, columns = torch.meshgrid(torch.linspace(-1, 1, 96), torch.linspace(-1, 1, 96), indexing="ij")
    inside = ((rows / 0.7) ** 2 + (columns / 0.5) ** 2 < 1).float()
    path = tmp_path_factory.mktemp("pictures") / "egg.png"
    write_png(path, torch.stack([inside * (rows + 1) / 2, inside * 0.4, inside * (columns + 1) / 2, inside], -1))
    return path


def knobs() -> list[str]:
    return [word for key, value in TINY.items() for word in ("--set", f"{key}={value}")]


def test_a_picture_becomes_a_package_and_a_second_run_does_nothing(dg4d: Command, egg: Path, tmp_path: Path) -> None:
    out = tmp_path / "egg"
    first = dg4d("make", str(egg), *knobs(), "-o", str(out))
    assert first.returncode == 0, first.stderr
    asset = read_glb((out / "asset.glb").read_bytes())
    assert asset.offsets.shape[0] == 3
    assert torch.isfinite(asset.offsets).all()
    assert asset.mesh.vertices[:, 1].abs().max() > asset.mesh.vertices[:, 0].abs().max()  # an egg stands
    assert [len(read_ply(path)) > 100 for path in sorted((out / "splats").glob("*.ply"))] == [True] * 3
    assert read_png(out / "contact_sheet.png").std() > 0.05
    assert (out / "preview.mp4").stat().st_size > 1000
    report = json.loads((out / "report.json").read_text())
    assert "shape network trained on synthetic shapes" in json.dumps(report)
    records = json.loads((out / "provenance.json").read_text())
    for step in ("prepare_subject", "drive_video", "fit_gaussians", "fit_motion", "extract_mesh", "pack_asset"):
        assert step in json.dumps(records)

    again = dg4d("make", str(egg), *knobs(), "-o", str(out))
    assert again.returncode == 0
    assert "nothing to do" in again.stdout

    views = dg4d("render", str(out), "--azimuths=0,90", "--size", "48", "--mesh", "-o", str(tmp_path / "views"))
    assert views.returncode == 0, views.stderr
    pictures = [read_png(tmp_path / "views" / f"view_{azimuth}" / "001.png") for azimuth in (0, 90)]
    assert all(picture.shape == (48, 48, 4) and 0.1 < picture[..., 3].mean() < 0.7 for picture in pictures)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("text.png", b"hello, I am text", "text.png"),
        ("transparent.png", None, "transparent"),
    ],
)
def test_bad_input_is_one_message_and_leaves_nothing(
    dg4d: Command, tmp_path: Path, name: str, content: bytes | None, says: str
) -> None:
    path = tmp_path / name
    if content is None:
        write_png(path, torch.zeros(64, 64, 4))
    else:
        path.write_bytes(content)
    done = dg4d("make", str(path), "-o", str(tmp_path / "out"))
    assert done.returncode == 65
    assert says in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()
