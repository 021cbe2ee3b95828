"""Resampling to other frame rates: states between frames follow the motion."""

import math
from collections.abc import Iterator

import pytest
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import normalize

from dg4d_lib.assets.animated import Asset4D, interpolate_frames, pose_gaussians
from dg4d_lib.assets.resample import (
    MAX_STATES,
    MIN_STATES,
    STATES_AT_ONCE,
    nearest_rate,
    pose_gaussians_in_chunks,
    resample_asset,
    resampled_positions,
)
from dg4d_lib.deformation.interface import Displacement
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.textured import TexturedMesh

FRAMES, FPS, REST = 5, 7.0, 2
STEP = math.radians(60)  # by which things turn from frame to frame


class Turning:
    """Everything turns about the y axis, from frame to frame by `STEP`."""

    def displace(self, means: Float[Tensor, "n 3"], times: Float[Tensor, " t"]) -> Displacement:
        angles = STEP * (FRAMES - 1) * times
        quats = torch.stack([(angles / 2).cos(), 0 * angles, (angles / 2).sin(), 0 * angles], -1)
        there = means @ turns(angles).mT
        rest = torch.tensor([1.0, 0, 0, 0])
        return Displacement(there - means, torch.zeros_like(there), (quats - rest)[:, None].repeat(1, len(means), 1))

    def parameters(self) -> Iterator[nn.Parameter]:
        return iter(())

    def grid_parameters(self) -> list[nn.Parameter]:
        return []

    def length_parameters(self) -> list[nn.Parameter]:
        return []

    def regularization_loss(self) -> Float[Tensor, ""]:
        return torch.zeros(())


class Sliding(Turning):
    """Everything goes along x, by one unit from the first to the last frame."""

    def displace(self, means: Float[Tensor, "n 3"], times: Float[Tensor, " t"]) -> Displacement:
        way = times[:, None, None] * torch.tensor([1.0, 0, 0])
        none = torch.zeros(len(times), len(means), 3)
        return Displacement(way + none, none, torch.zeros(len(times), len(means), 4))


def turns(angles: Float[Tensor, " t"]) -> Float[Tensor, "t 3 3"]:
    zero, one = 0 * angles, 0 * angles + 1
    rows = [angles.cos(), zero, angles.sin(), zero, one, zero, -angles.sin(), zero, angles.cos()]
    return torch.stack(rows, -1).reshape(-1, 3, 3)


