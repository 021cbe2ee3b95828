"""Oracle prior for tests and benchmarks: a bank of ground-truth views, optionally perturbed."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.ndimage import gaussian_filter, shift
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.images import over_white, resize_planes, to_bytes
from dg4d_lib.settings import OraclePriorSettings


@dataclass(frozen=True)
class Bank:
    """Ground-truth views.

    Attributes:
        cameras: of the rows.
        frames: of the columns, indices into the driving video.
        pictures: RGBA, straight alpha, one row per camera, one column per frame.
        weights: reliability of every camera's pictures, in [0, 1]; empty: 1.
    """

    cameras: tuple[OrbitCamera, ...]
    frames: tuple[int, ...]
    pictures: UInt8[Tensor, "v t h w 4"]
    weights: tuple[float, ...] = ()

    def clean(self, views: Sequence[GuidanceView]) -> tuple[Float[Tensor, "b h w 3"], Float[Tensor, "b h w 1"]]:
        """Return color over white and alpha of views in the bank, resized to the camera's size.

        Raises:
            BadInput: a view that is not in the bank.
        """
        rows_by_pose = {_pose(camera): i for i, camera in enumerate(self.cameras)}
        columns_by_frame = {frame: i for i, frame in enumerate(self.frames)}
        try:
            rows = [rows_by_pose[_pose(view.camera)] for view in views]
            columns = [columns_by_frame[view.frame] for view in views]
        except KeyError as missing:
            raise BadInput(
                f"the bank has no view {missing}; it has {len(rows_by_pose)} poses and frames {self.frames}"
            ) from None
        cutouts = self.pictures[rows, columns].float() / 255
        alpha = cutouts[..., 3:]
        both = torch.cat([over_white(cutouts), alpha], -1).permute(0, 3, 1, 2)
        size = (views[0].camera.height, views[0].camera.width)
        if both.shape[-2:] != size:
            both = resize_planes(both, size)
        both = both.permute(0, 2, 3, 1)
        return both[..., :3], both[..., 3:]


def perturb(bank: Bank, settings: OraclePriorSettings, generator: torch.Generator) -> Bank:
    """Perturb the view bank with blur, gain, shift and pose noise.

    The perturbations are drawn once, so that the prior is the same in every iteration. They are drawn in the order of
    the bank: perturb the whole bank before taking frames from it, so that a frame has the same errors in every fit.

    Args:
        bank: ground-truth views, of all frames.
        settings: standard deviations; zeros return the bank unchanged.
        generator: draws the perturbations.
    """
    pictures, cameras = bank.pictures, bank.cameras
    if settings.blur or settings.shift:
        shifts = settings.shift * torch.randn(*pictures.shape[:2], 2, generator=generator)
        shifted = [_blur_and_shift(view, settings.blur, shift) for view, shift in zip(pictures, shifts, strict=True)]
        pictures = torch.stack(shifted)
    if settings.color_gain:
        gains = torch.exp(settings.color_gain * torch.randn(*pictures.shape[:2], 1, 1, 3, generator=generator))
        tinted = [(view[..., :3] * gain).clamp(0, 255).round() for view, gain in zip(pictures, gains, strict=True)]
        pictures = torch.cat([torch.stack(tinted).to(torch.uint8), pictures[..., 3:]], -1)
    if settings.pose_deg:
        errors = (settings.pose_deg * torch.randn(len(cameras), 2, generator=generator)).tolist()
        cameras = tuple(
            replace(camera, elevation_deg=camera.elevation_deg + up, azimuth_deg=camera.azimuth_deg + around)
            for camera, (up, around) in zip(cameras, errors, strict=True)
        )
    return Bank(cameras, bank.frames, pictures, bank.weights)


def _blur_and_shift(
    pictures: UInt8[Tensor, "t h w 4"], sigma: float, shifts: Float[Tensor, "t 2"]
) -> UInt8[Tensor, "t h w 4"]:
    """Blur and shift cut-outs with premultiplied alpha, so that no background color bleeds in."""
    straight = pictures.float() / 255
    planes = torch.cat([straight[..., :3] * straight[..., 3:], straight[..., 3:]], -1).numpy()
    planes = gaussian_filter(planes, (0, sigma, sigma, 0), mode="constant")
    shifted = [shift(plane, (*by, 0), order=1) for plane, by in zip(planes, shifts.tolist(), strict=True)]
    soft = torch.from_numpy(np.stack(shifted))
    color = soft[..., :3] / soft[..., 3:].clamp(min=1e-6)
    return to_bytes(torch.cat([color, soft[..., 3:]], -1))


def _pose(camera: OrbitCamera) -> tuple[float, float, float]:
    azimuth_deg = round(camera.azimuth_deg % 360, 3) % 360  # just below 0 is 0, not 360
    return (round(camera.elevation_deg, 3), azimuth_deg, round(camera.radius, 3))
