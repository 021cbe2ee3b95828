"""The surface of a density field."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from skimage.measure import marching_cubes

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import FitDiverged
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.extraction.density import DensityField
from dg4d_lib.mesh.extraction.silhouettes import SOLID
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh
from dg4d_lib.rasterizer.interface import Rasterizer

LOWEST_SHARE = 0.25  # of the field's peak: where the surface is put when the level lies above the peak
LEAK = 2  # cells: an inner cavity that opens to the outside only through narrower gaps than twice this is filled

STEP = 2**0.5  # between levels that are tried
MOST_STEPS = 4  # away from the given level
# Where outlines are compared: elevation and azimuth in degrees; the input view, where an eye compares, counts twice.
OUTLINE_VIEWS_DEG = ((0, 0), (0, 0), (0, 90), (0, 180), (0, 270), (35, 45), (-35, 225))
OUTLINE_SIZE = 192  # pixels


def surface(field: DensityField, level: float) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """The level set of the density: vertices in world units, faces counter-clockwise seen from outside.

    It is closed, also where the matter touches the border of the box, and has no inner walls: cavities are filled,
    those too whose only way out is a gap of a few cells.

    Raises:
        FitDiverged: the field stays below the level everywhere (`usable_level` gives one that works).
    """
    values = field.values.numpy()
    if not values.max() > level:
        raise FitDiverged(f"no surface: the density reaches {values.max():.3g}, the level is {level:.3g}")
    filled = np.where(_cavities(values >= level), np.float32(2 * level), values)
    vertices, faces, _, _ = marching_cubes(np.pad(filled, 1), level)
    world = (vertices.astype(np.float64) - 1) * field.cell + field.origin.double().numpy()
    return world.astype(np.float32), faces[:, ::-1].astype(np.int32)


def best_level(field: DensityField, gaussians: Gaussians, rasterize: Rasterizer, level: float) -> tuple[float, float]:
    """The level whose surface has the outlines of the Gaussians themselves, to a factor of the fourth root of 2.

    How dense opaque matter is depends on how a fit spreads it over Gaussians; the outline (alpha above one half) does
    not.

    Args:
        field: of these Gaussians.
        gaussians: one state.
        rasterize: the splatting backend.
        level: where the search begins.

    Returns:
        The best level, within a factor of five of the given one, and the intersection over union of its outlines with
        the Gaussians' over all views, in [0, 1].

    Raises:
        FitDiverged: the field is zero everywhere.
    """
    cameras = [OrbitCamera(e, a, width=OUTLINE_SIZE, height=OUTLINE_SIZE) for e, a in OUTLINE_VIEWS_DEG]
    with torch.no_grad():
        truth = rasterize(gaussians, cameras, torch.zeros(3)).alpha[..., 0] > SOLID

    def agreement(candidate: float) -> float:
        if not float(field.values.max()) > candidate:
            return -1.0
        vertices, faces = surface(field, candidate)
        drawn = rasterize_mesh(torch.from_numpy(vertices), torch.from_numpy(faces), cameras).faces >= 0
        return float((drawn & truth).sum() / (drawn | truth).sum().clamp_min(1))

    start = usable_level(field, level)
    best, score = start, agreement(start)
    for factor, steps in ((1 / STEP, MOST_STEPS), (STEP, MOST_STEPS), (STEP**-0.5, 1), (STEP**0.5, 1)):
        for _ in range(steps):
            tried = agreement(best * factor)
            if tried <= score:
                break
            best, score = best * factor, tried
    return best, score


def usable_level(field: DensityField, level: float) -> float:
    """The level itself, or a quarter of the field's peak where the field does not reach the level.

    Raises:
        FitDiverged: the field is zero everywhere.
    """
    peak = float(field.values.max())
    if peak <= 0:
        raise FitDiverged("no surface: the density is zero everywhere; the model is empty, fit it again")
    return level if peak > level else LOWEST_SHARE * peak


def _cavities(solid: Bool[np.ndarray, "r r r"]) -> Bool[np.ndarray, "r r r"]:
    """Empty samples that a ball of `LEAK` cells cannot reach from outside, though there is room for it."""
    padded = np.pad(solid, LEAK + 1)
    thick = _grown(padded)
    room = ~_outside(thick) & ~thick
    inside = ~_outside(padded | _grown(room)) & ~padded
    border = slice(LEAK + 1, -LEAK - 1)
    return inside[border, border, border]


def _outside(solid: Bool[np.ndarray, "r r r"]) -> Bool[np.ndarray, "r r r"]:
    """The empty samples that hang together with the first one."""
    pieces, _ = ndimage.label(~solid)
    return pieces == pieces[0, 0, 0]


def _grown(solid: Bool[np.ndarray, "r r r"]) -> Bool[np.ndarray, "r r r"]:
    """Every sample within `LEAK` steps along the axes of a solid one."""
    for _ in range(LEAK):
        grown = solid.copy()
        for axis in range(3):
            target, source = np.moveaxis(grown, axis, 0), np.moveaxis(solid, axis, 0)
            target[1:] |= source[:-1]
            target[:-1] |= source[1:]
        solid = grown
    return solid
