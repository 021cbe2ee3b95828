"""How far meshes have the outlines of the Gaussians."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh
from dg4d_lib.rasterizer.interface import Rasterizer

SIZE = 128  # pixels of an outline
VIEWS = ((0.0, 2.0), (75.0, 1.0))  # azimuth in degrees and weight: an eye compares at the input view
SOLID = 0.5  # alpha from which a pixel belongs to the subject


def outlines_of(states: Gaussians, moments: Sequence[int], rasterize: Rasterizer) -> Bool[Tensor, "m k h w"]:
    """What the Gaussians cover at some moments, seen from k sides.

    Args:
        states: the cloud at every frame (fields "t n 3").
        moments: frames.
        rasterize: the splatting backend.
    """
    some = states.states(moments)
    black = torch.zeros(3, device=states.means.device)
    with torch.no_grad():
        views = [rasterize(some, cameras, black).alpha[..., 0] > SOLID for cameras in _cameras(len(moments))]
    return torch.stack(views, 1)


def agreement(
    vertices: Float[Tensor, "m v 3"], faces: Int[Tensor, "f 3"], outlines: Bool[Tensor, "m k h w"]
) -> Float[Tensor, " m"]:
    """Intersection over union of what a mesh covers at m moments with the outlines, a mean over views, in [0, 1]."""
    total = torch.zeros(len(vertices))
    for view, cameras in enumerate(_cameras(len(vertices))):
        drawn = rasterize_mesh(vertices, faces, cameras).faces >= 0
        truth = outlines[:, view]
        shared, either = (mask.flatten(1).sum(1) for mask in (drawn & truth, drawn | truth))
        total += VIEWS[view][1] * (shared / either.clamp(min=1)).cpu()
    return total / sum(weight for _, weight in VIEWS)


def _cameras(moments: int) -> list[list[OrbitCamera]]:
    return [[OrbitCamera(0, azimuth, width=SIZE, height=SIZE)] * moments for azimuth, _ in VIEWS]
