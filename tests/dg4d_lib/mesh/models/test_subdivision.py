"""Subdivision: no cracks, no lost area, short edges, and true barycentric coordinates."""

import numpy as np
import pytest

from dg4d_lib.mesh.extraction.topology import check_topology
from dg4d_lib.mesh.models.subdivision import subdivide

TETRAHEDRON = np.array([(0, 0, 0), (3, 0, 0), (0, 2, 0), (0, 0, 1)], float)
FACES = np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])


@pytest.fixture(scope="module")
def fine():
    return subdivide(TETRAHEDRON, FACES, 0.4, 10_000)


def areas(vertices, faces):
    corners = vertices[faces]
    return np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2


def test_edges_are_short(fine):
    sides = fine.vertices[fine.faces] - fine.vertices[np.roll(fine.faces, -1, 1)]
    assert np.linalg.norm(sides, axis=-1).max() <= 0.4


def test_a_solid_stays_a_solid_of_the_same_orientation(fine):
    assert check_topology(fine.vertices, fine.faces).valid


def test_every_face_keeps_its_area(fine):
    split = np.bincount(fine.sources, areas(fine.vertices, fine.faces))
    np.testing.assert_allclose(split, areas(TETRAHEDRON, FACES), rtol=1e-12)


def test_barycentric_coordinates_lead_to_the_corners(fine):
    corners = np.einsum("fkc,fcd->fkd", fine.barycentrics, TETRAHEDRON[FACES[fine.sources]])
    np.testing.assert_allclose(corners, fine.vertices[fine.faces], atol=1e-12)


def test_original_vertices_come_first(fine):
    np.testing.assert_array_equal(fine.vertices[:4], TETRAHEDRON)


def test_the_number_of_vertices_is_bounded():
    assert len(subdivide(TETRAHEDRON, FACES, 1e-3, 500).vertices) <= 500
