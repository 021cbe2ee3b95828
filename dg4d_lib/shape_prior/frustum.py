"""Grid of rays and depths in front of the input camera, on which the shape prior speaks."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.cameras.orbit import FOV_Y_DEG, RADIUS

SIZE = 128  # pixels of a side, one ray each
BINS = 64  # depths along a ray
HALF_DEPTH = 0.85  # world units before and behind the plane z = 0
NEAR = RADIUS - HALF_DEPTH  # distance from the camera's plane, world units
FAR = RADIUS + HALF_DEPTH
KNOTS = 8  # depths at which hidden colors are predicted; linear between them
TAN_HALF_FOV = math.tan(math.radians(FOV_Y_DEG) / 2)


def grid_places(
    right: Float[Tensor, " n"], down: Float[Tensor, " n"], distance: Float[Tensor, " n"]
) -> Float[Tensor, "n 3"]:
    """Return the `grid_sample` coordinates of points in front of the camera: depth, column and row, in [-1, 1].

    Args:
        right: of the line of sight, world units.
        down: of the line of sight, world units.
        distance: from the camera's plane, world units.
    """
    away = distance.clamp(min=NEAR / 2)
    deep = 2 * (away - NEAR) / (FAR - NEAR) - 1
    return torch.stack([deep, right / away / TAN_HALF_FOV, down / away / TAN_HALF_FOV], -1)
