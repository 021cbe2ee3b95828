"""The surface of a density field."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from skimage.measure import marching_cubes

from dg4d_lib.errors import FitDiverged
from dg4d_lib.mesh.density import DensityField

LOWEST_SHARE = 0.25  # of the field's peak: where the surface is put when the level lies above the peak
LEAK = 2  # cells: an inner cavity that opens to the outside only through narrower gaps than twice this is filled


def surface(field: DensityField, level: float) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """The level set of the density: vertices in world units, faces counter-clockwise seen from outside.

    It is closed, also where the matter touches the border of the box, and has no inner walls: cavities are filled, those
    too whose only way out is a gap of a few cells.

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
    ball = ndimage.generate_binary_structure(3, 1)
    padded = np.pad(solid, LEAK + 1)
    thick = ndimage.binary_dilation(padded, ball, iterations=LEAK)
    room = ndimage.binary_fill_holes(thick) & ~thick
    inside = padded | ndimage.binary_dilation(room, ball, iterations=LEAK)
    border = slice(LEAK + 1, -LEAK - 1)
    return (ndimage.binary_fill_holes(inside) & ~padded)[border, border, border]
