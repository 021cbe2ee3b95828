"""Faces that a motion turns inside out are found and turned back."""

import numpy as np
import pytest

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
    np.testing.assert_allclose(repaired, vertices, atol=1e-4)  # what lies around it did not move


@pytest.mark.parametrize("angle_deg", [0.0, 60.0, 120.0])
def test_halves_that_overlap_far_are_joined_without_flips(angle_deg: float) -> None:
    vertices, faces = sheet(40)
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    half, turn = vertices[:, 0] >= 20, np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    moved, rotations = vertices.copy(), identity(len(vertices))
    moved[half] = (vertices[half] - (20, 0, 0)) @ turn.T + (8, 0, 0)  # 12 cells back over the other half
    rotations[half] = turn
    assert faces_against_rotations(vertices, moved, faces, rotations).any()
    repaired, left = unflip(vertices, moved, faces, rotations)
    assert left == 0
    ends = vertices[:, 0] == 0
    np.testing.assert_allclose(repaired[ends], vertices[ends], atol=2.0)


def test_slivers_are_turned_back_with_their_surroundings() -> None:
    vertices, faces = sheet(24)
    vertices[:, 0] += np.where(vertices[:, 0] % 6 == 0, 0.999, 0)  # every sixth column almost lies on the next one
    bend = 0.05 * np.square(vertices[:, 0] - 12)
    moved = vertices + np.stack([0.3 * np.sin(vertices[:, 1]), 0 * bend, bend], 1)
    moved[12 * 24 + 10] += (4.0, 2.0, 0)
    assert faces_against_rotations(vertices, moved, faces, identity(len(vertices))).any()
    repaired, left = unflip(vertices, moved, faces, identity(len(vertices)))
    assert left == 0
    np.testing.assert_array_equal(repaired[:24], moved[:24])


def test_a_sliver_does_not_stiffen_what_is_far_from_it() -> None:
    vertices, faces = sheet(40)
    corner = 20 * 40 + 20
    vertices[corner + 40] = vertices[corner] + (0.5, 1e-5, 0)  # almost on the line to its neighbor
    moved = vertices + np.stack([0 * vertices[:, 0], 0.01 * np.square(vertices[:, 0] - 20), 0 * vertices[:, 0]], 1)
    repaired, left = unflip(vertices, moved, faces, identity(len(vertices)))
    assert left == 1
    far = np.abs(vertices[:, :2] - vertices[corner, :2]).max(1) > 12
    np.testing.assert_array_equal(repaired[far], moved[far])


def test_a_sound_motion_is_returned_unchanged():
    vertices, faces = sheet()
    moved = vertices + np.array([0.5, 0, 0])
    assert unflip(vertices, moved, faces, identity(len(vertices)))[0] is moved
