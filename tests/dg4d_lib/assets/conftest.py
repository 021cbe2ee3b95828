"""Small animated cloud for the tests of this folder."""

import pytest
import torch

from dg4d_lib.deformation.framewise import Framewise
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.spherical_harmonics import rgb_to_sh


@pytest.fixture
def red_dot() -> Gaussians:
    """One opaque red ball in the middle."""
    return Gaussians(
        means=torch.zeros(1, 3),
        log_scales=torch.full((1, 3), 0.08).log(),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        opacity_logits=torch.tensor([5.0]),
        harmonics=rgb_to_sh(torch.tensor([[1.0, 0.0, 0.0]])),
    )


@pytest.fixture
def slide() -> Framewise:
    """Moves one Gaussian by half a unit along x from the first to the last frame, and grows it."""
    motion = Framewise(2, 1)
    motion.requires_grad_(False)
    motion.table[1, 0, 0] = 0.5
    motion.table[1, 0, 3:6] = 0.1
    return motion
