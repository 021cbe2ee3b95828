"""Silhouettes of meshes and Gaussians, and their intersection over union."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import interpolate

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh
from dg4d_lib.rasterizer.interface import Rasterizer

SIZE = 128  # pixels of a silhouette
VIEWS = ((0.0, 2.0), (75.0, 1.0))  # azimuth in degrees and weight; people compare at the input view, so it counts twice
ALPHA_THRESHOLD = 0.5  # alpha above which a pixel belongs to the subject


def render_silhouettes(
    states: Gaussians,
    frames: Sequence[int],
    rasterize: Rasterizer,
    alpha: Float[Tensor, "m i j"] | None = None,
) -> Bool[Tensor, "m k h w"]:
    """Render silhouettes of the Gaussians at m frames from k views.

    Args:
        states: the cloud at every frame (fields "t n 3").
        frames: indices of the frames to render.
        rasterize: the splatting backend.
        alpha: of the driving video at these frames, which takes the place of the Gaussians at the input view.
    """
    selected = states.states(frames)
    black = torch.zeros(3, device=states.means.device)
    with torch.no_grad():
        views = [
            rasterize(selected, cameras, black).alpha[..., 0] > ALPHA_THRESHOLD for cameras in cameras_of(len(frames))
        ]
    if alpha is not None:
        views[0] = interpolate(alpha[:, None], (SIZE, SIZE), mode="area")[:, 0].to(black) > ALPHA_THRESHOLD
    return torch.stack(views, 1)


def silhouette_iou(
    vertices: Float[Tensor, "m v 3"], faces: Int[Tensor, "f 3"], silhouettes: Bool[Tensor, "m k h w"]
) -> Float[Tensor, " m"]:
    """Return the intersection over union of a mesh's silhouettes with given ones, weighted mean over views, in [0, 1].

    Args:
        vertices: of the mesh at m frames, world units.
        faces: indices into the vertices.
        silhouettes: output of `render_silhouettes` for these frames, or its first views.
    """
    total, weights = torch.zeros(len(vertices)), 0.0
    for view, cameras in enumerate(cameras_of(len(vertices))[: silhouettes.shape[1]]):
        rendered = rasterize_mesh(vertices, faces, cameras).faces >= 0
        expected = silhouettes[:, view]
        intersection, union = (mask.flatten(1).sum(1) for mask in (rendered & expected, rendered | expected))
        total += VIEWS[view][1] * torch.where(union > 0, intersection / union.clamp(min=1), 1.0).cpu()
        weights += VIEWS[view][1]
    return total / weights


def cameras_of(frames: int) -> list[list[OrbitCamera]]:
    """Return the camera of every frame, for each view."""
    return [[OrbitCamera(0, azimuth, width=SIZE, height=SIZE)] * frames for azimuth, _ in VIEWS]


def enlarged_masks(alpha: Float[Tensor, "t h w"], size: int) -> Bool[Tensor, "t s s"]:
    """Return the masks of a subject at another size, pixels."""
    return interpolate(alpha[:, None], (size, size), mode="bicubic")[:, 0] > ALPHA_THRESHOLD


def surroundings(mask: Bool[np.ndarray, "h w"], margin: int) -> tuple[slice, slice]:
    """Return the rows and columns of the bounding box of a mask with a margin; none if it is empty."""
    rows, columns = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
    if len(rows) == 0:
        return slice(0, 0), slice(0, 0)
    down, across = (slice(max(0, int(at[0]) - margin), int(at[-1]) + 1 + margin) for at in (rows, columns))
    return down, across
