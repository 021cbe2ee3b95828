import pytest
import torch

from dg4d_lib.cameras.orbit import FOV_Y_DEG, OrbitCamera
from dg4d_lib.cameras.viewpoints import (
    MARGIN,
    baking_views,
    random_orbit,
    spread_orbit,
    turntable,
    whole_fov_y_deg,
    widened,
)


def test_random_views_stay_in_their_ranges_and_go_all_around():
    cameras = random_orbit(
        500, 64, elevation_deg=(-30, 30), radius=(1.5, 2.5), generator=torch.Generator().manual_seed(0)
    )
    assert all(-30 <= c.elevation_deg < 30 and -180 <= c.azimuth_deg < 180 and 1.5 <= c.radius < 2.5 for c in cameras)
    assert {int((c.azimuth_deg + 180) // 45) for c in cameras} == set(range(8))


def test_the_same_seed_gives_the_same_views():
    def draw() -> list[OrbitCamera]:
        return random_orbit(3, 8, elevation_deg=(0, 1), radius=(1, 2), generator=torch.Generator().manual_seed(5))

    assert draw() == draw()


def test_spread_views_cover_all_azimuths_elevations_and_radii_evenly():
    cameras = spread_orbit(24, elevation_deg=(-30, 30), radius=(1.5, 2.5))
    azimuths = torch.tensor([camera.azimuth_deg for camera in cameras])
    torch.testing.assert_close(azimuths.diff(), torch.full((23,), 15.0))
    assert azimuths[0] == -172.5
    cells = [(int((c.elevation_deg + 30) // 20), int((c.radius - 1.5) // 0.5)) for c in cameras]
    assert all(2 <= cells.count((row, column)) <= 6 for row in range(3) for column in range(2))
    quarters = [(number // 6, camera.elevation_deg < 0) for number, camera in enumerate(cameras)]
    assert all(quarters.count((quarter, below)) == 3 for quarter in range(4) for below in (True, False))


def test_baking_sees_three_rings_and_both_poles():
    cameras = baking_views(64)
    assert len(cameras) == 26
    assert {c.elevation_deg for c in cameras} == {0.0, -45.0, 45.0, 89.9, -89.9}


def test_a_turntable_goes_round_once():
    assert [c.azimuth_deg for c in turntable(4, OrbitCamera(0, 10))] == [10, 100, 190, 280]


def test_random_cameras_come_in_rings_where_they_are_asked_to():
    generator = torch.Generator().manual_seed(3)
    cameras = random_orbit(8, 48, elevation_deg=(-30, 30), radius=(1.5, 2.5), generator=generator, ring=4)
    for four in (cameras[:4], cameras[4:]):
        assert len({(camera.elevation_deg, camera.radius) for camera in four}) == 1
        turns = [camera.azimuth_deg - four[0].azimuth_deg for camera in four]
        assert turns == pytest.approx([0, 90, 180, 270])
    assert cameras[0] != cameras[4]


def test_what_fits_is_seen_as_before():
    cameras = turntable(4, OrbitCamera(10))
    assert widened(cameras, 0.5 * torch.eye(3)[None]) == cameras
    assert widened(cameras, torch.zeros(2, 0, 3)) == cameras


def test_what_comes_near_fits_in_the_end():
    """A point to the right of the view from the front is nearer, and outside, in the view from its side."""
    cameras = turntable(2, OrbitCamera())
    points = torch.tensor([[[0.0, 0.0, 0.0]], [[0.9, 0.0, -0.6]]])
    wider = widened(cameras, points)
    assert {camera.fov_y_deg for camera in wider} == {wider[0].fov_y_deg}
    assert wider[0].tan_half_fov[1] == pytest.approx((1 + MARGIN) * 0.9 / (2 - 0.6))
    assert [camera.azimuth_deg for camera in wider] == [0, 180]


def test_strays_are_not_waited_for():
    points = torch.cat([torch.zeros(4000, 3), torch.tensor([[5.0, 0.0, 0.0]])])[None]
    assert widened([OrbitCamera()], points) == [OrbitCamera()]


def test_the_whole_is_held_from_all_sides_and_not_by_much_less():
    points = 1.1 * torch.nn.functional.normalize(
        torch.randn(1, 400, 3, generator=torch.Generator().manual_seed(0)), dim=-1
    )
    from_everywhere = spread_orbit(24, elevation_deg=(-90, 90), radius=(2, 2))
    needed = widened(from_everywhere, points)[0].fov_y_deg
    assert needed <= whole_fov_y_deg(points) < needed + 1
    assert whole_fov_y_deg(points / 2) == whole_fov_y_deg(torch.zeros(2, 0, 3)) == FOV_Y_DEG
    assert whole_fov_y_deg(4 * points) < 180  # beyond the camera
