"""UV unwrapping into one square texture: charts of low distortion, packed at a common scale."""

import numpy as np
from jaxtyping import Float, Int

from dg4d_lib.errors import DG4DError
from dg4d_lib.mesh.texturing.chart_packing import QUICK, Effort, pack_charts
from dg4d_lib.mesh.texturing.charts import find_charts
from dg4d_lib.mesh.texturing.smoothing import taubin_smooth
from dg4d_lib.mesh.texturing.xatlas_charts import unwrap_with_xatlas
from dg4d_lib.settings import UnwrapMethod

SMOOTHING = 10  # pairs of Taubin steps; charts follow normals of a smoothed copy, so that noise does not divide them


def unwrap(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    size: int,
    method: UnwrapMethod = "charts",
    effort: Effort = QUICK,
) -> tuple[Int[np.ndarray, " w"], Int[np.ndarray, "f 3"], Float[np.ndarray, "w 2"]]:
    """Unwrap a mesh: compute texture coordinates without overlaps.

    Args:
        vertices: any units.
        faces: counter-clockwise seen from outside.
        size: side of the square texture, texels.
        method: charts of this project, or those of xatlas, which may be mirrored.
        effort: ways of packing that are tried; not for xatlas.

    Returns:
        For every new vertex the index of the old one it copies (vertices are split along seams); the faces in their
        order, with new indices; and texture coordinates in [0, 1] of every new vertex, u right and v down. Charts show
        the surface as it is seen from outside, not mirrored, and are at least two texels apart.

    Raises:
        BackendUnavailable: xatlas is missing.
        DG4DError: the charts do not fit into the texture, or xatlas crashed.
    """
    smooth = taubin_smooth(vertices, faces, SMOOTHING)
    if method == "xatlas":
        return unwrap_with_xatlas(smooth, faces, size)
    charts = find_charts(vertices, faces, smooth)
    uvs = pack_charts(charts.flat, charts.faces, charts.labels, size, effort)
    if uvs is None:
        raise DG4DError(
            f"the charts of {len(faces)} faces do not fit into a texture of {size} x {size} texels; "
            "raise mesh.texture_size or lower mesh.max_faces"
        )
    return charts.sources.astype(np.int32), charts.faces.astype(np.int32), np.clip(uvs, 0, 1).astype(np.float32)
