"""Topology checks on meshes with known defects."""

import numpy as np
import pytest
import trimesh

from dg4d_lib.mesh.extraction.topology import MeshTopology, check_topology, orient_outward, weld_vertices

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)


def facts(faces: np.ndarray, vertices: np.ndarray = CORNERS) -> MeshTopology:
    return check_topology(vertices, faces)


def test_a_solid_has_no_flaws() -> None:
    its = facts(TETRAHEDRON)
    assert its == MeshTopology(4, 1, 0, 0, 0, 0, 0)
    assert its.valid
    assert str(its) == "watertight, 1 component, 0 inverted"


def test_a_hole_has_a_rim() -> None:
    its = facts(TETRAHEDRON[:3])
    assert (its.boundary_edges, its.watertight, its.inverted_components) == (3, False, 0)
    assert str(its) == "open, 3 boundary edges, 1 component, 0 inverted"


def test_a_solid_turned_inside_out_is_inverted_wherever_it_lies() -> None:
    for place in (0.0, 50.0):
        assert facts(TETRAHEDRON[:, ::-1], CORNERS + place).inverted_components == 1
        assert facts(TETRAHEDRON, CORNERS + place).inverted_components == 0


def test_one_triangle_turned_over_disagrees_with_its_three_neighbors() -> None:
    faces = TETRAHEDRON.copy()
    faces[2] = faces[2, ::-1]
    its = facts(faces)
    assert (its.inconsistent_edges, its.watertight) == (3, False)
    assert "bounds no solid, 1 component, 0 inverted, 3 inconsistently oriented edges" in str(its)


def test_a_wall_inside_crowds_the_edges_it_hangs_on() -> None:
    inner = np.append(TETRAHEDRON, [[0, 1, 4], [1, 2, 4], [2, 0, 4]], 0).astype(np.int32)
    its = facts(inner, np.append(CORNERS, [[0.2, 0.2, 0.2]], 0).astype(np.float32))
    assert (its.nonmanifold_edges, its.boundary_edges) == (3, 0)


def test_a_needle_and_a_doubled_corner_are_flat() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [2, 1e-9, 0], [0, 1, 0]], np.float32)
    assert facts(np.array([[0, 1, 2], [0, 0, 3], [0, 1, 3]], np.int32), vertices).degenerate_faces == 2


def test_small_triangles_are_not_flat() -> None:
    assert facts(TETRAHEDRON, 1e-4 * CORNERS).degenerate_faces == 0


def test_pieces_are_told_apart_and_only_the_inverted_ones_are_turned() -> None:
    vertices = np.concatenate([CORNERS, CORNERS + 3])
    faces = np.concatenate([TETRAHEDRON, TETRAHEDRON[:, ::-1] + 4])
    its = facts(faces, vertices)
    assert (its.components, its.inverted_components) == (2, 1)
    turned = orient_outward(vertices, faces)
    assert check_topology(vertices, turned).valid
    np.testing.assert_array_equal(turned[:4], TETRAHEDRON)


def test_it_agrees_with_trimesh(sphere: tuple[np.ndarray, np.ndarray]) -> None:
    mesh = trimesh.Trimesh(*sphere, process=False)
    its = check_topology(*sphere)
    assert its.watertight == mesh.is_watertight
    assert its.components == mesh.body_count
    holed = trimesh.Trimesh(sphere[0], sphere[1][7:], process=False)
    open_edges = trimesh.grouping.group_rows(holed.edges_sorted, require_count=1)
    assert check_topology(sphere[0], sphere[1][7:]).boundary_edges == len(open_edges)


def test_welding_undoes_the_split_along_seams() -> None:
    vertices, faces = CORNERS[TETRAHEDRON].reshape(-1, 3), np.arange(12, dtype=np.int32).reshape(4, 3)
    assert check_topology(vertices, faces).components == 4
    assert check_topology(*weld_vertices(vertices, faces)).valid


@pytest.mark.parametrize("count", [0, 1])
def test_hardly_a_mesh_is_counted_too(count: int) -> None:
    its = facts(TETRAHEDRON[:count])
    assert (its.triangles, its.boundary_edges, its.components) == (count, 3 * count, count)
