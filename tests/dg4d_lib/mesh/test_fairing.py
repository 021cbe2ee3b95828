"""Fairing: bumps go as their wavelength says, thin parts and the outline of the input view stay."""

import numpy as np
import pytest
import torch
import trimesh

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.mesh.extraction.density import DensityField
from dg4d_lib.mesh.fairing import LowPass, bump_filter, fair, strength_of, thickness
from dg4d_lib.mesh.folds import DefectFinder
from dg4d_lib.mesh.neighbors import edge_graph
from dg4d_lib.mesh.tracking.isosurface_projection import steps_to_isosurface
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh

RADIUS, BUMP = 0.5, 0.01
TRIANGLE = np.array([[1.0, 0.0], [0.5, 3**0.5 / 2]])  # edges of a triangle of edge length 1


def sphere(bump: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return a sphere with bumps of some height, which are 0.12 apart, and its faces."""
    mesh = trimesh.creation.icosphere(5, RADIUS)
    places = np.asarray(mesh.vertices)
    heights = bump * np.prod(np.sin(2 * np.pi * places / 0.12), 1, keepdims=True)
    return (places * (1 + heights / RADIUS)).astype(np.float32), mesh.faces.astype(np.int32)


def even_plane(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a parallelogram of equilateral triangles of edge length 1."""
    u, v = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    corner = (u * side + v)[:-1, :-1].ravel()
    faces = [[corner, corner + side, corner + 1], [corner + side, corner + side + 1, corner + 1]]
    points = np.concatenate([np.stack([u, v], -1).reshape(-1, 2) @ TRIANGLE, np.zeros((side**2, 1))], 1)
    return points, np.concatenate([np.stack(triangle, 1) for triangle in faces]).astype(np.int32)


@pytest.mark.parametrize("ratio", [0.5, 1.0, 2.0])
def test_waves_lose_what_their_length_says(ratio: float) -> None:
    wavelength = 16.0
    points, faces = even_plane(160)
    smooth = LowPass(edge_graph(faces, len(points)), strength_of(np.full(len(points), wavelength), points, faces))
    wave = np.sin(2 * np.pi * points[:, 0] / (ratio * wavelength))
    inside = (np.abs(points[:, 0] - 120) < 40) & (np.abs(points[:, 1] - 70) < 30)
    left = (smooth(wave) @ (wave * inside)) / (wave @ (wave * inside))
    assert left == pytest.approx(1 / (1 + ratio**-4), abs=0.05)


def test_bumps_go_and_the_surface_stays() -> None:
    vertices, faces = sphere(BUMP)
    radii = np.linalg.norm(fair(vertices, faces, 0.25), axis=1)
    assert radii.std() < 0.4 * np.linalg.norm(vertices, axis=1).std()  # the outline keeps its bumps
    assert radii.mean() == pytest.approx(RADIUS, abs=0.05 * BUMP)


def test_the_outline_of_the_input_view_stays() -> None:
    vertices, faces = sphere(3 * BUMP)

    def mask_of(shown: np.ndarray) -> torch.Tensor:
        camera = OrbitCamera(width=256, height=256)
        return rasterize_mesh(torch.from_numpy(shown), torch.from_numpy(faces), [camera]).faces[0] >= 0

    bumpy, smooth, even = (mask_of(shown) for shown in (vertices, fair(vertices, faces, 0.25), sphere()[0]))
    assert (bumpy ^ smooth).sum() < 0.4 * (bumpy ^ even).sum()


def test_no_wavelength_changes_nothing() -> None:
    vertices, faces = sphere(BUMP)
    assert np.array_equal(fair(vertices, faces, 0), vertices)


def test_thickness_is_the_distance_of_opposite_sides() -> None:
    mesh = trimesh.creation.box((0.6, 0.4, 0.1)).subdivide_to_size(0.03)
    found = thickness(np.asarray(mesh.vertices), np.asarray(mesh.faces), 0.2)
    inner = (np.abs(mesh.vertices[:, :2]) < (0.22, 0.12)).all(1)
    assert found[inner] == pytest.approx(0.1, abs=0.01)
    assert found.max() == 0.2


def test_thin_limbs_keep_their_thickness() -> None:
    limb = trimesh.creation.capsule(0.5, 0.04, count=(24, 24)).subdivide_to_size(0.02)
    limb.merge_vertices()
    smooth = fair(np.asarray(limb.vertices, np.float32), np.asarray(limb.faces, np.int32), 0.25)
    assert trimesh.Trimesh(smooth, limb.faces).volume == pytest.approx(limb.volume, rel=0.15)


def test_no_new_defects_on_thin_parts() -> None:
    """A bumpy disk whose two sides the filter alone would fold in more places."""
    vertices, faces = sphere()
    x, y, z = vertices.T
    disk = (1 + 0.05 * np.sin(20 * x) * np.sin(17 * y + 1))[:, None] * np.stack([x, y, 0.02 * z], 1)
    defective = DefectFinder(faces).defective
    faired = fair(disk.astype(np.float32), faces, 0.25)
    assert not (defective(faired) & ~defective(disk.astype(np.float32))).any()
    assert (np.abs(faired - disk).max(1) > 1e-6).mean() > 0.5


def test_steps_to_a_bumpy_isosurface_have_no_bumps() -> None:
    """A sphere that is projected onto a bumpy density follows its size alone."""
    axis = np.linspace(-0.8, 0.8, 65)
    places = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    distance = np.linalg.norm(places, axis=-1)
    waves = BUMP * np.prod(np.sin(2 * np.pi * places / 0.12), -1)
    field = DensityField(
        torch.from_numpy(1 + 10 * (RADIUS - 0.02 + waves - distance)).float(),
        torch.full((3,), -0.8),
        float(axis[1] - axis[0]),
        1.0,
    )
    mesh = trimesh.creation.icosphere(5, RADIUS)
    vertices, normals = np.asarray(mesh.vertices), np.asarray(mesh.vertices) / RADIUS
    steps = steps_to_isosurface(field, vertices, normals, 1.0)
    smooth = bump_filter(vertices, mesh.faces, 0.25)(steps)
    assert smooth.mean() == pytest.approx(-0.02, abs=0.002)
    assert smooth.std() < 0.3 * steps.std()
