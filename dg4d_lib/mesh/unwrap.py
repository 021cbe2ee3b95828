"""A flat map of a surface: every triangle gets its own place in one square texture (xatlas)."""

import numpy as np
import xatlas
from jaxtyping import Float, Int
from scipy.sparse import coo_array, diags_array

from dg4d_lib.errors import DG4DError

PADDING = 2  # texels between charts, at least
SMOOTHING = 20  # Taubin steps; xatlas' time grows with roughness, so the charts are cut on a smooth copy
ATTEMPTS = 4  # packings with growing padding until it survives the fit into the square


def unwrap(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], size: int
) -> tuple[Int[np.ndarray, " w"], Int[np.ndarray, "f 3"], Float[np.ndarray, "w 2"]]:
    """Texture coordinates without overlaps.

    Args:
        vertices: any units.
        faces: counter-clockwise seen from outside.
        size: texels of a side of the square texture.

    Returns:
        For every new vertex the old one it copies (vertices are split along seams); the faces in their order, with new
        indices; and a place in [0, 1] for every new vertex, u right and v down. Charts are at least two texels apart.

    Raises:
        DG4DError: xatlas found no place for the charts.
    """
    smooth = taubin_smooth(vertices, faces).astype(np.float32)
    chart, pack = xatlas.ChartOptions(), xatlas.PackOptions()
    pack.resolution, pack.padding, pack.bilinear = size, 2 * PADDING, True
    for _ in range(ATTEMPTS):
        atlas = xatlas.Atlas()
        atlas.add_mesh(smooth, faces.astype(np.uint32))
        atlas.generate(chart, pack)
        # the atlas is a rectangle of about the wanted size; stretched to the square, its padding may shrink
        if pack.padding * size >= PADDING * max(atlas.width, atlas.height):
            copied, corners, uvs = atlas.get_mesh(0)
            return copied.astype(np.int32), corners.astype(np.int32), np.clip(uvs, 0, 1).astype(np.float32)
        pack.padding = int(np.ceil(1.5 * PADDING * max(atlas.width, atlas.height) / size))
    raise DG4DError(
        f"the texture has no room for the charts of {len(faces)} faces: {size} texels a side; "
        "raise mesh.texture_size or lower mesh.max_faces"
    )


def taubin_smooth(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], steps: int = SMOOTHING
) -> Float[np.ndarray, "v 3"]:
    """Smoothed by turns inwards and outwards, so that it hardly shrinks (Taubin 1995)."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ends = np.concatenate([ends, ends[:, ::-1]]).T
    graph = coo_array((np.ones(ends.shape[1]), tuple(ends)), shape=(len(vertices),) * 2).tocsr()
    graph.data[:] = 1  # an edge counts once, however many faces share it
    degree = graph.sum(axis=1)
    mean = diags_array(1 / np.maximum(degree, 1)) @ graph
    lonely = (degree == 0)[:, None]
    points = vertices.astype(np.float64)
    for step in range(steps):
        factor = 0.5 if step % 2 == 0 else -0.53
        points = np.where(lonely, points, points + factor * (mean @ points - points))
    return points
