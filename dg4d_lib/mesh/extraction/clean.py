"""Mesh cleaning with pymeshlab: smoothing, isotropic remeshing, repair and decimation.

pymeshlab is GPL-3 and crashes when two threads of a process use it. So it runs in a child process,
`python -m dg4d_lib.mesh.extraction.clean`, and is imported nowhere else.
"""

from importlib import import_module
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from dg4d_lib.errors import BackendUnavailable, BadInput, DG4DError
from dg4d_lib.mesh.extraction.topology import face_components, orient_outward
from dg4d_lib.mesh.subprocess_runner import Arrays, run_in_subprocess, serve
from dg4d_lib.settings import MeshSettings

MERGE = 1e-4  # distance below which vertices are merged, units of the normalized box
SMOOTHING = 10  # Taubin steps; they remove the staircase of marching cubes and keep the volume
REMESHING = 3  # iterations of isotropic remeshing
MAX_HOLE = 100  # edges; larger holes stay open
FIRST_CELL = 0.5  # cell of the first resampling, in edge lengths, when handles prevent decimation
CELL_GROWTH = 1.25  # factor from one resampling to the next, until there are few enough faces
FILTERS = (
    "meshing_merge_close_vertices",
    "meshing_remove_duplicate_faces",
    "meshing_remove_null_faces",
    "apply_coord_taubin_smoothing",
    "meshing_isotropic_explicit_remeshing",
    "generate_resampled_uniform_mesh",
    "meshing_decimation_quadric_edge_collapse",
    "meshing_repair_non_manifold_edges",
    "meshing_repair_non_manifold_vertices",
    "meshing_close_holes",
    "meshing_re_orient_faces_coherently",
    "meshing_remove_unreferenced_vertices",
)


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
        DG4DError: the cleaning process crashed or left no faces.
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
    cleaned = run_in_subprocess("dg4d_lib.mesh.extraction.clean", "clean the mesh", arrays)
    vertices, faces = drop_small_components(cleaned["vertices"], cleaned["faces"], settings.min_component)
    if len(faces) == 0:
        raise DG4DError("mesh cleaning left no faces; raise mesh.grid or lower mesh.edge_length")
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


def _edge_length_for(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], count: int) -> float:
    """Return the edge length at which 0.9 * `count` equilateral triangles cover the surface."""
    a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    return float(np.sqrt(area / (0.9 * count) * 4 / np.sqrt(3)))


def _clean_in_child(arrays: Arrays) -> Arrays:
    """Clean the mesh in the child process, in units of the normalized box."""
    try:
        # Untyped: its names come from a star import that type checkers cannot follow.
        pymeshlab: Any = import_module("pymeshlab")
    except ImportError as error:
        raise _unavailable(f"pymeshlab cannot be imported ({error})") from error
    missing = sorted(set(FILTERS) - set(pymeshlab.filter_list()))
    if missing:
        raise _unavailable(f"pymeshlab lacks the filter {missing[0]} and {len(missing) - 1} other required ones")
    length, max_faces = float(arrays["edge_length"]), int(arrays["max_faces"])
    ms = pymeshlab.MeshSet(verbose=False)
    ms.add_mesh(pymeshlab.Mesh(arrays["vertices"], arrays["faces"]))
    ms.meshing_merge_close_vertices(threshold=pymeshlab.PureValue(MERGE))
    ms.meshing_remove_duplicate_faces()
    ms.meshing_remove_null_faces()
    ms.apply_coord_taubin_smoothing(stepsmoothnum=SMOOTHING, selected=False)
    ms.meshing_isotropic_explicit_remeshing(
        iterations=REMESHING, targetlen=pymeshlab.PureValue(length), selectedonly=False, checksurfdist=False
    )
    remeshed, cell = ms.current_mesh_id(), FIRST_CELL * length
    _decimate(ms, max_faces)
    while ms.current_mesh().face_number() > max_faces:
        ms.set_current_mesh(remeshed)
        ms.generate_resampled_uniform_mesh(cellsize=pymeshlab.PureValue(cell), offset=pymeshlab.PureValue(0))
        _decimate(ms, max_faces)
        cell *= CELL_GROWTH
    ms.meshing_re_orient_faces_coherently()
    ms.meshing_remove_unreferenced_vertices()
    result = ms.current_mesh()
    return {"vertices": result.vertex_matrix(), "faces": result.face_matrix().astype(np.int32)}


def _decimate(ms: Any, max_faces: int) -> None:
    """Reduce the number of faces as far as the topology allows, and repair the result."""
    if ms.current_mesh().face_number() > max_faces:
        ms.meshing_decimation_quadric_edge_collapse(
            targetfacenum=max_faces, preservenormal=True, preservetopology=True, selected=False
        )
    ms.meshing_repair_non_manifold_edges(method="Remove Faces")
    ms.meshing_repair_non_manifold_vertices()
    ms.meshing_close_holes(maxholesize=MAX_HOLE, newfaceselected=False, selfintersection=False, selected=False)


def _unavailable(reason: str) -> BackendUnavailable:
    return BackendUnavailable(
        f"mesh cleaning cannot run here: {reason}; install pymeshlab and the system libraries its filters load, "
        "on Debian: apt-get install libgl1 libopengl0"
    )


if __name__ == "__main__":
    serve(_clean_in_child)
