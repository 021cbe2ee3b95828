"""Detail of outlines: the outline of a mesh at the input view moves to that of the video by the last pixels.

Grids, fairing and smoothing round an outline off by half a pixel to a pixel of the video, where most of what people see
of an error is. Vertices on the outline move across it, parallel to the picture, and draw their neighbors along.
"""

from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.kernels.workers import run_parallel
from dg4d_lib.mesh.neighbors import faces_to_vertices, grown, screened_factors
from dg4d_lib.mesh.tracking.elastic import ElasticBody
from dg4d_lib.mesh.tracking.outline_registration import enlarged_masks, outline_of, outline_steps

SIZE = 1024  # pixels of the compared outlines
ROUNDS = 3
LONGEST = 8.0  # pixels of a step; what is farther off is no detail
PULL = 10.0  # weight of the step of a vertex on the outline, against 1 for the difference along each of its edges
STAY = 0.05  # weight of no step, of every vertex: half of a step is left after 4 edges
ATTEMPTS, WIDER = 20, 3  # at frames without new defects, and those after which more vertices around them go back


def fit_outline_detail(
    vertices: Float[Tensor, "v 3"],
    offsets: Float[Tensor, "t v 3"],
    faces: Int[Tensor, "f 3"],
    alpha: Float[Tensor, "t h w"],
) -> Float[Tensor, "t v 3"]:
    """Return offsets by which the outline of the mesh at the input view is that of the video in detail.

    Frames get no defects that they do not have: there the vertices stay.

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
        moved = start
        for _ in range(ROUNDS):
            steps, share = outline_steps(torch.from_numpy(moved).float(), faces, target, camera, LONGEST)
            pull = PULL * share
            moved = moved + screened_factors(body.laplacian, pull + STAY).solve(pull[:, None] * steps)
        fitted[frame] = torch.from_numpy(_without_new_defects(body, start, moved) - body.rest).to(offsets)

    run_parallel([partial(fit_frame, frame) for frame in range(len(offsets))])
    return fitted


def _without_new_defects(
    body: ElasticBody, start: Float64[np.ndarray, "v 3"], moved: Float64[np.ndarray, "v 3"]
) -> Float64[np.ndarray, "v 3"]:
    """Return the moved vertices; near defects they go back, ring by ring, until no defect is new."""
    before = body.defective(start)
    back = np.zeros(len(start), bool)
    for attempt in range(ATTEMPTS):
        kept = np.where(back[:, None], start, moved)
        defective = body.defective(kept)
        if not (defective & ~before).any():
            return kept
        # around old ones, too: a new one may cross a face that crossed others before
        back |= grown(faces_to_vertices(defective, body.faces, len(start)), body.edges, 1 + attempt // WIDER)
    return start
