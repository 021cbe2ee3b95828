import math
from typing import Any

import pytest
import torch

from dg4d_lib.cameras.orbit import OrbitCamera, viewmats
from dg4d_lib.errors import BadInput


def seen(camera: OrbitCamera, point: tuple[float, float, float]) -> torch.Tensor:
    return (camera.viewmat() @ torch.tensor([*point, 1.0], dtype=torch.float64))[:3]


@pytest.mark.parametrize("elevation", [-80.0, -30.0, 0.0, 45.0, 89.9])
@pytest.mark.parametrize("azimuth", [-170.0, 0.0, 40.0, 90.0])
def test_it_looks_at_the_origin_from_its_position(elevation: float, azimuth: float):
    camera = OrbitCamera(elevation, azimuth, 1.7)
    zero = torch.zeros(3, dtype=torch.float64)
    torch.testing.assert_close(seen(camera, tuple(camera.position().tolist())), zero, atol=1e-12, rtol=0)
    torch.testing.assert_close(seen(camera, (0, 0, 0)), torch.tensor([0, 0, 1.7], dtype=torch.float64))


def test_up_in_the_world_is_up_in_the_picture():
    assert seen(OrbitCamera(20, 130), (0, 0.5, 0))[1] < 0


def test_azimuth_zero_stands_on_z_and_ninety_on_x():
    torch.testing.assert_close(OrbitCamera(0, 0).position(), torch.tensor([0, 0, 2], dtype=torch.float64))
    expected = torch.tensor([2, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(OrbitCamera(0, 90).position(), expected, atol=1e-12, rtol=0)


def test_positive_elevation_is_above():
    assert OrbitCamera(30, 40).position()[1] > 0
    golden = torch.tensor([1.1133, -1.0, 1.3268], dtype=torch.float64)  # of the public code, 30 below
    torch.testing.assert_close(OrbitCamera(-30, 40).position(), golden, atol=5e-5, rtol=0)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"width": 0}, "at least 1 x 1 pixels; given 0 x 256"),
        ({"height": -3}, "at least 1 x 1 pixels; given 256 x -3"),
        ({"fov_y_deg": 0.0}, "between 0 and 180 degrees; given 2.0 and 0.0"),
        ({"fov_y_deg": 180.0}, "between 0 and 180 degrees"),
        ({"fov_y_deg": math.nan}, "between 0 and 180 degrees"),
        ({"radius": -2.0}, "radius above 0"),
        ({"radius": math.inf}, "finite radius"),
        ({"azimuth_deg": math.nan}, "angles of a camera must be finite"),
        ({"elevation_deg": math.inf}, "angles of a camera must be finite"),
    ],
)
def test_cameras_that_no_rasterizer_can_draw_are_refused(change: dict[str, Any], says: str):
    with pytest.raises(BadInput, match=says):
        OrbitCamera(**change)


def test_rotations_are_proper():
    matrices = viewmats([OrbitCamera(e, a) for e in (-40, 0, 70) for a in (0, 33, 200)])[:, :3, :3]
    torch.testing.assert_close(matrices @ matrices.mT, torch.eye(3, dtype=torch.float64).expand(9, 3, 3))
    assert (torch.linalg.det(matrices) > 0).all()


def test_focal_length_of_the_method():
    assert OrbitCamera(width=256, height=256).focal == pytest.approx(280.222, abs=1e-3)
    assert OrbitCamera(width=512, height=256).tan_half_fov == pytest.approx(
        (2 * math.tan(math.radians(49.1) / 2), math.tan(math.radians(49.1) / 2))
    )
