"""Detail of outlines: the outline of a mesh at the input view moves to that of the video by the last pixels.

Grids, fairing and smoothing round an outline off by half a pixel to a pixel of the video, where most of what people see
of an error is. Vertices on the outline move across it, parallel to the picture, and draw their neighbors along.
"""

from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.kernels.workers import run_parallel
from dg4d_lib.mesh.extraction.silhouettes import enlarged_masks
from dg4d_lib.mesh.extraction.unfold import without_new_defects
from dg4d_lib.mesh.screened import solve_screened
from dg4d_lib.mesh.tracking.elastic import ElasticBody
from dg4d_lib.mesh.tracking.outline_registration import outline_of, outline_steps

SIZE = 1024  # pixels of the compared outlines
ROUNDS = 5
PASSES = 3  # largest number, each of `ROUNDS` rounds
HELD = 0.1  # share of a pass undone because of new defects, above which another pass follows
LONGEST = 8.0  # pixels of a step; larger distances are not detail
PULL = 10.0  # weight of the step of a vertex on the outline, against 1 for the difference along each of its edges
STAY = 0.05  # weight of a zero step of every vertex: steps fall to half after 4 edges


def fit_outline_detail(
    vertices: Float[Tensor, "v 3"],
    offsets: Float[Tensor, "t v 3"],
    faces: Int[Tensor, "f 3"],
    alpha: Float[Tensor, "t h w"],
) -> Float[Tensor, "t v 3"]:
    """Return offsets by which the outline of the mesh at the input view is that of the video in detail.

    Frames get no defects that they do not have: there the vertices stay. Where much has to stay, the rest moves once
    more from there.

    Args:
        vertices: in the reference frame, not split along seams.
        offsets: of the vertices at every frame, whose outlines are right but for some pixels of `SIZE`.
        faces: counter-clockwise seen from outside.
        alpha: of the video, at the input view.
    """
    camera = OrbitCamera(width=SIZE, height=SIZE)
    body = ElasticBody(vertices.double().numpy(), faces.numpy())
    fitted = offsets.clone()

    def fit_frame(frame: int) -> None:
        target = outline_of(enlarged_masks(alpha[frame, None], SIZE)[0].numpy(force=True)).points
        start = (vertices + offsets[frame]).double().numpy()
        for _ in range(PASSES):
            moved = start
            for _ in range(ROUNDS):
                steps, share = outline_steps(torch.from_numpy(moved).float(), faces, target, camera, LONGEST)
                pull = PULL * share
                moved = moved + solve_screened(body.edges, pull + STAY, pull[:, None] * steps, steps)
            kept = without_new_defects(start, moved, body.faces, body.edges, body.defective)
            undone, whole = moved - kept, moved - start
            start = kept
            if np.linalg.norm(undone) <= HELD * np.linalg.norm(whole):
                break
        fitted[frame] = torch.from_numpy(start - body.rest).to(offsets)

    run_parallel([partial(fit_frame, frame) for frame in range(len(offsets))])
    return fitted
