"""Height and ground: closed forms, and the way back."""

from dataclasses import replace

import pytest
import torch

from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.assets.placement import Placement, ground_placement
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.textured import TexturedMesh

MOVED = Placement(0.25, (1.0, -2.0, 3.0))


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> TexturedMesh:
    corners = torch.cartesian_prod(*torch.tensor([low, high], dtype=torch.float32).T)
    return TexturedMesh(corners, torch.tensor([[0, 1, 2]]), torch.zeros(8, 2), torch.zeros(1, 1, 3))


def rising() -> Asset4D:
    """Return a box of height 2 that goes down by 1 and to +x by 4."""
    offsets = torch.zeros(3, 8, 3)
    offsets[1, :, 1], offsets[2, :, 0] = -1.0, 4.0
    return Asset4D(box((-1, -0.5, -3), (1, 1.5, 1)), offsets, 8.0)


def cloud() -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    draws = [torch.randn(2, 5, width, generator=generator) for width in (3, 3, 4)]
    return Gaussians(*draws, torch.zeros(5), torch.zeros(5, 4, 3))


def test_the_lowest_point_is_on_the_ground_and_the_center_above_the_origin() -> None:
    placed = ground_placement(rising(), 0.0, True).surface(rising())
    poses = placed.mesh.vertices + placed.offsets
    low, high = poses.amin((0, 1)), poses.amax((0, 1))
    torch.testing.assert_close(low, torch.tensor([-3.0, 0.0, -2.0]))
    torch.testing.assert_close(high, torch.tensor([3.0, 3.0, 2.0]))


@pytest.mark.parametrize("ground", [False, True])
def test_the_first_frame_has_the_height_asked_for(ground: bool) -> None:
    placed = ground_placement(rising(), 0.3, ground).surface(rising())
    first = placed.mesh.vertices + placed.offsets[0]
    assert float(first[:, 1].max() - first[:, 1].min()) == pytest.approx(0.3)
    assert float(placed.offsets[2, 0, 0]) == pytest.approx(4 * 0.15)


def test_meshes_per_frame_are_placed_as_a_tracked_mesh() -> None:
    asset = rising()
    meshes = [replace(asset.mesh, vertices=asset.mesh.vertices + offsets) for offsets in asset.offsets]
    assert ground_placement(meshes, 0.3, True) == ground_placement(asset, 0.3, True)


def test_without_height_and_ground_nothing_changes() -> None:
    assert ground_placement(rising(), 0.0, False) == Placement()
    assert torch.equal(Placement().surface(rising()).mesh.vertices, rising().mesh.vertices)
    assert torch.equal(Placement().gaussians(cloud()).log_scales, cloud().log_scales)


def test_gaussians_are_placed_as_vertices() -> None:
    placed = MOVED.gaussians(cloud())
    torch.testing.assert_close(placed.means, 0.25 * cloud().means + torch.tensor([1.0, -2.0, 3.0]))
    torch.testing.assert_close(placed.scales, 0.25 * cloud().scales)
    assert torch.equal(placed.quats, cloud().quats)


def test_the_inverse_leads_back() -> None:
    back = MOVED.inverse.gaussians(MOVED.gaussians(cloud()))
    torch.testing.assert_close(back.means, cloud().means, atol=1e-5, rtol=0)
    torch.testing.assert_close(back.log_scales, cloud().log_scales, atol=1e-5, rtol=0)
    asset = MOVED.inverse.surface(MOVED.surface(rising()))
    torch.testing.assert_close(asset.mesh.vertices + asset.offsets, rising().mesh.vertices + rising().offsets)


def test_a_flat_mesh_has_no_height_to_scale() -> None:
    with pytest.raises(BadInput, match=r"flat; set pack\.height_m=0"):
        ground_placement([box((0, 1, 0), (1, 1, 1))], 0.3, True)
