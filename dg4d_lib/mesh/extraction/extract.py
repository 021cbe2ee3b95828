"""Isosurface extraction from a density field, and selection of its level."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from skimage.measure import marching_cubes
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import FitDiverged
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.extraction.density import DensityField
from dg4d_lib.mesh.extraction.silhouettes import ALPHA_THRESHOLD
from dg4d_lib.mesh.extraction.solid import cavities
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh
from dg4d_lib.rasterizer.interface import Rasterizer

LOWEST_SHARE = 0.25  # of the field's peak; the level used when the given one lies above the peak

STEP = 2**0.5  # ratio of successive trial levels
MAX_STEPS = 4  # trial levels on either side of the given one
# Views for comparing silhouettes: elevation and azimuth in degrees. The first is the input view.
SILHOUETTE_VIEWS_DEG = ((0, 0), (0, 90), (0, 180), (0, 270), (35, 45), (-35, 225))
SILHOUETTE_SIZE = 192  # pixels


def extract_surface(field: DensityField, level: float) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Extract the level set of the density: vertices in world units, faces counter-clockwise seen from outside.

    The surface is closed, even where the density touches the border of the box, and has no inner walls: cavities are
    filled, including those that open to the outside only through a gap of a few cells.

    Raises:
        FitDiverged: the field is below the level everywhere (see `usable_level`).
    """
    values = field.values.numpy()
    if not values.max() > level:
        raise FitDiverged(
            f"no surface: the largest density is {values.max():.3g}, below the level {level:.3g}; lower the level"
        )
    filled = np.where(cavities(values >= level), np.float32(2 * level), values)
    vertices, faces, _, _ = marching_cubes(np.pad(filled, 1), level)
    world = (vertices.astype(np.float64) - 1) * field.cell + field.origin.double().numpy()
    return world.astype(np.float32), faces[:, ::-1].astype(np.int32)


def select_level(field: DensityField, gaussians: Gaussians, rasterize: Rasterizer, level: float) -> tuple[float, float]:
    """Search the level whose surface matches the silhouettes of the Gaussians best, to a factor of 2^(1/4).

    The density inside an opaque object depends on the number and size of the Gaussians that a fit uses for it; the
    silhouette (alpha above 0.5) does not.

    Args:
        field: the density of these Gaussians.
        gaussians: one state.
        rasterize: the splatting backend.
        level: start of the search.

    Returns:
        The best level, within a factor of five of the given one, and the intersection over union of its silhouettes
        with those of the Gaussians over all views, in [0, 1]. The input view, where people compare, counts twice.

    Raises:
        FitDiverged: the field is zero everywhere.
    """
    cameras, expected = surrounding_silhouettes(gaussians, rasterize)

    def iou(candidate: float) -> float:
        if not float(field.values.max()) > candidate:
            return -1.0
        vertices, faces = extract_surface(field, candidate)
        rendered = rasterize_mesh(torch.from_numpy(vertices), torch.from_numpy(faces), cameras).faces >= 0
        shared, either = ((rendered & expected).sum((1, 2)), (rendered | expected).sum((1, 2)))
        return float((shared.sum() + shared[0]) / (either.sum() + either[0]).clamp_min(1))

    best = usable_level(field, level)
    best_iou = iou(best)
    for factor, steps in ((1 / STEP, MAX_STEPS), (STEP, MAX_STEPS), (STEP**-0.5, 1), (STEP**0.5, 1)):
        for _ in range(steps):
            candidate_iou = iou(best * factor)
            if candidate_iou <= best_iou:
                break
            best, best_iou = best * factor, candidate_iou
    return best, best_iou


def surrounding_silhouettes(
    gaussians: Gaussians, rasterize: Rasterizer
) -> tuple[list[OrbitCamera], Bool[Tensor, "v h w"]]:
    """Return cameras all around, that of the input view first, and the silhouettes of the Gaussians in them.

    Args:
        gaussians: one state.
        rasterize: the splatting backend.
    """
    cameras = [OrbitCamera(e, a, width=SILHOUETTE_SIZE, height=SILHOUETTE_SIZE) for e, a in SILHOUETTE_VIEWS_DEG]
    with torch.no_grad():
        alpha = rasterize(gaussians, cameras, torch.zeros(3)).alpha[..., 0]
    return cameras, (alpha > ALPHA_THRESHOLD).cpu()


def usable_level(field: DensityField, level: float) -> float:
    """Return the level, or a quarter of the field's peak if the field does not reach the level.

    Raises:
        FitDiverged: the field is zero everywhere.
    """
    peak = float(field.values.max())
    if peak <= 0:
        raise FitDiverged("no surface: the density is zero everywhere; the model is empty, fit it again")
    return level if peak > level else LOWEST_SHARE * peak
