import numpy as np
import pytest
import torch
import trimesh

from dg4d_lib.geometry.normals import vertex_normals
from dg4d_lib.mesh.texturing.bake import fill_texture, locate_texels
from dg4d_lib.mesh.texturing.seams import level_seams, seam_differences, seam_points
from dg4d_lib.mesh.texturing.unwrap import unwrap

SIZE = 64
QUAD = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])


def two_squares(gap: float = 0.2) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Two squares with a common edge that lie apart in the texture."""
    vertices = torch.cat([QUAD, QUAD + torch.tensor([1.0, 0, 0])])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], dtype=torch.int32)
    left = torch.stack([QUAD[:, 0] * 0.4 + 0.05, 0.8 - 0.6 * QUAD[:, 1]], -1)
    return vertices, faces, torch.cat([left, left + torch.tensor([0.4 + gap / 2, 0.0])])


def test_points_on_a_seam_have_both_places() -> None:
    vertices, faces, uvs = two_squares()
    points = seam_points(vertices, faces, uvs, SIZE)
    np.testing.assert_allclose(points[:, 0, 1], points[:, 1, 1], atol=1e-6)
    np.testing.assert_allclose(np.sort(points[0, :, 0]), [0.45, 0.55], atol=1e-6)
    np.testing.assert_allclose(np.abs(points[:, 1, 0] - points[:, 0, 0]), 0.1, atol=1e-6)
    assert len(points) == pytest.approx(2 * 0.6 * SIZE, abs=2)


def test_a_mesh_without_cuts_has_no_seams() -> None:
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32)
    points = seam_points(QUAD, faces, QUAD[:, :2], SIZE)
    assert len(points) == 0
    texture = torch.rand(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(level_seams(texture, points), texture)


def test_leveling_meets_in_the_middle_and_leaves_the_rest() -> None:
    """Two gray squares of different brightness."""
    points = seam_points(*two_squares(), SIZE)
    texture = torch.full((SIZE, SIZE, 3), 0.4)
    texture[:, SIZE // 2 :] = 0.6
    level = level_seams(texture, points)
    assert seam_differences(texture, points).mean() == pytest.approx(0.2)
    assert seam_differences(level, points).max() < 0.01
    on_seam = level[SIZE // 2, int(0.45 * SIZE)]
    torch.testing.assert_close(on_seam, torch.full((3,), 0.5), atol=0.02, rtol=0)
    assert torch.equal(level[:, :8], texture[:, :8])


def test_a_smooth_picture_stays_as_it_is() -> None:
    """A texture that already agrees across the seams is not corrected by more than rounding."""
    mesh = trimesh.creation.icosphere(4)
    faces = torch.from_numpy(mesh.faces.astype(np.int32))
    unwrapped = unwrap(mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32), 256)
    sources, corners, uvs = map(torch.from_numpy, unwrapped)
    rest = torch.from_numpy(mesh.vertices.astype(np.float32))
    normals = vertex_normals(rest, faces)[sources]
    texels = locate_texels(rest[sources], normals, corners, uvs, 256)
    texture = fill_texture(0.5 + 0.3 * texels.positions, texels, 256)
    points = seam_points(rest[sources], corners, uvs, 256)
    level = level_seams(texture, points)
    assert seam_differences(level, points).mean() < 1 / 255
    changed = (level - texture)[texels.rows, texels.columns].abs()
    assert changed.mean() < 2 / 255