@pytest.fixture
def cloud() -> Gaussians:
    points = 0.5 * normalize(torch.randn(200, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(200, 1)
    return Gaussians(points, torch.full((200, 3), -3.0), quats, torch.full((200,), 3.0), torch.zeros(200, 1, 3))


def ridden(vertices: Tensor, positions: Tensor) -> Tensor:
    """Return the vertices rotated from their positions at `REST`; undefined between the last frame and the first."""
    return vertices @ turns(STEP * (positions.float() - REST)).mT - vertices


@pytest.fixture
def asset(cloud: Gaussians) -> Asset4D:
    """A tetrahedron that turns with the cloud, and is corrected at every frame by a way of its own."""
    corners = 0.5 * torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [-0.6, -0.6, 0.5]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    mesh = TexturedMesh(corners, faces, torch.rand(4, 2), torch.rand(4, 4, 3))
    offsets = ridden(corners, torch.arange(FRAMES)) + corrections()
    return Asset4D(mesh, offsets, FPS, {"a": 1}, torch.rand(FRAMES, 2, 2, 3), REST)


def corrections() -> Tensor:
    return 0.02 * torch.randn(FRAMES, 4, 3, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize(
    ("fps", "states"), [(8, 16), (12, 24), (24, 48), (30, 60), (28, 56), (7, 14), (3.5, 7), (2, 4)]
)
def test_there_are_as_many_states_as_the_loop_has_room_for(fps: float, states: int) -> None:
    positions = resampled_positions(14, 7.0, fps)
    assert len(positions) == states
    assert positions[0] == 0
    torch.testing.assert_close(
        positions.diff(append=positions.new_tensor([14.0])), torch.full_like(positions, 14 / states)
    )


@pytest.mark.parametrize("factor", [1, 2, 3, 4])
def test_frames_are_met_exactly_by_whole_factors(factor: int) -> None:
    assert torch.equal(resampled_positions(14, 7.0, factor * 7.0)[::factor], torch.arange(14, dtype=torch.float64))


def test_a_rate_of_too_many_states_is_refused_but_all_frames_never_are() -> None:
    with pytest.raises(BadInput, match=r"1001 states .* 4 to 1000 are allowed; set pack.fps to 7$"):
        resampled_positions(1000, 7.0, 7.007)
    assert len(resampled_positions(2000, 7.0, 7.0)) == 2000
    assert len(resampled_positions(1000, 7.0, 7.0)) == MAX_STATES


@pytest.mark.parametrize("frames", [1, 3, 32, 999, 1000, 1001])
def test_the_nearest_rate_gives_as_many_or_as_few_states_as_are_allowed(frames: int) -> None:
    for fps in (0.53, 23.976, 1e3 / 7):
        assert len(resampled_positions(frames, fps, nearest_rate(frames, fps, 1e9))) == max(frames, MAX_STATES)
        assert len(resampled_positions(frames, fps, nearest_rate(frames, fps, 1e-9))) == min(frames, MIN_STATES)
        assert nearest_rate(frames, fps, fps) == fps


def test_a_rate_at_which_a_swing_stands_still_is_refused() -> None:
    with pytest.raises(BadInput, match=r"2 states .* 4 to 1000 are allowed; set pack.fps to 2$"):
        resampled_positions(14, 7.0, 1.0)


def test_states_in_parts_are_the_states(cloud: Gaussians) -> None:
    positions = resampled_positions(FRAMES, FPS, 20 * FPS)
    assert len(positions) > 2 * STATES_AT_ONCE
    parts, whole = (
        pose_gaussians_in_chunks(cloud, Turning(), FRAMES, positions),
        pose_gaussians(cloud, Turning(), FRAMES, positions),
    )
    for name, value in vars(whole).items():
        torch.testing.assert_close(getattr(parts, name), value, atol=1e-6, rtol=0)


def test_frames_stay_as_they_were_bit_by_bit(asset: Asset4D, cloud: Gaussians) -> None:
    fine = resample_asset(asset, cloud, Turning(), FRAMES, 4 * FPS)
    assert torch.equal(fine.offsets[::4], asset.offsets)
    assert (len(fine.offsets), fine.fps, fine.extras) == (4 * FRAMES, 4 * FPS, {"a": 1})


@pytest.mark.parametrize("fps", [4 * FPS, 12.0, 6.0])
def test_between_frames_the_mesh_turns_with_the_cloud(asset: Asset4D, cloud: Gaussians, fps: float) -> None:
    fine = resample_asset(asset, cloud, Turning(), FRAMES, fps)
    positions = resampled_positions(FRAMES, FPS, fps)
    told = positions <= FRAMES - 1
    expected = ridden(asset.mesh.vertices, positions) + interpolate_frames(corrections(), positions)
    torch.testing.assert_close(fine.offsets[told], expected[told], atol=2e-6, rtol=0)
    morphed = interpolate_frames(asset.offsets, positions)
    assert (morphed - expected)[told].norm(dim=-1).max() > 0.03  # chords of 60 degrees


def test_after_the_last_frame_it_goes_home_as_the_cloud_does(asset: Asset4D, cloud: Gaussians) -> None:
    offsets = torch.arange(FRAMES)[:, None, None] / (FRAMES - 1) * torch.tensor([1.0, 0, 0]).expand(4, 3)
    fine = resample_asset(Asset4D(asset.mesh, offsets, FPS), cloud, Sliding(), FRAMES, 2 * FPS)
    way = pose_gaussians(cloud, Sliding(), FRAMES, resampled_positions(FRAMES, FPS, 2 * FPS)).means - cloud.means
    torch.testing.assert_close(fine.offsets, way[:, :4], atol=1e-6, rtol=0)
    torch.testing.assert_close(fine.offsets[-1, :, 0], torch.full((4,), 0.5), atol=1e-6, rtol=0)


def test_textures_are_those_of_the_nearest_frame(asset: Asset4D, cloud: Gaussians) -> None:
    fine = resample_asset(asset, cloud, Turning(), FRAMES, 4 * FPS)
    assert asset.textures is not None and fine.textures is not None
    assert torch.equal(fine.textures[:6], asset.textures[[0, 0, 0, 1, 1, 1]])
    assert torch.equal(fine.textures[-1], asset.textures[0])


def test_rest_is_the_same_moment_at_the_new_rate(asset: Asset4D, cloud: Gaussians) -> None:
    assert resample_asset(asset, cloud, Turning(), FRAMES, 4 * FPS).reference_frame == 4 * REST


def test_at_its_own_rate_nothing_changes(asset: Asset4D, cloud: Gaussians) -> None:
    assert resample_asset(asset, cloud, Turning(), FRAMES, FPS) is asset


def test_a_mesh_of_another_motion_is_refused(asset: Asset4D, cloud: Gaussians) -> None:
    with pytest.raises(BadInput, match="the mesh has 5 frames, its motion has 9"):
        resample_asset(asset, cloud, Turning(), 9, 24.0)
