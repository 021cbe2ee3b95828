"""A bank of true pictures: what an ideal prior would say. For tests and benchmarks."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.guidance.interface import View


@dataclass(frozen=True)
class Bank:
    """True pictures.

    Attributes:
        cameras: where they were taken.
        frames: when: indices into the driving video.
        pictures: RGBA, straight alpha, one row per camera, one column per frame.
    """

    cameras: tuple[OrbitCamera, ...]
    frames: tuple[int, ...]
    pictures: UInt8[Tensor, "v t h w 4"]

    def clean(self, views: Sequence[View]) -> tuple[Float[Tensor, "b h w 3"], Float[Tensor, "b h w 1"]]:
        """Color over white and coverage of views that are in the bank, resampled to the camera's size.

        Raises:
            BadInput: a view that is not in the bank.
        """
        places = {_pose(camera): i for i, camera in enumerate(self.cameras)}
        moments = {frame: i for i, frame in enumerate(self.frames)}
        try:
            rows = [places[_pose(view.camera)] for view in views]
            columns = [moments[view.frame] for view in views]
        except KeyError as missing:
            raise BadInput(
                f"the bank has no picture of {missing}; it has {len(places)} poses, frames {self.frames}"
            ) from None
        cutouts = self.pictures[rows, columns].float() / 255
        alpha = cutouts[..., 3:]
        both = torch.cat([cutouts[..., :3] * alpha + 1 - alpha, alpha], -1).permute(0, 3, 1, 2)
        size = (views[0].camera.height, views[0].camera.width)
        if both.shape[-2:] != size:
            both = functional.interpolate(both, size, mode="bilinear", antialias=True, align_corners=False)
        both = both.permute(0, 2, 3, 1)
        return both[..., :3], both[..., 3:]


def _pose(camera: OrbitCamera) -> tuple[float, float, float]:
    return (round(camera.elevation_deg, 3), round(camera.azimuth_deg % 360, 3), round(camera.radius, 3))
