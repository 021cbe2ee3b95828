"""Non-rigid registration with the surface of a frame, where skinning failed.

Gaussians that form a wing in one frame may form the body in another, and a mesh skinned to them crumples. In such
frames it is registered with the surface of the Gaussians by non-rigid iterative closest points (Amberg et al. 2007):
every vertex moves towards its nearest point and those whose nearest vertex it is, and steps are smoothed less and less.
"""

from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_array, csc_array, diags_array, eye_array
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree
from torch import Tensor

from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.kernels.workers import run_parallel
from dg4d_lib.mesh.extraction.clean import drop_small_components
from dg4d_lib.mesh.extraction.density import density_field
from dg4d_lib.mesh.extraction.extract import extract_surface, usable_level
from dg4d_lib.mesh.extraction.silhouettes import render_silhouettes, silhouette_iou
from dg4d_lib.mesh.texturing.bake import vertex_normals
from dg4d_lib.rasterizer.interface import Rasterizer
from dg4d_lib.settings import MeshSettings

MIN_IOU = 0.85  # agreement of outlines from which a frame is left unchanged
STIFFNESS = (5.0,) * 2 + (2.0,) * 6 + (1.0,) * 8 + (0.5,) * 8  # smoothing of successive steps
FACING = 0.1  # half the distance that opposite normals add, world units: the far side of a sheet is not near


def register_nonrigid(
    vertices: Float[Tensor, "v 3"],
    offsets: Float[Tensor, "t v 3"],
    faces: Int[Tensor, "f 3"],
    states: Gaussians,
    level: float,
    rasterize: Rasterizer,
    settings: MeshSettings,
) -> tuple[Float[Tensor, "t v 3"], Float[Tensor, " t"]]:
    """Return better offsets for frames in which the mesh has other outlines than the Gaussians.

    Args:
        vertices: in the reference frame, not split at seams.
        offsets: of the skinned vertices at every frame.
        faces: counter-clockwise seen from outside.
        states: the cloud at every frame (fields "t n 3").
        level: density of the surface.
        rasterize: the splatting backend.
        settings: of the mesh.

    Returns:
        The offsets, and the agreement of outlines at every frame with them, in [0, 1]: never less than before.
    """
    outlines = render_silhouettes(states, range(len(offsets)), rasterize)
    followed = silhouette_iou(vertices + offsets, faces, outlines)
    astray = torch.nonzero(followed < MIN_IOU)[:, 0].tolist()
    if not astray:
        return offsets, followed
    still, uneven = eye_array(len(vertices)), _laplacian(faces, len(vertices))
    smooth = {stiffness: splu(csc_array(still + stiffness * uneven)) for stiffness in set(STIFFNESS)}
    registered = offsets.clone()

    def register_frame(frame: int) -> None:
        field = density_field(states.at(frame), settings)
        target = drop_small_components(*extract_surface(field, usable_level(field, level)), settings.min_component)
        places, theirs = (torch.from_numpy(array) for array in target)
        targets = _with_normals(places, theirs)
        tree = cKDTree(targets)
        moved = vertices + offsets[frame]
        for stiffness in STIFFNESS:
            step = smooth[stiffness].solve(_steps(_with_normals(moved, faces), targets, tree))
            moved = moved + torch.from_numpy(step.astype(np.float32))
            now = silhouette_iou(moved[None], faces, outlines[frame, None])[0]
            if now > followed[frame]:
                followed[frame], registered[frame] = now, moved - vertices

    run_parallel([partial(register_frame, frame) for frame in astray])
    return registered, followed


def _steps(
    points: Float[np.ndarray, "v 6"], targets: Float[np.ndarray, "w 6"], tree: cKDTree
) -> Float[np.ndarray, "v 3"]:
    """Return steps to the nearest target, averaged with those to the targets whose nearest point this is."""
    steps = targets[tree.query(points)[1], :3] - points[:, :3]
    nearest = cKDTree(points).query(targets)[1]
    count = np.bincount(nearest, minlength=len(points))
    wanted = count > 0
    for axis in range(3):
        pull = np.bincount(nearest, targets[:, axis], len(points))[wanted] / count[wanted] - points[wanted, axis]
        steps[wanted, axis] = 0.5 * (steps[wanted, axis] + pull)
    return steps


def _with_normals(vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]) -> Float[np.ndarray, "v 6"]:
    return torch.cat([vertices, FACING * vertex_normals(vertices, faces)], 1).double().numpy()


def _laplacian(faces: Int[Tensor, "f 3"], count: int) -> csc_array:
    """Return the graph Laplacian of a mesh."""
    ends = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).long().numpy().T
    edges = coo_array((np.ones(ends.shape[1]), tuple(ends)), shape=(count, count)).tocsr()
    joined = ((edges + edges.T) > 0).astype(np.float64)
    return csc_array(diags_array(joined.sum(axis=1)) - joined)
