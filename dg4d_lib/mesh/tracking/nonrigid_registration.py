"""Non-rigid registration of the mesh to the surface of frames where skinning failed.

Gaussians that form a wing in one frame may form the body in another, and a mesh skinned to them crumples. In such
frames the mesh is registered to the surface of the Gaussians by non-rigid iterative closest points (Amberg et al.
2007): every vertex moves towards its nearest surface point and towards the points it is nearest to, with decreasing
smoothing of the steps.
"""

from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import csc_array, eye_array
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree
from torch import Tensor

from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.normals import vertex_normals
from dg4d_lib.kernels.workers import run_parallel
from dg4d_lib.mesh.extraction.clean import drop_small_components
from dg4d_lib.mesh.extraction.density import density_field
from dg4d_lib.mesh.extraction.extract import extract_surface, usable_level
from dg4d_lib.mesh.extraction.silhouettes import silhouette_iou
from dg4d_lib.mesh.neighbors import edge_graph, graph_laplacian
from dg4d_lib.settings import MeshSettings

MIN_IOU = 0.85  # silhouette IoU from which a frame is left unchanged
STIFFNESS = (5.0,) * 2 + (2.0,) * 6 + (1.0,) * 8 + (0.5,) * 8  # smoothing of successive steps
FACING = 0.1  # weight of unit normals in the distance, world units; keeps the two sides of a thin sheet apart


def register_nonrigid(
    vertices: Float[Tensor, "v 3"],
    offsets: Float[Tensor, "t v 3"],
    faces: Int[Tensor, "f 3"],
    states: Gaussians,
    silhouettes: Bool[Tensor, "t k h w"],
    level: float,
    settings: MeshSettings,
) -> Float[Tensor, "t v 3"]:
    """Register the mesh in frames where its silhouettes differ from those of the Gaussians.

    Args:
        vertices: in the reference frame, not split along seams.
        offsets: of the skinned vertices at every frame.
        faces: counter-clockwise seen from outside.
        states: the cloud at every frame (fields "t n 3").
        silhouettes: of the Gaussians at every frame (`render_silhouettes`).
        level: density of the surface.
        settings: mesh settings.

    Returns:
        The offsets; no frame's silhouette IoU is lower than before.
    """
    ious = silhouette_iou(vertices + offsets, faces, silhouettes)
    failed = torch.nonzero(ious < MIN_IOU)[:, 0].tolist()
    if not failed:
        return offsets
    identity, laplacian = eye_array(len(vertices)), graph_laplacian(edge_graph(faces.numpy(), len(vertices)))
    smooth = {stiffness: splu(csc_array(identity + stiffness * laplacian)) for stiffness in set(STIFFNESS)}
    registered = offsets.clone()

    def register_frame(frame: int) -> None:
        field = density_field(states.at(frame), settings)
        target = drop_small_components(*extract_surface(field, usable_level(field, level)), settings.min_component)
        target_vertices, target_faces = (torch.from_numpy(array) for array in target)
        targets = _with_normals(target_vertices, target_faces)
        tree = cKDTree(targets)
        moved = vertices + offsets[frame]
        for stiffness in STIFFNESS:
            step = smooth[stiffness].solve(closest_steps(_with_normals(moved, faces), targets, tree))
            moved = moved + torch.from_numpy(step.astype(np.float32))
            iou = silhouette_iou(moved[None], faces, silhouettes[frame, None])[0]
            if iou > ious[frame]:
                ious[frame], registered[frame] = iou, moved - vertices

    run_parallel([partial(register_frame, frame) for frame in failed])
    return registered


def closest_steps(
    points: Float[np.ndarray, "v c"], targets: Float[np.ndarray, "w c"], tree: cKDTree | None = None
) -> Float[np.ndarray, "v d"]:
    """Return the step of every point to its nearest target, averaged with that to the targets it is nearest to.

    Args:
        points: position and weighted normal, d = c / 2 numbers each.
        targets: likewise.
        tree: of the targets, if there is one already.
    """
    axes = points.shape[1] // 2
    steps = targets[(tree or cKDTree(targets)).query(points)[1], :axes] - points[:, :axes]
    nearest = cKDTree(points).query(targets)[1]
    count = np.bincount(nearest, minlength=len(points))
    selected = count > 0  # points that are nearest to some target
    for axis in range(axes):
        back = np.bincount(nearest, targets[:, axis], len(points))[selected] / count[selected] - points[selected, axis]
        steps[selected, axis] = 0.5 * (steps[selected, axis] + back)
    return steps


def _with_normals(vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]) -> Float[np.ndarray, "v 6"]:
    return torch.cat([vertices, FACING * vertex_normals(vertices, faces)], 1).double().numpy()
