import pytest
import torch

from dg4d_lib.deformation.rigidity_loss import neighborhoods, rigidity_loss, rigidity_sum_reference
from dg4d_lib.deformation.rigidity_loss_kernel import rigidity_sum
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.initialize import blob
from dg4d_lib.geometry.quaternion import quat_multiply, quat_to_rotmat


def two_states(turn: torch.Tensor, shift: float, stretch: float = 1.0) -> Gaussians:
    cloud = blob(100, 0.05, torch.Generator().manual_seed(0))
    moved = stretch * (cloud.means @ quat_to_rotmat(turn).T) + shift
    quats = quat_multiply(turn.expand(100, 4), cloud.quats)
    return Gaussians(
        torch.stack([cloud.means, moved]),
        cloud.log_scales.expand(2, -1, -1),
        torch.stack([cloud.quats, quats]),
        cloud.opacity_logits,
        cloud.harmonics,
    )


def test_a_rigid_motion_costs_nothing():
    states = two_states(torch.tensor([0.8, 0.1, 0.5, 0.3]), 0.2)
    assert rigidity_loss(states, *neighborhoods(states.means[0])) < 1e-5


def test_stretching_costs():
    states = two_states(torch.tensor([1.0, 0, 0, 0]), 0.0, stretch=1.5)
    assert rigidity_loss(states, *neighborhoods(states.means[0])) > 1e-3


def test_the_loss_is_the_mean_change_of_offsets_weighted_by_the_distance_at_rest():
    """Two Gaussians 0.02 apart move to 0.05 in the first of two steps; Luiten et al. weight by exp(-2000 d^2)."""
    cloud = blob(2, 0.05, torch.Generator().manual_seed(0))
    means = torch.zeros(3, 2, 3)
    means[:, 1, 0] = torch.tensor([0.02, 0.05, 0.05])
    quats = torch.tensor([1.0, 0, 0, 0]).expand(3, 2, 4)
    states = Gaussians(means, torch.zeros(3, 2, 3), quats, cloud.opacity_logits, cloud.harmonics)
    expected = torch.tensor(-2000 * 0.02**2).exp() * 0.03 / 2
    torch.testing.assert_close(rigidity_loss(states, *neighborhoods(means[0])), expected)


def test_one_frame_has_no_rigidity_loss():
    cloud = blob(3, 0.05, torch.Generator().manual_seed(0))
    first = Gaussians(cloud.means[None], cloud.log_scales[None], cloud.quats[None], *list(vars(cloud).values())[3:])
    assert rigidity_loss(first, *neighborhoods(cloud.means)) == 0


def test_no_gaussian_is_its_own_neighbor() -> None:
    """Of the four at one place, all are equally near."""
    indices, weights = neighborhoods(torch.tensor([[0.0, 0, 0]] * 4 + [[1.0, 0, 0]]), 2)
    assert indices.shape == weights.shape == (5, 2)
    assert (indices != torch.arange(5)[:, None]).all()
    assert weights.tolist() == [[1, 1]] * 4 + [[0, 0]]


def test_a_single_gaussian_has_no_neighbors_and_costs_nothing() -> None:
    cloud = blob(2, 0.05, torch.Generator().manual_seed(0)).subset(slice(1))
    states = Gaussians(torch.randn(2, 1, 3), torch.zeros(2, 1, 3), torch.ones(2, 1, 4), *list(vars(cloud).values())[3:])
    assert rigidity_loss(states, *neighborhoods(cloud.means)) == 0


def pairs(times: int) -> tuple[torch.Tensor, ...]:
    """Return random positions and quaternions of 300 Gaussians, and their neighbors, in float64."""
    generator = torch.Generator().manual_seed(1)
    means = torch.rand(300, 3, generator=generator, dtype=torch.float64)
    moved = means + 0.1 * torch.rand(times, 300, 3, generator=generator, dtype=torch.float64)
    quats = torch.randn(times, 300, 4, generator=generator, dtype=torch.float64)
    return moved, quats, *neighborhoods(means, 7)


@pytest.mark.parametrize("times", [2, 3, 12, 16, 17, 31, 32])
def test_the_kernel_is_its_definition_and_so_are_its_gradients(times: int) -> None:
    means, turns, indices, weights = pairs(times)
    means[:, 5] = means[0, 5]
    means[:, indices[5]] = means[0, indices[5]]
    turns[:, 5] = turns[0, 5]  # these pairs do not move: there the distance has no slope
    truth_leaves = [means.clone().requires_grad_(), turns.clone().requires_grad_()]
    truth = rigidity_sum_reference(*truth_leaves, indices, weights)
    truth.backward()
    leaves = [means.float().requires_grad_(), turns.float().requires_grad_()]
    found = rigidity_sum(*leaves, indices, weights.float())
    (3 * found).backward()
    assert torch.isclose(found.double(), truth, rtol=1e-5)
    for leaf, true_leaf in zip(leaves, truth_leaves, strict=True):
        assert leaf.grad is not None
        assert true_leaf.grad is not None
        torch.testing.assert_close(leaf.grad.double(), 3 * true_leaf.grad, rtol=1e-4, atol=2e-4)


def test_the_number_of_threads_changes_no_bit_of_the_strain() -> None:
    means, turns, indices, weights = (tensor.float() if tensor.is_floating_point() else tensor for tensor in pairs(5))
    gradients = []
    before = torch.get_num_threads()
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            leaf = means.clone().requires_grad_()
            rigidity_sum(leaf, turns, indices, weights).backward()
            gradients.append(leaf.grad)
    finally:
        torch.set_num_threads(before)
    assert gradients[0] is not None
    assert all(gradient is not None and gradient.equal(gradients[0]) for gradient in gradients)
