"""Animations that models have, as videos and truths for `--asset`."""

from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.own_animation import AZIMUTHS, SPAN, played, read_mesh, read_rigged
from dg4d_lib.asset_settings import AssetSettings
from dg4d_lib.assets.formats.gltf import INDEX_DATA, VERTEX_DATA, GltfDocument
from dg4d_lib.errors import BadInput

CORNERS = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)], np.float32)
HALF_TURN = [0.0, 0.0, 1.0, 0.0]  # about z, xyzw


@pytest.fixture
def moving(tmp_path: Path) -> Path:
    """Write a triangle that moves by 3 to the right in 3 s, "slide", or is turned about its first corner, "turn"."""
    document = GltfDocument({})
    attributes = {"POSITION": document.add_accessor("p", CORNERS, VERTEX_DATA)}
    indices = document.add_accessor("i", np.arange(3, dtype="<u2"), INDEX_DATA)
    mesh = document.add("meshes", name="triangle", primitives=[{"attributes": attributes, "indices": indices}])
    node = document.add("nodes", name="triangle", mesh=mesh)
    document.tree["scene"] = document.add("scenes", nodes=[node])
    times = document.add_accessor("t", np.array([0.0, 3.0], np.float32))
    slide = document.add_accessor("s", np.array([(0, 0, 0), (3, 0, 0)], np.float32))
    tangents = np.zeros(4, np.float32)
    turns = np.stack([tangents, [0, 0, 0, 1], tangents, tangents, HALF_TURN, tangents]).astype(np.float32)
    for name, path, output, interpolation in (
        ("slide", "translation", slide, "LINEAR"),
        ("turn", "rotation", document.add_accessor("r", turns), "CUBICSPLINE"),
    ):
        sampler = {"input": times, "output": output, "interpolation": interpolation}
        channel = {"sampler": 0, "target": {"node": node, "path": path}}
        document.add("animations", name=name, samplers=[sampler], channels=[channel])
    path = tmp_path / "moving.glb"
    path.write_bytes(document.to_bytes())
    return path


@pytest.mark.parametrize("animation", ["slide", "0"])
def test_a_translation_is_played_at_even_steps(moving: Path, animation: str) -> None:
    moved = played(read_mesh(moving, AssetSettings(max_faces=100)), animation, 3)
    np.testing.assert_allclose(moved[:, 0, 0], [0, 1, 2], atol=1e-6)


def test_rotations_are_played_between_their_keys(moving: Path) -> None:
    moved = played(read_mesh(moving, AssetSettings(max_faces=100)), "turn", 2)
    np.testing.assert_allclose(moved[1], [(0, 0, 0), (0, 1, 0), (-1, 0, 0)], atol=1e-6)


def test_unknown_animations_are_refused_with_those_that_there_are(moving: Path) -> None:
    with pytest.raises(BadInput, match="'run'; given are slide, turn"):
        played(read_mesh(moving, AssetSettings(max_faces=100)), "run", 2)


def test_the_video_fills_the_frame_and_views_are_of_other_sides(moving: Path) -> None:
    own, rest = read_rigged(moving, "slide", 2, 0.0)
    np.testing.assert_array_equal(rest.model.vertices, CORNERS)
    covered = torch.nonzero((own.subject.footage[..., 3] > 0.5).any(0))[:, 1]
    width = float(covered.max() - covered.min() + 1) / own.subject.footage.shape[2]
    assert width == pytest.approx(SPAN, abs=0.02)
    assert tuple(own.subject.views) == AZIMUTHS
    torch.testing.assert_close(own.vertices[1] - own.vertices[0], (own.vertices[1] - own.vertices[0])[:1].expand(3, 3))
