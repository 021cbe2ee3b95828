"""Depth from the inflation of the input view, moved along its rays to where the other views allow matter.

Opposite views leave the depth open. The inflation then says how thick the subject is at every pixel, and the hull says
where along the ray: the middle of a column moves to the nearest place at which the other silhouettes contain it.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float32, Float64
from scipy import ndimage
from torch.nn.functional import grid_sample

from dg4d_lib.cameras.orbit import FOV_Y_DEG, RADIUS
from dg4d_lib.inflation.heights import heights, outline_distance
from dg4d_lib.inflation.hints import DepthHint
from dg4d_lib.inflation.mask import subject_mask
from dg4d_lib.inflation.render import render_surface
from dg4d_lib.inflation.surface import inflate, resample
from dg4d_lib.metrics.image import iou
from dg4d_lib.visual_hull.carve import TRUNCATION, Volume, margins_of
from dg4d_lib.visual_hull.known import KnownView

SIZE = 128  # rays of a side
PLACES = 97  # depths tried on a ray
FARTHEST = 0.9  # world units: largest distance of a depth from the plane z = 0
TURNS_DEG = tuple(range(-45, 46, 5))
PREFERENCE = 0.0005  # IoU per degree by which a smaller turn is preferred
ROUNDS = 6  # of smoothing and moving
FARTHEST_STEP = 0.1  # world units by which a single column may leave the smooth middle: more makes spikes
SMOOTH = 4.0  # pixels of `SIZE`
DEEP_ENOUGH = 0.5  # of the margin in the input view: so far inside of the other silhouettes lies the middle of a column


def fitting_turn(views: Sequence[KnownView]) -> float:
    """Return the turn of the inflated input view (the first) whose silhouettes agree best with the other views."""
    small = [replace(v, cutout=resample(v.cutout, 64), camera=replace(v.camera, width=64, height=64)) for v in views]
    truth = torch.stack([view.cutout[..., 3:] for view in small[1:]])

    def agreement(turn_deg: float) -> float:
        surface = inflate(small[0].cutout, 64, DepthHint(turn_deg))
        _, alpha = render_surface(surface, [view.camera for view in small[1:]])
        return float(iou(alpha, truth).mean()) - PREFERENCE * abs(turn_deg)

    return float(max(TURNS_DEG, key=agreement))


def bounded(volume: Volume, views: Sequence[KnownView], turn_deg: float) -> Volume:
    """Return the part of a hull inside of the columns of the input view, the first of the views."""
    cutout = resample(views[0].cutout, SIZE).double().cpu().numpy()
    mask, _ = subject_mask(cutout[..., 3])
    pixel = 2 * RADIUS * math.tan(math.radians(FOV_Y_DEG) / 2) / SIZE
    thickness = heights(mask, pixel)
    across = (np.arange(SIZE) + 0.5 - SIZE / 2) * pixel
    plane = np.broadcast_to((math.tan(math.radians(turn_deg)) * across).clip(-FARTHEST, FARTHEST), mask.shape)
    middle = _moved(plane, outline_distance(mask) * pixel, mask, _allowed(views[1:], pixel), volume.step)
    return _inside(volume, middle, thickness, mask)


def _allowed(views: Sequence[KnownView], pixel: float) -> Float32[np.ndarray, "s s d"]:
    """Return the margin inside of the other silhouettes of places along the rays, world units."""
    rows, columns, depths = torch.meshgrid(
        torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, torch.linspace(-FARTHEST, FARTHEST, PLACES), indexing="ij"
    )
    share = (RADIUS - depths) / RADIUS
    x, y = (columns - SIZE / 2) * pixel * share, -(rows - SIZE / 2) * pixel * share
    points = torch.stack([x, y, depths], -1).reshape(-1, 3)
    margins: Float32[np.ndarray, "s s d"] = margins_of(views, points).reshape(SIZE, SIZE, PLACES).numpy()
    return margins


def _moved(
    plane: Float64[np.ndarray, "s s"],
    margin: Float64[np.ndarray, "s s"],
    mask: np.ndarray,
    allowed: Float32[np.ndarray, "s s d"],
    step: float,
) -> Float64[np.ndarray, "s s"]:
    """Return the depth of the middle of every column: smooth, and inside of the other silhouettes."""
    depths = np.linspace(-FARTHEST, FARTHEST, PLACES)
    needed = np.minimum(DEEP_ENOUGH * margin, 0.98 * allowed.max(-1))[..., None]
    fits = (allowed >= needed) & (allowed > 0)
    known = mask & fits.any(-1)
    if not known.any():
        return plane
    middle = np.array(plane)
    for _ in range(ROUNDS):
        cost = np.abs(depths - middle[..., None]) + np.where(fits, 0, 1e3)
        nearest = depths[cost.argmin(-1)]
        weight = ndimage.gaussian_filter(known.astype(float), SMOOTH)
        smooth = ndimage.gaussian_filter(np.where(known, nearest, 0.0), SMOOTH) / np.maximum(weight, 1e-6)
        rows, columns = ndimage.distance_transform_edt(weight < 1e-3, return_distances=False, return_indices=True)
        middle = smooth[rows, columns]
    cost = np.abs(depths - middle[..., None]) + np.where(allowed > step, 0, 1e3)
    nearest = depths[cost.argmin(-1)]
    return np.where(mask & (np.abs(nearest - middle) < FARTHEST_STEP), nearest, middle)


def _inside(
    volume: Volume, middle: Float64[np.ndarray, "s s"], thickness: Float64[np.ndarray, "s s"], mask: np.ndarray
) -> Volume:
    """Intersect a volume with columns of half a thickness to both sides of the middle."""
    rows, columns = ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True)
    planes = torch.from_numpy(np.stack([middle[rows, columns], thickness[rows, columns]])[None]).float()
    axes = [low + volume.step * np.arange(size) for low, size in zip(volume.low, volume.values.shape, strict=True)]
    x, y, z = (torch.from_numpy(a).float() for a in np.meshgrid(*axes, indexing="ij"))
    scale = 1 / ((RADIUS - z) * math.tan(math.radians(FOV_Y_DEG) / 2))
    at = torch.stack([x * scale, -y * scale], -1).reshape(1, 1, -1, 2)
    center, half = grid_sample(planes, at, align_corners=False, padding_mode="border")[0, :, 0]
    limit = TRUNCATION * volume.step
    margin = (half.clamp(min=volume.step) - (z.flatten() - center).abs()).reshape(volume.values.shape).numpy()
    lowest = min(-limit, float(volume.values.min()))
    return replace(volume, values=np.minimum(volume.values, margin).clip(lowest, limit).astype(np.float32))
