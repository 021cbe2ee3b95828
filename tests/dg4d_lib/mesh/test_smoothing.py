"""Smoothing of bumps: they go, the shape and its outline stay."""

import numpy as np
import trimesh

from dg4d_lib.mesh.extraction.smoothing import smooth_bumps

RADIUS, BUMP = 0.5, 0.01


def bumpy_sphere() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a sphere whose vertices lie too far out or in at random, its faces, and its unit normals."""
    mesh = trimesh.creation.icosphere(5, 1.0)
    normals = np.asarray(mesh.vertices)
    radii = RADIUS + BUMP * np.random.default_rng(0).normal(size=(len(normals), 1))
    return (radii * normals).astype(np.float32), mesh.faces.astype(np.int32), normals


def test_bumps_that_face_the_camera_go_and_the_surface_stays() -> None:
    vertices, faces, normals = bumpy_sphere()
    radii = np.linalg.norm(smooth_bumps(vertices, faces, 10), axis=1)
    facing = np.abs(normals[:, 2]) > 0.7
    assert radii[facing].std() < 0.5 * BUMP
    assert abs(radii[facing].mean() - RADIUS) < 0.1 * BUMP


def test_the_outline_of_the_input_view_stays() -> None:
    vertices, faces, _ = bumpy_sphere()
    smooth = smooth_bumps(vertices, faces, 10)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    sideways = np.abs(mesh.vertex_normals[:, 2]) < 0.02
    assert sideways.sum() > 50
    moved = np.linalg.norm(smooth - vertices, axis=1)
    assert moved[sideways].mean() < 0.35 * moved[~sideways].mean()


def test_no_steps_change_nothing() -> None:
    vertices, faces, _ = bumpy_sphere()
    assert np.array_equal(smooth_bumps(vertices, faces, 0), vertices)
