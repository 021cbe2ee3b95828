import torch

from dg4d_lib.deformation.rigidity import neighborhoods, rigidity
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.initialize import blob
from dg4d_lib.geometry.quaternion import multiply, rotation_matrix


def two_states(turn: torch.Tensor, shift: float, stretch: float = 1.0) -> Gaussians:
    cloud = blob(100, 0.05, torch.Generator().manual_seed(0))
    moved = stretch * (cloud.means @ rotation_matrix(turn).T) + shift
    quats = multiply(turn.expand(100, 4), cloud.quats)
    return Gaussians(
        torch.stack([cloud.means, moved]),
        cloud.log_scales.expand(2, -1, -1),
        torch.stack([cloud.quats, quats]),
        cloud.opacity_logits,
        cloud.harmonics,
    )


def test_a_rigid_motion_costs_nothing():
    states = two_states(torch.tensor([0.8, 0.1, 0.5, 0.3]), 0.2)
    assert rigidity(states, *neighborhoods(states.means[0])) < 1e-5


def test_stretching_costs():
    states = two_states(torch.tensor([1.0, 0, 0, 0]), 0.0, stretch=1.5)
    assert rigidity(states, *neighborhoods(states.means[0])) > 1e-3
