"""Faces that a motion turns inside out are found and turned back."""

import numpy as np

from dg4d_lib.mesh.models.flips import faces_against_rotations, unflip


def sheet(side: int = 12) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[:side, :side]
    vertices = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1).astype(float)
    k = np.arange(side * side).reshape(side, side)[:-1, :-1].ravel()
    return vertices, np.concatenate([np.stack([k, k + 1, k + side], 1), np.stack([k + 1, k + side + 1, k + side], 1)])


def identity(count: int) -> np.ndarray:
    return np.tile(np.eye(3), (count, 1, 1))


def test_a_turned_sheet_has_no_flipped_faces():
    vertices, faces = sheet()
    turn = np.diag([-1.0, 1.0, -1.0])  # half a turn about y: all normals point back, as they should
    assert not faces_against_rotations(vertices, vertices @ turn.T, faces, np.tile(turn, (len(vertices), 1, 1))).any()


def test_a_folded_vertex_is_unfolded_and_the_rest_stays():
    vertices, faces = sheet()
    moved = vertices.copy()
    middle = 5 * 12 + 5
    moved[middle] += (3.0, 0, 0)
    assert faces_against_rotations(vertices, moved, faces, identity(len(vertices))).any()
    repaired, left = unflip(vertices, moved, faces, identity(len(vertices)))
    assert left == 0
    assert not faces_against_rotations(vertices, repaired, faces, identity(len(vertices))).any()
    np.testing.assert_array_equal(repaired[0], vertices[0])
    assert repaired[middle, 0] > vertices[middle, 0]


def test_a_sound_motion_is_returned_unchanged():
    vertices, faces = sheet()
    moved = vertices + np.array([0.5, 0, 0])
    assert unflip(vertices, moved, faces, identity(len(vertices)))[0] is moved
