"""Known cameras of any pose, expressed as orbit cameras around the subject.

The input camera becomes azimuth and elevation 0; its up axis is the world's. The subject is where the
optical axes meet.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.errors import BadInput

SMALLEST = 1e-12
LEAST_RIGHT = 0.9  # volume spanned by the unit axes of a camera: 1 if they are perpendicular and right-handed
LEAST_SPREAD = 0.02  # smallest singular value of the normal equations per camera: parallel axes meet nowhere
FARTHEST_MISS = 0.35  # distance of an axis from the meeting point, relative to the camera's distance


@dataclass(frozen=True)
class OrbitPlace:
    """Direction of a camera from the subject, relative to the input camera.

    Attributes:
        azimuth_deg: azimuth.
        elevation_deg: elevation.
        roll_deg: rotation of the camera about its axis, counter-clockwise.
        distance: to the subject, in distances of the input camera.
        center: subject in the picture, x and y over z in camera axes with y down.
    """

    azimuth_deg: float
    elevation_deg: float
    roll_deg: float
    distance: float
    center: tuple[float, float]


def meeting_point(poses: Float[Tensor, "k 3 4"]) -> Float[Tensor, " 3"]:
    """Return the point nearest to all optical axes.

    Raises:
        BadInput: the axes are parallel, or the point lies behind cameras or far from their axes.
    """
    lengths = poses[:, :, :3].norm(dim=1)
    volumes = torch.linalg.det(poses[:, :, :3]) / lengths.prod(-1).clamp(min=SMALLEST)
    if bad := [i for i, volume in enumerate(volumes.tolist()) if volume < LEAST_RIGHT]:
        raise BadInput(
            f"transform_matrix of frame {bad[0]} (counted from 0) is not a rotation and translation: its first three "
            "columns must be perpendicular axes, right, up and backward"
        )
    places, forward = poses[:, :, 3], -poses[:, :, 2] / lengths[:, 2:]
    projectors = torch.eye(3, dtype=poses.dtype) - forward[:, :, None] * forward[:, None]
    normal = projectors.sum(0)
    if float(torch.linalg.svdvals(normal)[-1]) < LEAST_SPREAD * len(poses):
        raise BadInput(
            "the cameras look in one direction, so the subject's position is unknown; give cameras around the subject"
        )
    point = torch.linalg.solve(normal, (projectors @ places[:, :, None]).sum(0)[:, 0])
    offsets = point - places
    ahead = (offsets * forward).sum(-1)
    miss = (offsets - ahead[:, None] * forward).norm(dim=-1)
    if bad := [i for i in range(len(poses)) if ahead[i] <= 0 or miss[i] > FARTHEST_MISS * ahead[i]]:
        named = ", ".join(str(i) for i in bad[:8])
        raise BadInput(
            f"cameras look away from the subject: frames {named} of {len(poses)} (counted from 0); transform_matrix is "
            "camera to world with axes right, up and backward, as nerfstudio writes it"
        )
    return point


def orbit_places(poses: Float[Tensor, "k 3 4"], reference: int, point: Float[Tensor, " 3"]) -> list[OrbitPlace]:
    """Return the directions of cameras around a point, relative to one of them.

    Args:
        poses: camera to world, OpenGL axes.
        reference: index of the input camera.
        point: the world's origin.
    """
    back = poses[reference, :, 3] - point
    unit = float(back.norm())
    if unit < SMALLEST:
        raise BadInput("the input's camera is inside of the subject; check its transform_matrix")
    z = back / unit
    x = torch.linalg.cross(poses[reference, :, 1], z)
    x = x / x.norm()
    world = torch.stack([x, torch.linalg.cross(z, x), z])  # rows: axes of the orbit's world
    return [_place(world, pose, point, unit) for pose in poses]


def _place(
    world: Float[Tensor, "3 3"], pose: Float[Tensor, "3 4"], point: Float[Tensor, " 3"], unit: float
) -> OrbitPlace:
    offset = world @ (pose[:, 3] - point)
    distance = float(offset.norm())
    direction = offset / distance
    elevation = math.asin(max(-1.0, min(1.0, float(direction[1]))))
    azimuth = math.atan2(float(direction[0]), float(direction[2]))
    right = torch.tensor([math.cos(azimuth), 0.0, -math.sin(azimuth)], dtype=pose.dtype)
    up = torch.linalg.cross(direction, right)
    own_up = world @ pose[:, 1]
    roll = math.atan2(-float(own_up @ right), float(own_up @ up))
    seen = pose[:, :3].T @ (point - pose[:, 3])
    center = (float(seen[0] / -seen[2]), float(-seen[1] / -seen[2]))
    return OrbitPlace(math.degrees(azimuth), math.degrees(elevation), math.degrees(roll), distance / unit, center)
