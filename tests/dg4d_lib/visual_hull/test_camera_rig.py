import math

import pytest
import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.visual_hull.rig import meeting_point, orbit_places


def pose(azimuth: float, elevation: float, radius: float, roll: float = 0.0) -> torch.Tensor:
    """Return camera to world, OpenGL axes, of an orbit camera that is rolled counter-clockwise."""
    to_world = OrbitCamera(elevation, azimuth, radius).viewmat().inverse()
    axes = to_world[:3, :3] @ torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))
    c, s = math.cos(math.radians(roll)), math.sin(math.radians(roll))
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    return torch.cat([axes @ turn, to_world[:3, 3:]], 1)


PLACES = [(0.0, 0.0, 2.0, 0.0), (90.0, 0.0, 3.0, 0.0), (200.0, 30.0, 2.5, 20.0), (-60.0, -20.0, 4.0, -35.0)]


def moved(poses: torch.Tensor) -> torch.Tensor:
    """Turn and shift the whole world: the same rig in other coordinates."""
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64))[0]
    turn = turn * turn.det().sign()
    place = (3 * turn @ poses[:, :, 3:])[..., 0] + torch.tensor([5.0, -2, 1], dtype=torch.float64)
    return torch.cat([turn @ poses[:, :, :3], place[..., None]], -1)


@pytest.mark.parametrize("change", [lambda poses: poses, moved])
def test_cameras_come_back_as_they_were_placed_in_any_coordinates(change):
    poses = change(torch.stack([pose(*place) for place in PLACES]))
    for found, (azimuth, elevation, radius, roll) in zip(
        orbit_places(poses, 0, meeting_point(poses)), PLACES, strict=True
    ):
        assert (found.azimuth_deg - azimuth + 180) % 360 - 180 == pytest.approx(0, abs=1e-6)
        assert found.elevation_deg == pytest.approx(elevation, abs=1e-6)
        assert found.roll_deg == pytest.approx(roll, abs=1e-6)
        assert found.distance == pytest.approx(radius / 2)
        assert found.center == pytest.approx((0, 0), abs=1e-9)


def test_cameras_that_look_away_are_named():
    away = pose(90, 0, 2)
    away[:, [0, 2]] *= -1  # turned about its up axis
    poses = torch.stack([pose(0, 0, 2), pose(40, 10, 2), pose(-40, 0, 2), away])
    with pytest.raises(BadInput, match="look away from the subject: frames 3 of 4"):
        meeting_point(poses)


def test_parallel_cameras_are_refused():
    shifted = pose(0, 0, 2)
    shifted[0, 3] += 1
    with pytest.raises(BadInput, match="look in one direction"):
        meeting_point(torch.stack([pose(0, 0, 2), shifted]))


@pytest.mark.parametrize("column", [0, 1])
def test_matrices_that_are_no_rotation_are_refused(column):
    flat = pose(90, 0, 2)
    flat[:, column] = flat[:, 2]
    with pytest.raises(BadInput, match=r"frame 1 .* is not a rotation"):
        meeting_point(torch.stack([pose(0, 0, 2), flat]))
