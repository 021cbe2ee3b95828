"""UV charts by xatlas.

xatlas runs in a child process, `python -m dg4d_lib.mesh.texturing.xatlas_charts`, which exits without running
destructors: that of xatlas can deadlock while it stops its threads (seen about once in a hundred calls on a busy
machine).
"""

from importlib import import_module
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from dg4d_lib.errors import BackendUnavailable, DG4DError
from dg4d_lib.mesh.subprocess_runner import Arrays, run_in_subprocess, serve

PADDING = 2  # minimum distance between charts, texels
MOST_PADDING = (
    1 / 8
)  # of the side of the atlas: its padding grows, up to this, until it survives the fit into the square

_KEPT: list[Any] = []  # keeps the child's atlases alive, so that their destructors never run


def unwrap_with_xatlas(
    smooth: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], size: int
) -> tuple[Int[np.ndarray, " w"], Int[np.ndarray, "f 3"], Float[np.ndarray, "w 2"]]:
    """Unwrap a mesh; see `dg4d_lib.mesh.texturing.unwrap.unwrap`. Charts may be mirrored.

    Args:
        smooth: vertices of a smoothed copy; xatlas is slow on rough surfaces.
        faces: counter-clockwise seen from outside.
        size: side of the square texture, texels.

    Raises:
        BackendUnavailable: xatlas is missing.
        DG4DError: the charts do not fit into the texture, or xatlas crashed.
    """
    arrays = {"vertices": smooth.astype(np.float32), "faces": faces.astype(np.uint32), "size": np.array(size)}
    flat = run_in_subprocess("dg4d_lib.mesh.texturing.xatlas_charts", "unwrap the mesh", arrays)
    return flat["copied"], flat["corners"], flat["uvs"]


def _unwrap_in_child(arrays: Arrays) -> Arrays:
    """Unwrap the mesh in the child process."""
    try:
        xatlas: Any = import_module("xatlas")
    except ImportError as error:
        raise BackendUnavailable(f"xatlas cannot be imported ({error}); run `make setup`") from error
    vertices, faces, size = arrays["vertices"], arrays["faces"], int(arrays["size"])
    chart, pack = xatlas.ChartOptions(), xatlas.PackOptions()
    pack.resolution, pack.padding, pack.bilinear = size, 2 * PADDING, True
    while pack.padding <= size * MOST_PADDING:
        atlas = xatlas.Atlas()
        _KEPT.append(atlas)
        atlas.add_mesh(vertices, faces)
        atlas.generate(chart, pack)
        # The atlas is a rectangle of about the requested size; stretching it to the square may shrink its padding.
        if pack.padding * size >= PADDING * max(atlas.width, atlas.height):
            copied, corners, uvs = atlas.get_mesh(0)
            uvs = np.clip(uvs, 0, 1).astype(np.float32)
            return {"copied": copied.astype(np.int32), "corners": corners.astype(np.int32), "uvs": uvs}
        pack.padding = max(pack.padding + 1, int(np.ceil(1.2 * PADDING * max(atlas.width, atlas.height) / size)))
    raise DG4DError(
        f"the charts of {len(faces)} faces do not fit into a texture of {size} x {size} texels; "
        "raise mesh.texture_size or lower mesh.max_faces"
    )


if __name__ == "__main__":
    serve(_unwrap_in_child)
