"""Mesh cleaning in a child process: smoothing, isotropic remeshing, repair and decimation."""

import numpy as np
from jaxtyping import Float, Int

from dg4d_lib.errors import BadInput, DG4DError
from dg4d_lib.mesh.extraction.topology import face_components, orient_outward
from dg4d_lib.mesh.subprocess_runner import Arrays, run_in_subprocess
from dg4d_lib.settings import MeshSettings

PROGRAM = "dg4d_lib.mesh.extraction.pymeshlab_program"
SHRUNK = 0.5  # diagonal of the bounding box, relative to that of the largest component before: below, it collapsed


def clean(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], settings: MeshSettings, unit: float = 1.0
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    """Merge vertices, drop small components, smooth, remesh, repair, close holes and decimate; deterministic.

    Edges get the length `settings.edge_length`, or more where that would exceed `settings.max_faces` faces. Where
    handles prevent decimation to that limit, the surface is resampled on coarser and coarser grids.

    Args:
        vertices: world units.
        faces: counter-clockwise seen from outside, as those of the result.
        settings: mesh settings.
        unit: world length of one unit of the normalized box, in which `edge_length` is given.

    Raises:
        BadInput: there are no faces.
        BackendUnavailable: pymeshlab or a system library that its filters need is missing.
        DG4DError: the cleaning process crashed or left no faces, or edges are so long that the surface collapsed.
    """
    if len(faces) == 0:
        raise BadInput("a mesh without faces cannot be cleaned; lower mesh.density_threshold")
    vertices, faces = drop_small_components(vertices, faces, settings.min_component)
    length = max(settings.edge_length, _edge_length_for(vertices / unit, faces, settings.max_faces))
    arrays: Arrays = {
        "vertices": np.asarray(vertices, np.float64) / unit,
        "faces": np.asarray(faces, np.int32),
        "edge_length": np.array(length),
        "max_faces": np.array(settings.max_faces),
    }
    largest, _ = drop_small_components(arrays["vertices"], arrays["faces"], 1.0)
    cleaned = run_in_subprocess(PROGRAM, "clean the mesh", arrays)
    vertices, faces = drop_small_components(cleaned["vertices"], cleaned["faces"], settings.min_component)
    if len(faces) == 0:
        raise DG4DError("mesh cleaning left no faces; raise mesh.grid or lower mesh.edge_length")
    share = _diagonal(cleaned["vertices"]) / _diagonal(largest)  # small components may vanish or be dropped
    if share < SHRUNK:
        advice = "lower mesh.edge_length" if length <= settings.edge_length else "raise mesh.max_faces"
        raise DG4DError(
            f"mesh cleaning shrank the surface to {share:.1%} of its size, at least {SHRUNK:.0%} is allowed: edges of "
            f"{length:.3g} units of the normalized box are too long for it; {advice}"
        )
    return (vertices * unit).astype(np.float32), orient_outward(vertices, faces).astype(np.int32)


def drop_small_components(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], share: float
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    """Keep the connected components with at least this share of the faces, and always the largest one."""
    if len(faces) == 0:
        return vertices[:0], faces
    component = face_components(len(vertices), faces)
    sizes = np.bincount(component)
    kept = faces[(sizes >= min(share * len(faces), sizes.max()))[component]]
    used, renumbered = np.unique(kept, return_inverse=True)
    return vertices[used], renumbered.reshape(kept.shape).astype(faces.dtype)


def _diagonal(vertices: Float[np.ndarray, "v 3"]) -> float:
    return float(np.linalg.norm(np.ptp(vertices, axis=0)))


def _edge_length_for(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], count: int) -> float:
    """Return the edge length at which 0.9 * `count` equilateral triangles cover the surface."""
    a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    return float(np.sqrt(area / (0.9 * count) * 4 / np.sqrt(3)))
