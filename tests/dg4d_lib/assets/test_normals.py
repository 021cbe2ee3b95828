"""Smooth normals."""

import numpy as np
import trimesh

from dg4d_lib.assets.formats.normals import SmoothNormals, normal_groups


def split_sphere() -> tuple[np.ndarray, np.ndarray]:
    """A sphere whose triangles share no vertex, as if every edge were a seam."""
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    vertices = sphere.triangles.reshape(-1, 3).astype(np.float32)
    return vertices, np.arange(len(vertices)).reshape(-1, 3)


def smooth_normals(vertices: np.ndarray, faces: np.ndarray) -> SmoothNormals:
    return SmoothNormals(normal_groups(vertices[None], faces, None), faces)


def test_normals_are_smooth_across_seams() -> None:
    vertices, faces = split_sphere()
    normals = smooth_normals(vertices, faces)(vertices)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    assert (normals * vertices / 0.5).sum(1).min() > 0.995


def test_normals_turn_with_a_turned_body() -> None:
    vertices, faces = split_sphere()
    normals_of = smooth_normals(vertices, faces)
    turn = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], np.float32)
    np.testing.assert_allclose(normals_of(vertices @ turn.T), normals_of(vertices) @ turn.T, atol=1e-6)


def test_copies_along_seams_stay_equal_when_rounding_parts_them() -> None:
    vertices, faces = split_sphere()
    normals_of = smooth_normals(vertices, faces)
    shaken = vertices + np.random.default_rng(0).normal(0, 1e-3, vertices.shape).astype(np.float32)
    places, place_of = np.unique(vertices, axis=0, return_inverse=True)
    first = np.zeros(len(places), int)
    first[place_of.ravel()[::-1]] = np.arange(len(vertices))[::-1]
    normals = normals_of(shaken)
    assert np.array_equal(normals, normals[first[place_of.ravel()]])


def test_a_vertex_without_area_still_has_a_unit_normal() -> None:
    vertices = np.zeros((4, 3), np.float32)
    normals = smooth_normals(vertices, np.array([[0, 1, 2]]))(vertices)
    assert np.array_equal(normals, np.tile((0, 1, 0), (4, 1)))
