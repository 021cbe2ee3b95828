import numpy as np
import pytest
import trimesh

from dg4d_lib.mesh.texturing.flatten import _injective, _local_frames, _to_circles, flat_areas, flatten, overlapping


def grid(columns: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """A rectangle of unit squares: positions in the plane and counter-clockwise triangles."""
    x, y = np.meshgrid(np.arange(columns + 1.0), np.arange(rows + 1.0))
    points = np.stack([x.ravel(), y.ravel()], 1)
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    a, b, c, d = corner, corner + 1, corner + columns + 2, corner + columns + 1
    return points, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def distances(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - points, axis=-1)


def test_a_rolled_sheet_is_unrolled() -> None:
    flat, faces = grid(12, 8)
    angles = flat[:, 0] / 4
    rolled = np.stack([np.sin(angles), flat[:, 1] / 4, np.cos(angles)], 1)
    found = flatten(rolled, faces, np.zeros(len(faces), np.int64), 1)
    np.testing.assert_allclose(distances(found), distances(flat) / 4, atol=0.03)
    assert (flat_areas(found, faces) > 0).all()


def test_disks_do_not_influence_each_other() -> None:
    flat, faces = grid(4, 4)
    cap = np.concatenate([flat, 0.1 * np.square(flat - 2).sum(1, keepdims=True)], 1)
    plane = np.concatenate([3 * flat, 0 * flat[:, :1]], 1)
    disk = np.repeat([0, 1], len(faces))
    both = flatten(np.concatenate([cap, plane]), np.concatenate([faces, faces + len(flat)]), disk, 2)
    alone = flatten(plane, faces, disk[: len(faces)], 1)
    np.testing.assert_allclose(distances(both[len(flat) :]), distances(alone), rtol=1e-3, atol=1e-3)


def test_the_injective_map_never_flips_a_triangle() -> None:
    """A hemisphere with a spike, from a circle: steps stop before a triangle loses its area, and the energy falls."""
    sphere = trimesh.creation.icosphere(3)
    faces = sphere.faces[sphere.triangles_center[:, 2] > -0.3]
    kept, local = np.unique(faces, return_inverse=True)
    points, local = sphere.vertices[kept] * [1, 1, 3], local.reshape(-1, 3)
    disk = np.zeros(len(local), np.int64)
    circle = _to_circles(local, np.zeros(len(points), np.int64))
    assert (flat_areas(circle, local) > 0).all()
    relaxed = _injective(circle, local, _local_frames(points[local]), disk, 1)
    assert (flat_areas(relaxed, local) > 0).all()
    assert _stretch(points, relaxed, local) < 0.8 * _stretch(points, circle, local)


def _stretch(points: np.ndarray, flat: np.ndarray, faces: np.ndarray) -> float:
    """Root mean square ratio of the lengths of edges, or its inverse, whichever is larger."""
    edges = np.unique(np.sort(np.concatenate([faces[:, :2], faces[:, 1:], faces[:, ::2]]), 1), axis=0)
    space, plane = (np.linalg.norm(np.subtract(*np.moveaxis(p[edges], 1, 0)), axis=1) for p in (points, flat))
    return float(np.sqrt(np.square(np.maximum(space / plane, plane / space)).mean()))


@pytest.mark.parametrize(("turns", "crosses"), [(0.8, False), (1.3, True)])
def test_a_ring_that_overlaps_itself_is_found(turns: float, crosses: bool) -> None:
    flat, faces = grid(40, 2)
    angles = 2 * np.pi * turns * flat[:, 0] / 40
    ring = (5 + flat[:, 1:]) * np.stack([np.cos(-angles), np.sin(-angles)], 1)
    assert (flat_areas(ring, faces) > 0).all() or (flat_areas(ring, faces) < 0).all()
    assert overlapping(ring, faces, np.zeros(len(faces), np.int64), 1)[0] == crosses
