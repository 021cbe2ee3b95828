"""Properties of the cloud as a value."""

import pytest
import torch

from dg4d_lib.gaussians.cloud import Gaussians


def moving(states: int) -> Gaussians:
    generator = torch.Generator().manual_seed(1)
    means, log_scales, quats = (torch.randn(states, 5, width, generator=generator) for width in (3, 3, 4))
    return Gaussians(means, log_scales, quats, torch.zeros(5), torch.zeros(5, 1, 3))


@pytest.mark.parametrize("rows", [[2, 0], [0, 1], [1, 1, 1], [0, 2, 1], [0, 1, 2], []])
@pytest.mark.parametrize("kind", [list, lambda rows: torch.tensor(rows, dtype=torch.long)], ids=["list", "tensor"])
def test_states_are_picked_in_the_order_asked_for(rows, kind):
    cloud = moving(3)
    picked = cloud.states(kind(rows))
    for name in ("means", "log_scales", "quats"):
        assert getattr(picked, name).equal(getattr(cloud, name)[torch.tensor(rows, dtype=torch.long)])
    assert picked.harmonics is cloud.harmonics


def test_all_states_in_their_places_are_not_copied():
    cloud = moving(3)
    assert cloud.states(torch.arange(3)).means is cloud.means
    assert cloud.states(torch.arange(2)).means is not cloud.means


def test_covariances_have_the_squared_scales_along_the_turned_axes():
    """A turn by 90 degrees about z, by a quaternion of norm 2: the Gaussian's x axis is the y axis of the world."""
    scales, root = torch.tensor([[0.5, 2.0, 3.0]]), 2.0**0.5
    quats = torch.tensor([[root, 0.0, 0.0, root]])
    cloud = Gaussians(torch.zeros(1, 3), scales.log(), quats, torch.zeros(1), torch.zeros(1, 1, 3))
    torch.testing.assert_close(cloud.covariances[0], torch.diag(torch.tensor([4.0, 0.25, 9.0])))


def test_a_detached_cloud_has_the_values_and_no_gradient():
    cloud = moving(2)
    for value in vars(cloud).values():
        value.requires_grad_()
    for name, value in vars(cloud.detach()).items():
        assert not value.requires_grad and torch.equal(value, getattr(cloud, name))
