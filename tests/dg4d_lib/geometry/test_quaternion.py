import torch

from dg4d_lib.geometry.quaternion import quat_multiply, quat_to_rotmat, rotate


def some_quats(count: int = 50) -> torch.Tensor:
    return torch.randn(count, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 3


def test_rotations_are_proper():
    turns = quat_to_rotmat(some_quats())
    torch.testing.assert_close(turns @ turns.mT, torch.eye(3, dtype=torch.float64).expand(50, 3, 3))
    torch.testing.assert_close(torch.linalg.det(turns), torch.ones(50, dtype=torch.float64))


def test_a_quarter_turn_about_y_carries_z_to_x():
    quarter = torch.tensor([2**0.5 / 2, 0, 2**0.5 / 2, 0])
    torch.testing.assert_close(quat_to_rotmat(quarter) @ torch.tensor([0.0, 0, 1]), torch.tensor([1.0, 0, 0]))


def test_vectors_are_rotated_by_their_own_or_one_matrix():
    turns = quat_to_rotmat(some_quats())
    vectors = torch.randn(3, 50, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    torch.testing.assert_close(rotate(turns, vectors), torch.einsum("nij,tnj->tni", turns, vectors))
    torch.testing.assert_close(rotate(turns[:1], vectors), vectors @ turns[0].mT)


def test_the_norm_of_a_quaternion_does_not_matter():
    quats = some_quats()
    torch.testing.assert_close(quat_to_rotmat(quats), quat_to_rotmat(0.01 * quats))


def test_multiplying_is_rotating_by_the_second_then_the_first():
    a, b = some_quats()[:25], some_quats()[25:]
    torch.testing.assert_close(quat_to_rotmat(quat_multiply(a, b)), quat_to_rotmat(a) @ quat_to_rotmat(b))
