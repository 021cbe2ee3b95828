"""Levels of detail: fewer triangles of the same surface, texture and motion."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.mesh.extraction.simplify import simplify_mesh
from dg4d_lib.mesh.extraction.topology import check_topology, weld_vertices
from dg4d_lib.mesh.render import render_mesh
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh.texturing.unwrap import unwrap

pytest.importorskip("meshoptimizer", reason="meshoptimizer is not installed: make clients")


@pytest.fixture(scope="module")
def ball() -> TexturedMesh:
    """A sphere, unwrapped and so cut by seams; its texture is a smooth picture over the atlas."""
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    vertices = sphere.vertices.astype(np.float32)
    copied, corners, uvs = unwrap(vertices, sphere.faces.astype(np.int32), 128)
    line = torch.linspace(0, 1, 128)
    texture = torch.stack(torch.meshgrid(line, line, torch.tensor([0.5]), indexing="ij"), -1)[:, :, 0]
    return TexturedMesh(torch.from_numpy(vertices)[copied], torch.from_numpy(corners), torch.from_numpy(uvs), texture)


def bent(mesh: TexturedMesh, times: int = 5) -> Tensor:
    """Offsets that bend it more and more about the x axis."""
    angles = torch.linspace(0, 1.5, times)[:, None] * mesh.vertices[:, 1]
    y, z = mesh.vertices[:, 1], mesh.vertices[:, 2]
    moved = torch.stack([0 * angles, angles.cos() * y - angles.sin() * z - y, angles.sin() * y + angles.cos() * z - z])
    return moved.movedim(0, -1)


def pictures(mesh: TexturedMesh, offsets: Tensor) -> Tensor:
    cameras = [OrbitCamera(10, 90.0 * side, width=96, height=96) for side in range(len(offsets))]
    color, alpha = render_mesh(mesh, cameras, offsets)
    return color * alpha + 1 - alpha


@pytest.mark.parametrize("share", [0.5, 0.25, 0.1])
def test_there_are_as_many_triangles_as_asked_for(ball: TexturedMesh, share: float) -> None:
    wanted = int(share * len(ball.faces))
    small, offsets = simplify_mesh(ball, bent(ball), wanted)
    assert 0.97 * wanted < len(small.faces) <= wanted
    assert offsets.shape == (5, len(small.vertices), 3)


def test_what_is_left_is_part_of_what_was(ball: TexturedMesh) -> None:
    """Place, texture coordinates and offsets of a vertex stay together."""
    before = bent(ball)
    small, offsets = simplify_mesh(ball, before, 400)
    old = torch.cat([ball.vertices, ball.uvs, before.movedim(0, 1).flatten(1)], 1)
    new = torch.cat([small.vertices, small.uvs, offsets.movedim(0, 1).flatten(1)], 1)
    rows = {row.numpy().tobytes() for row in old}
    assert all(row.numpy().tobytes() in rows for row in new)
    assert torch.equal(small.texture, ball.texture)


def test_what_is_left_keeps_its_smoothing_groups(ball: TexturedMesh) -> None:
    grouped = replace(ball, smoothing_groups=torch.arange(len(ball.vertices)))
    small, _ = simplify_mesh(grouped, bent(ball), 400)
    assert small.smoothing_groups is not None
    assert torch.equal(ball.vertices[small.smoothing_groups], small.vertices)


def test_the_surface_stays_closed_along_the_seams(ball: TexturedMesh) -> None:
    small, _ = simplify_mesh(ball, bent(ball), 600)
    vertices, faces = weld_vertices(small.vertices.numpy(), small.faces.numpy())
    assert len(vertices) < len(small.vertices)  # there are seams
    facts = check_topology(vertices, faces)
    assert (facts.boundary_edges, facts.degenerate_faces, facts.inverted_components, facts.components) == (0, 0, 0, 1)


def test_a_quarter_of_the_triangles_look_the_same(ball: TexturedMesh) -> None:
    before = bent(ball)
    small, offsets = simplify_mesh(ball, before, len(ball.faces) // 4)
    error = (pictures(small, offsets) - pictures(ball, before)).square().mean()
    assert -10 * torch.log10(error) > 30


def test_what_moves_by_itself_is_kept_though_it_is_flat_at_rest() -> None:
    """A square sheet that folds: triangles stay where the fold will be, and the flat halves lose theirs."""
    line = torch.linspace(-1, 1, 33)
    places = torch.stack(torch.meshgrid(line, line, torch.zeros(1), indexing="ij"), -1).reshape(-1, 3)
    corner = (torch.arange(32)[:, None] * 33 + torch.arange(32)).flatten()
    faces = torch.cat(
        [torch.stack([corner, corner + 33, corner + 34], 1), torch.stack([corner, corner + 34, corner + 1], 1)]
    )
    sheet = TexturedMesh(places, faces, places[:, :2] / 2 + 0.5, torch.ones(4, 4, 3))
    fold = torch.zeros(2, len(places), 3)
    fold[1, :, 2] = (places[:, 0] - 0.25).clamp(min=0)  # the crease lies at x = 0.25
    small, offsets = simplify_mesh(sheet, fold, 8)
    expected = (small.vertices[:, 0] - 0.25).clamp(min=0)
    torch.testing.assert_close(offsets[1, :, 2], expected)
    crossing = small.vertices[small.faces][..., 0]
    assert not ((crossing.amin(1) < 0.2) & (crossing.amax(1) > 0.3)).any()
    still, _ = simplify_mesh(sheet, torch.zeros(1, len(places), 3), 8)
    crossing = still.vertices[still.faces][..., 0]
    assert ((crossing.amin(1) < 0.2) & (crossing.amax(1) > 0.3)).any()


def test_equal_meshes_give_equal_levels(ball: TexturedMesh) -> None:
    first, second = (simplify_mesh(ball, bent(ball), 500) for _ in range(2))
    assert torch.equal(first[0].faces, second[0].faces)
    assert torch.equal(first[1], second[1])


def test_a_mesh_that_is_small_enough_stays_as_it_is(ball: TexturedMesh) -> None:
    offsets = bent(ball)
    same, ways = simplify_mesh(ball, offsets, len(ball.faces))
    assert same is ball
    assert ways is offsets


def test_more_than_seams_allow_is_not_a_failure(ball: TexturedMesh) -> None:
    small, _ = simplify_mesh(ball, bent(ball), 1)
    assert 1 <= len(small.faces) < 500


def test_without_the_library_it_says_what_to_install(ball: TexturedMesh, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "meshoptimizer", None)
    with pytest.raises(BackendUnavailable, match=r"deploy/install.sh meshopt"):
        simplify_mesh(ball, bent(ball), 500)


def test_bad_numbers_are_refused(ball: TexturedMesh) -> None:
    with pytest.raises(BadInput, match="at least 1 triangle"):
        simplify_mesh(ball, bent(ball), 0)
    broken = replace(ball, vertices=ball.vertices / 0)
    with pytest.raises(BadInput, match="not finite"):
        simplify_mesh(broken, bent(ball), 100)
