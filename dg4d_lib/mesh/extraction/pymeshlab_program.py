"""Program that cleans a mesh with pymeshlab.

pymeshlab is GPL-3 and crashes when two threads of a process use it. So it runs in a child process, `python -m` this
module, and is imported nowhere else. Of the library it imports little: every mesh waits for its start.
"""

from importlib import import_module
from typing import Any

import numpy as np

from dg4d_lib.errors import BackendUnavailable
from dg4d_lib.mesh.subprocess_runner import Arrays, serve

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
    "get_topological_measures",
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


def clean_arrays(arrays: Arrays) -> Arrays:
    """Clean a mesh in units of the normalized box; see `dg4d_lib.mesh.extraction.clean.clean`."""
    try:
        # Untyped: its names come from a star import that type checkers cannot follow.
        pymeshlab: Any = import_module("pymeshlab")
    except ImportError as error:
        raise _unavailable(f"pymeshlab cannot be imported ({error})") from error
    missing = sorted(set(FILTERS) - set(pymeshlab.filter_list()))
    if missing:
        raise _unavailable(f"pymeshlab lacks the filter {missing[0]} and {len(missing) - 1} other required ones")
    length, max_faces = float(arrays["edge_length"]), int(arrays["max_faces"])
    ms, given = pymeshlab.MeshSet(verbose=False), pymeshlab.Mesh(arrays["vertices"], arrays["faces"])
    ms.add_mesh(given)
    ms.meshing_merge_close_vertices(threshold=pymeshlab.PureValue(MERGE))
    ms.meshing_remove_duplicate_faces()
    ms.meshing_remove_null_faces()
    if ms.get_topological_measures()["non_two_manifold_edges"]:  # it joined two sheets, and repairs twist them
        ms.clear()
        ms.add_mesh(given)
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
    serve(clean_arrays)
