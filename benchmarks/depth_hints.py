"""Hints at depth that a user may give, made of true depths."""

import math
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage
from torch import Tensor

from dg4d_lib.cameras.orbit import RADIUS, OrbitCamera
from dg4d_lib.inflation.heights import heights
from dg4d_lib.inflation.hints import DISTANCE_SIGMA, DepthField, DepthHint, depth_field, layer_field, pixel_size
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh
from dg4d_lib.shape_prior.frustum import FAR, NEAR
from training.shape_prior.samples import Sample

NOISE, NOISE_PIXELS = 0.05, 3.0  # standard deviation of the noisy depth, world units, and of its smoothness
LARGEST_TURN_DEG = 60.0
NAMES = ("nothing", "turn", "layers", "inverse depth", "noisy inverse depth", "distances", "noisy distances", "place")


def sample_depth(sample: Sample) -> Float[Tensor, "s s"]:
    """Return the distance of the first surface of a synthetic shape from the camera's plane; 0 where there is none."""
    size = len(sample.picture)
    depth = np.zeros(size * size, np.float32)
    depth[sample.pixels] = NEAR + sample.depths[:, 0].astype(np.float32) / 65535 * (FAR - NEAR)
    return torch.from_numpy(depth.reshape(size, size))


def mesh_depth(path: Path, size: int) -> Float[Tensor, "s s"]:
    """Return the distance of the first frame of a true mesh from the input camera's plane; 0 where there is none."""
    with np.load(path) as arrays:
        vertices, faces = arrays["vertices"][0].astype(np.float32), arrays["faces"].astype(np.int64)
    camera = OrbitCamera(width=size, height=size)
    return rasterize_mesh(torch.from_numpy(vertices), torch.from_numpy(faces), [camera]).depth[0]


def hints_of(depth: Float[Tensor, "s s"], alpha: Float[Tensor, "s s"]) -> dict[str, DepthHint]:
    """Return hints of several kinds.

    "place" gives distances and the position along the view, which no depth picture of a single subject contains.

    Args:
        depth: distance of the first surface from the camera's plane, world units; 0 where there is none.
        alpha: of the subject.
    """
    size = len(depth)
    known = (depth > 0) & (alpha > 0.5)
    inside = known.numpy()
    truth = RADIUS - depth.double().numpy() - heights(alpha.numpy() > 0.5, pixel_size(size))
    across = np.broadcast_to((np.arange(size) + 0.5 - size / 2) * pixel_size(size), truth.shape)[inside]
    slope = np.polyfit(across, truth[inside], 1)[0]
    turn_deg = float(np.clip(math.degrees(math.atan(slope)), -LARGEST_TURN_DEG, LARGEST_TURN_DEG))
    low, high = np.quantile(truth[inside], (1 / 3, 2 / 3))
    levels = torch.from_numpy(0.5 * ((truth > low).astype(np.float32) + (truth > high)))
    noise = ndimage.gaussian_filter(np.random.default_rng(0).normal(size=truth.shape), NOISE_PIXELS)
    noisy = (depth + NOISE * torch.from_numpy(noise / noise.std()).float()).clamp(min=0.1)
    exact = DepthField(torch.from_numpy(np.where(inside, truth, 0)).float(), known, DISTANCE_SIGMA)
    fields = {
        "layers": layer_field(levels, known, alpha),
        "inverse depth": depth_field(1 / depth.clamp(min=0.1), known.float(), alpha, "inverse"),
        "noisy inverse depth": depth_field(1 / noisy, known.float(), alpha, "inverse"),
        "distances": depth_field(depth, known.float(), alpha, "distance"),
        "noisy distances": depth_field(noisy, known.float(), alpha, "distance"),
        "place": exact,
    }
    found = {"nothing": DepthHint(), "turn": DepthHint(turn_deg)} | {k: DepthHint(None, f) for k, f in fields.items()}
    return {name: found[name] for name in NAMES}
