import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from safetensors.numpy import save_file

from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.assets.formats.glb import write_glb
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.ply import write_ply
from dg4d_lib.mesh.textured import TexturedMesh
from steps.artifacts.artifact_diff import TOLERANCE, difference


def picture(path: Path, value: int) -> Path:
    Image.fromarray(np.full((8, 8, 4), value, np.uint8)).save(path)
    return path


def tensors(path: Path, **arrays: NDArray[Any]) -> Path:
    save_file(arrays, path)
    return path


def cloud(path: Path, shift: float, count: int = 20) -> Path:
    generator = torch.Generator().manual_seed(0)
    rows = torch.rand(count, 11, generator=generator)
    means = rows[:, :3].clone()
    means[:, 0] = torch.linspace(-1, 1, count)
    write_ply(
        path,
        Gaussians(
            means + torch.tensor([shift, 0, 0]),
            rows[:, 3:6],
            torch.eye(4)[:1].repeat(count, 1),
            rows[:, 6],
            rows[:, None, 7:10],
        ),
    )
    return path


def glb(path: Path, shift: float, fps: float = 8.0) -> Path:
    vertices = torch.tensor([[0.0, 0, 0], [2, 0, 0], [0, 2, 0]])
    mesh = TexturedMesh(
        vertices, torch.tensor([[0, 1, 2]]), torch.tensor([[0.0, 0], [1, 0], [0, 1]]), torch.full((4, 4, 3), 0.5)
    )
    path.write_bytes(write_glb(Asset4D(mesh, torch.zeros(2, 3, 3) + torch.tensor([0.0, shift])[:, None, None], fps)))
    return path


def test_pictures_differ_by_their_share_of_full_scale(tmp_path: Path) -> None:
    one, two = picture(tmp_path / "1.png", 100), picture(tmp_path / "2.png", 151)
    assert difference(one, one) == 0
    assert difference(one, two) == pytest.approx(51 / 255)
    assert difference(one, picture(tmp_path / "3.png", 101)) < TOLERANCE


def test_numbers_differ_by_their_share_of_what_the_first_spans(tmp_path: Path) -> None:
    values = np.array([0.0, 4.0], np.float32)
    one = tensors(tmp_path / "1.safetensors", a=values, b=np.array([1, 2]))
    assert difference(one, tensors(tmp_path / "2.safetensors", a=values + 1, b=np.array([1, 2]))) == pytest.approx(0.25)


@pytest.mark.parametrize(
    "other",
    [
        {"a": np.zeros(2, np.float32)},
        {"a": np.zeros(3, np.float32), "b": np.array([1, 2])},
        {"a": np.zeros(2, np.float64), "b": np.array([1, 2])},
        {"a": np.zeros(2, np.float32), "b": np.array([1, 3])},
        {"a": np.array([0, np.nan], np.float32), "b": np.array([1, 2])},
        {"a": np.ones(2, np.float32), "b": np.array([1, 2])},
    ],
    ids=["fewer", "shape", "type", "whole numbers", "not a number", "no range"],
)
def test_what_no_number_can_measure_is_infinitely_far(tmp_path: Path, other: dict[str, NDArray[Any]]) -> None:
    one = tensors(tmp_path / "1.safetensors", a=np.zeros(2, np.float32), b=np.array([1, 2]))
    assert difference(one, tensors(tmp_path / "2.safetensors", **other)) == math.inf


def test_clouds_are_compared_column_by_column(tmp_path: Path) -> None:
    one = cloud(tmp_path / "1.ply", 0.0)
    found = difference(one, cloud(tmp_path / "2.ply", 0.2))
    assert found == pytest.approx(0.2 / math.sqrt(3) / 2, rel=1e-4)  # one of three columns, means from -1 to 1
    assert difference(one, cloud(tmp_path / "3.ply", 0.0, count=21)) == math.inf


def test_assets_are_compared_by_their_numbers_and_pictures(tmp_path: Path) -> None:
    one = glb(tmp_path / "1.glb", 1.0)
    assert difference(one, glb(tmp_path / "2.glb", 1.0)) == 0
    near, far = difference(one, glb(tmp_path / "3.glb", 1.001)), difference(one, glb(tmp_path / "4.glb", 1.5))
    assert near is not None and far is not None
    assert 0 < near < TOLERANCE < far
    assert difference(one, glb(tmp_path / "5.glb", 1.0, fps=4.0)) > TOLERANCE


def test_json_is_compared_by_its_broken_numbers_and_else_word_by_word(tmp_path: Path) -> None:
    def write(name: str, tree: object) -> Path:
        (tmp_path / name).write_text(json.dumps(tree))
        return tmp_path / name

    one = write("1.json", {"loss": [0.0, 10.0], "n": 3, "title": "x"})
    assert difference(one, write("2.json", {"title": "x", "n": 3, "loss": [0.01, 10.0]})) < TOLERANCE
    assert difference(one, write("3.json", {"loss": [0.0, 10.0], "n": 4, "title": "x"})) == math.inf
    assert difference(one, write("4.json", {"loss": [0.0, 10.0], "n": 3, "title": "y"})) == math.inf


def zipped(path: Path, **files: Path) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, file in files.items():
            archive.write(file, f"{name}{file.suffix}")
    return path


def test_zips_are_as_far_apart_as_their_farthest_entries(tmp_path: Path) -> None:
    dark, light = picture(tmp_path / "dark.png", 0), picture(tmp_path / "light.png", 51)
    one = zipped(tmp_path / "1.zip", a=dark, b=dark)
    assert difference(one, zipped(tmp_path / "2.zip", a=dark, b=light)) == pytest.approx(0.2 * math.sqrt(1))
    assert difference(one, zipped(tmp_path / "3.zip", a=dark)) == math.inf
    (tmp_path / "x.what").write_text("x")
    (tmp_path / "y.what").write_text("y")
    odd = zipped(tmp_path / "4.zip", a=tmp_path / "x.what")
    assert difference(odd, zipped(tmp_path / "5.zip", a=tmp_path / "y.what")) is None
    assert difference(odd, odd) == 0


def test_a_format_that_nobody_knows_has_no_measure(tmp_path: Path) -> None:
    (tmp_path / "a.what").write_text("a")
    assert difference(tmp_path / "a.what", tmp_path / "a.what") is None


@pytest.mark.parametrize("suffix", [".png", ".webp", ".mp4", ".ply", ".safetensors", ".glb", ".json"])
def test_a_broken_file_is_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"broken{suffix}"
    path.write_bytes(b"\x00broken")
    with pytest.raises(BadInput):
        difference(path, path)
