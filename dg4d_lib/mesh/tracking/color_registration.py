"""Registration of a textured mesh to the colors of the driving video, by optical flow.

Outlines do not show a face that turns or an arm in front of the body. The flow from a render of the mesh to the frame
moves the vertices that the input view shows; the others follow by an as-rigid-as-possible energy.
"""

from dataclasses import replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.images import color_over_white, luminance, resize
from dg4d_lib.kernels.workers import run_parallel
from dg4d_lib.mesh.extraction.silhouettes import surroundings
from dg4d_lib.mesh.extraction.unfold import without_new_defects
from dg4d_lib.mesh.render import render_mesh
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh.tracking.elastic import ElasticBody
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh
from dg4d_lib.video.optical_flow import optical_flow

SIZE = 256  # pixels of the compared pictures, at most: flow is finer than a pixel
WHITE, MARGIN = 0.99, 16  # luminance above which a pixel shows no subject, and pixels around the subject that count
ROTATIONS = 2  # alternations of rotations and positions
WARPS = 3  # of the flow; two more take 1.4 times as long and change it by a hundredth of a pixel
HIDDEN_PULL, SHOWN_PULL = 0.1, 1.5  # weights of the positions of hidden and of shown vertices, against 1 per edge


def register_to_colors(
    mesh: TexturedMesh,
    sources: Int[Tensor, " s"],
    vertices: Float[Tensor, "v 3"],
    offsets: Float[Tensor, "t v 3"],
    faces: Int[Tensor, "f 3"],
    pictures: Float[Tensor, "t h w 3"],
    sound: bool = False,
) -> Float[Tensor, "t v 3"]:
    """Return offsets by which renders of the mesh agree with the pictures.

    Args:
        mesh: textured, split along seams.
        sources: vertex that every split vertex copies.
        vertices: in the reference frame, not split along seams.
        offsets: of the tracked vertices at every frame.
        faces: counter-clockwise seen from outside, not split along seams.
        pictures: frames of the driving video over white.
        sound: frames get no defects that they do not have.
    """
    body = ElasticBody(vertices.double().numpy(), faces.numpy())
    registered, size = torch.empty_like(offsets), min(SIZE, pictures.shape[1])

    def register_frame(frame: int) -> None:
        moved = vertices + offsets[frame]
        expected = resize(pictures[frame, None], (size, size))[0]
        camera = OrbitCamera(width=expected.shape[1], height=expected.shape[0])
        color, alpha = render_mesh(replace(mesh, vertices=moved[sources]), [camera])
        flow = _flow(_luma(color_over_white(color, alpha)[0]), _luma(expected))
        steps, share = steps_of_flow(moved, faces, flow, camera)
        start = moved.double().numpy()
        pull = HIDDEN_PULL + (SHOWN_PULL - HIDDEN_PULL) * share.clip(max=1)
        settled = body.settle(start, start + steps, pull, passes=ROTATIONS)
        if sound:
            settled = without_new_defects(start, settled, body.faces, body.edges, body.defective)
        registered[frame] = torch.from_numpy(settled).to(offsets) - vertices

    run_parallel([partial(register_frame, frame) for frame in range(len(offsets))])
    return registered


def steps_of_flow(
    moved: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], flow: Float[np.ndarray, "2 h w"], camera: OrbitCamera
) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, " v"]]:
    """Return steps of vertices parallel to the picture by the flow at the pixels that show them, and their pixels.

    Args:
        moved: vertices, world units.
        faces: indices into the vertices.
        flow: rows and columns by which every pixel moves.
        camera: camera of the picture.

    Returns:
        Mean step of every vertex, world units, 0 where it is hidden; and the sum of its barycentric weights over the
        pixels.
    """
    fragments = rasterize_mesh(moved, faces, [camera])
    ids = fragments.faces[0].numpy()
    rows, columns = np.nonzero(ids >= 0)
    depth = fragments.depth[0].numpy()[rows, columns]
    axes = camera.viewmat().numpy()[1::-1, :3]  # down and right
    in_world = flow[:, rows, columns].T @ axes * (depth / camera.focal)[:, None]
    weights = fragments.barycentrics[0].numpy()[rows, columns].astype(np.float64)
    corners = faces.numpy()[ids[rows, columns]].ravel()
    share = np.bincount(corners, weights.ravel(), len(moved)).astype(np.float64)
    sums = [np.bincount(corners, (weights * part[:, None]).ravel(), len(moved)) for part in in_world.T]
    return np.stack(sums, 1) / np.maximum(share, 1e-6)[:, None], share


def _flow(first: Float[np.ndarray, "h w"], second: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "2 h w"]:
    """Return rows and columns by which pixels move from one picture over white to another; 0 far from the subject."""
    flow = np.zeros((2, *first.shape))
    shown = np.minimum(first, second) < WHITE
    if shown.any():
        near = surroundings(shown, MARGIN)
        flow[:, *near] = optical_flow(first[near], second[near], WARPS)
    return flow


def _luma(color: Float[Tensor, "h w 3"]) -> Float[np.ndarray, "h w"]:
    luma: Float[np.ndarray, "h w"] = luminance(color).numpy(force=True)
    return luma
