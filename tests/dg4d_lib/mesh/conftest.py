"""Clouds and meshes of known shape."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from skimage.measure import marching_cubes

from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.spherical_harmonics import rgb_to_sh

Cloud = Callable[..., Gaussians]


def _points_on_a_sphere(count: int) -> torch.Tensor:
    i = torch.arange(count) + 0.5
    height, turn = 1 - 2 * i / count, i * math.pi * (1 + 5**0.5)
    width = (1 - height.square()).sqrt()
    return torch.stack([width * turn.cos(), height, width * turn.sin()], -1)


@pytest.fixture(scope="session")
def sphere_of_gaussians() -> Cloud:
    """Flat Gaussians on a sphere: how many, its radius and a color of every point of the unit sphere."""

    def make(
        count: int = 600, radius: float = 0.5, color: Callable[[torch.Tensor], torch.Tensor] = lambda p: 0 * p + 0.5
    ) -> Gaussians:
        points = _points_on_a_sphere(count)
        across = 1.5 * radius * math.sqrt(4 * math.pi / count) / 2
        scales = torch.tensor([across, across, 0.1 * across]).expand(count, 3)
        # from +z to the normal: the half-way quaternion
        quats = torch.stack([1 + points[:, 2], -points[:, 1], points[:, 0], 0 * points[:, 0]], -1)
        harmonics = rgb_to_sh(color(points))
        return Gaussians(radius * points, scales.log(), quats, torch.full((count,), 3.0), harmonics)

    return make


@pytest.fixture(scope="session")
def sphere() -> tuple[np.ndarray, np.ndarray]:
    """A sphere of marching cubes of radius 0.5: float32 vertices, int32 faces, outwards."""
    axis = np.linspace(-1, 1, 41)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    vertices, faces, _, _ = marching_cubes(0.5 - np.sqrt(x * x + y * y + z * z), 0.0)
    return (vertices * 0.05 - 1).astype(np.float32), faces[:, ::-1].astype(np.int32)
