"""Rendering of volumes: closed forms of absorption, and a plain twin."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn.functional import grid_sample

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.shape_prior.frustum import BINS, FAR, NEAR, SIZE, TAN_HALF_FOV
from dg4d_lib.shape_prior.raymarch import CELL, STRIDE, make_volume, render_volumes

COLOR = torch.tensor([0.2, 0.5, 0.9])


def box(rows: slice, columns: slice, bins: slice, density: float) -> torch.Tensor:
    volume = torch.zeros(SIZE, SIZE, BINS)
    volume[rows, columns, bins] = density
    return volume


def rendered(density: torch.Tensor, camera: OrbitCamera) -> tuple[torch.Tensor, torch.Tensor]:
    color, alpha = render_volumes([make_volume(density, COLOR.expand(SIZE, SIZE, BINS, 3))], [camera])
    return color[0], alpha[0, ..., 0]


def test_a_slab_absorbs_exponentially():
    for density in (0.02, 0.1, 0.4):
        slab = box(slice(20, 108), slice(20, 108), slice(22, 42), density)
        color, alpha = rendered(slab, OrbitCamera(width=65, height=65))
        # the middle ray crosses 20 cells; a sample's trapezoid may miss or add a share of one at either face
        assert alpha[32, 32] == pytest.approx(1 - math.exp(-20 * density), abs=0.7 * density + 0.02)
        torch.testing.assert_close(color[32, 32], COLOR * alpha[32, 32])


def test_nothing_is_transparent():
    color, alpha = rendered(torch.zeros(SIZE, SIZE, BINS), OrbitCamera(20, 50, width=32, height=32))
    assert not color.any() and not alpha.any()


def test_a_block_appears_where_its_place_projects_to():
    block = box(slice(60, 68), slice(80, 88), slice(44, 50), 2.0)  # right of the middle and behind it
    depth = NEAR + 47 * CELL
    point = torch.tensor([(2 * 84 / SIZE - 1) * TAN_HALF_FOV * depth, 0.0, 2 - depth, 1], dtype=torch.float64)
    for azimuth in (0, 60, 90, 180, -120):
        camera = OrbitCamera(10, azimuth, width=96, height=96)
        _, alpha = rendered(block, camera)
        x, y, z, _ = (camera.viewmat() @ point).tolist()
        rows, columns = torch.meshgrid(torch.arange(96) + 0.5, torch.arange(96) + 0.5, indexing="ij")
        middle = [float((alpha * axis).sum() / alpha.sum()) for axis in (columns, rows)]
        assert middle == pytest.approx([48 + camera.focal * x / z, 48 + camera.focal * y / z], abs=0.5)


def blocks() -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    density = torch.zeros(SIZE, SIZE, BINS)
    for _ in range(12):
        row, column, depth = (int(torch.randint(8, high, (), generator=generator)) for high in (108, 108, 48))
        density[row : row + 9, column : column + 7, depth : depth + 6] = 0.3 * torch.rand((), generator=generator)
    return density


CAMERAS = [OrbitCamera(15 * e, a, r, width=40, height=40) for e, a, r in ((0, 0, 2), (1, 40, 2.4), (-2, 130, 1.6))]


@pytest.mark.parametrize("camera", CAMERAS)
def test_skipped_blocks_change_nothing(camera):
    volume = make_volume(blocks(), COLOR.expand(SIZE, SIZE, BINS, 3))
    everywhere = replace(volume, free=np.zeros_like(volume.free))
    found, expected = (render_volumes([each], [camera]) for each in (volume, everywhere))
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, atol=1e-3, rtol=0)  # places along a ray add up to rounded sums


@pytest.mark.parametrize("camera", CAMERAS)
def test_absorption_agrees_with_denser_samples(camera):
    _, alpha = rendered(blocks(), camera)
    error = (alpha - plain(blocks(), camera)).abs()
    assert error.mean() < 2e-3 and error.max() < 0.1  # rays that graze an edge between two samples


def plain(density: torch.Tensor, camera: OrbitCamera) -> torch.Tensor:
    """Alpha by samples four times as dense, everywhere."""
    matrix = camera.viewmat()
    steps = torch.arange(0.3, 3.6, STRIDE * CELL / 4, dtype=torch.float64)
    places = (torch.arange(camera.width) + 0.5 - camera.width / 2) / camera.focal
    rays = torch.stack([*torch.meshgrid(places, places, indexing="xy"), torch.ones(camera.height, camera.width)], -1)
    rays = torch.nn.functional.normalize(rays.double(), dim=-1)
    points = (steps[:, None, None, None] * rays - matrix[:3, 3]) @ matrix[:3, :3]
    depth = 2 - points[..., 2]
    across = torch.stack([points[..., 0], -points[..., 1]], -1) / depth[..., None] / TAN_HALF_FOV
    at = torch.cat([2 * (depth[..., None] - NEAR) / (FAR - NEAR) - 1, across], -1)
    found = grid_sample(density.double()[None, None], at[None], align_corners=False)[0, 0]
    return (1 - (-found.sum(0) * STRIDE / 4).exp()).float()


def test_views_do_not_depend_on_their_neighbors():
    volumes = [
        make_volume(box(slice(30, 90), slice(40, 80), slice(20 + 5 * i, 40), 0.2), torch.rand(SIZE, SIZE, BINS, 3))
        for i in range(2)
    ]
    cameras = [OrbitCamera(0, 30 + 90 * i, width=24, height=24) for i in range(2)]
    together = render_volumes(volumes, cameras)
    for i in range(2):
        alone = render_volumes(volumes[i : i + 1], cameras[i : i + 1])
        assert all(torch.equal(a[0], b[i]) for a, b in zip(alone, together, strict=True))


def test_cameras_of_two_sizes_are_refused():
    volume = make_volume(torch.zeros(SIZE, SIZE, BINS), torch.zeros(SIZE, SIZE, BINS, 3))
    with pytest.raises(BadInput, match="one size"):
        render_volumes([volume, volume], [OrbitCamera(), OrbitCamera(width=64, height=64)])
