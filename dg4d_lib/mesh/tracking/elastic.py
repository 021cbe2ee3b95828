"""Elastic relaxation of a tracked mesh: no frame folds, crosses itself or turns a face over.

Skinning and projection move every vertex for itself, so neighbors overtake each other at joints. Here the vertices are
pulled to where tracking put them and hold together by an as-rigid-as-possible energy towards the rest shape (Sorkine
and Alexa 2007, with uniform weights, for the triangles are nearly equal). Where defects are left, the pull gives way.
Where limbs cross, it must give way far around them, which may move outlines; that is kept if the silhouettes stay.
"""

from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple, no_type_check

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from scipy.sparse.linalg import SuperLU
from torch import Tensor

from dg4d_lib.geometry.rotation import nearest_rotation
from dg4d_lib.kernels.compiling import njit
from dg4d_lib.kernels.workers import run_parallel
from dg4d_lib.mesh.extraction.silhouettes import silhouette_iou
from dg4d_lib.mesh.folds import DefectFinder
from dg4d_lib.mesh.models.flips import unflip
from dg4d_lib.mesh.neighbors import (
    connected_parts,
    edge_graph,
    faces_to_vertices,
    graph_laplacian,
    grown,
    screened_factors,
)
from dg4d_lib.mesh.screened import solve_screened

Vertices = Float64[np.ndarray, "v 3"]

PULL = 1.0  # weight of the tracked position of a vertex, against 1 for each of its edges
PASSES = 5  # alternations of rotations and positions
NEARBY = (1, 2, 3, 4, 6)  # rings of vertices around flipped faces that are relaxed, in one attempt each
LOOSE, LONG = 1e-3, 20  # pull and alternations of these
MAX_LOSS = 0.003  # largest loss of silhouette IoU by the stronger relaxation of a frame


@dataclass(frozen=True)
class Effort:
    """Strength of a relaxation.

    Attributes:
        rounds: at most; after the first one only around defects.
        rings: of neighbors around a defect whose pull is reduced too.
        yielding: factor on the pull around defects, per round.
    """

    rounds: int
    rings: int
    yielding: float


GENTLE, STRONG = Effort(5, 3, 0.15), Effort(12, 10, 0.05)


class Pose(NamedTuple):
    """Vertices of one frame, and the faces with defects that the rest shape does not have."""

    vertices: Vertices
    defective: Bool[np.ndarray, " f"]


def relax(
    vertices: Float[Tensor, "v 3"],
    offsets: Float[Tensor, "t v 3"],
    faces: Int[Tensor, "f 3"],
    silhouettes: Bool[Tensor, "t k h w"] | None = None,
) -> Float[Tensor, "t v 3"]:
    """Return offsets near the given ones by which the surface moves without folds and crossings.

    Args:
        vertices: in the reference frame, not split along seams.
        offsets: of the tracked vertices at every frame.
        faces: counter-clockwise seen from outside, of nearly equal size. Defects that the rest shape has stay.
        silhouettes: of the frames (`render_silhouettes`); with them, frames that keep defects are relaxed more
            strongly where that costs at most 0.003 of their IoU.
    """
    body = ElasticBody(vertices.double().numpy(), faces.numpy())
    relaxed = torch.empty_like(offsets)

    def relax_frame(frame: int) -> None:
        tracked = (vertices + offsets[frame]).double().numpy()
        first = body.first_round(tracked)
        moved, left = body.relaxed(tracked, GENTLE, first)
        if silhouettes is not None and left:
            outline = silhouettes[frame, None]
            strong, still_left = body.relaxed(tracked, STRONG, first)
            if still_left < left and _iou(strong, faces, outline) >= _iou(moved, faces, outline) - MAX_LOSS:
                moved = strong
        relaxed[frame] = torch.from_numpy(moved - body.rest).to(offsets)

    run_parallel([partial(relax_frame, frame) for frame in range(len(offsets))])
    return relaxed


def turn_back(
    vertices: Float[Tensor, "v 3"],
    offsets: Float[Tensor, "t v 3"],
    faces: Int[Tensor, "f 3"],
    silhouettes: Bool[Tensor, "t k h w"],
) -> Float[Tensor, "t v 3"]:
    """Return offsets with fewer flipped faces, in frames where silhouettes and other defects allow it.

    The surroundings of flipped faces are relaxed place by place, in several sizes, then all give way like a membrane
    (`unflip`); of each, the attempt with the fewest defects stays if it has fewer.

    Args:
        vertices: in the reference frame, not split along seams.
        offsets: of the tracked vertices at every frame.
        faces: counter-clockwise seen from outside.
        silhouettes: of the frames (`render_silhouettes`).
    """
    body = ElasticBody(vertices.double().numpy(), faces.numpy())
    turned, loose = offsets.clone(), np.full(len(vertices), LOOSE)

    def turn_frame(frame: int) -> None:
        moved = (vertices + offsets[frame]).double().numpy()
        outline = silhouettes[frame, None]

        places = body.flipped_places(moved)
        if not places:
            return
        least = _iou(moved, faces, outline) - MAX_LOSS

        def best(present: Pose, attempts: list[Vertices]) -> Pose:
            poses = [Pose(one, body.updated(present.defective, present.vertices, one)) for one in attempts]
            for pose in sorted(poses, key=lambda pose: int(pose.defective.sum())):
                if pose.defective.sum() >= present.defective.sum():
                    break
                if _iou(pose.vertices, faces, outline) >= least:
                    return pose
            return present

        pose = Pose(moved, body.defective(moved))
        for place in places:
            regions = [grown(place, body.edges, rings) for rings in NEARBY]
            start = pose.vertices
            pose = best(pose, [body.settle(start, start, loose, region, LONG) for region in regions])
        present = pose.vertices
        repaired, _ = unflip(body.rest, present, body.faces, body.rotations(present))
        if repaired is not present:
            present = best(pose, [repaired]).vertices
        if present is not moved:
            turned[frame] = torch.from_numpy(present - body.rest).to(offsets)

    run_parallel([partial(turn_frame, frame) for frame in range(len(offsets))])
    return turned


def _iou(moved: Float64[np.ndarray, "v 3"], faces: Int[Tensor, "f 3"], silhouettes: Bool[Tensor, "1 k h w"]) -> float:
    return float(silhouette_iou(torch.from_numpy(moved).float()[None], faces, silhouettes)[0])


class ElasticBody:
    """Rest shape with its edges, and the factors of the linear system that all frames share."""

    def __init__(self, rest: Float64[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> None:
        self.rest, self.faces = rest, faces
        self.edges = edge_graph(faces, len(rest))
        self.laplacian = graph_laplacian(self.edges)
        self._finder = DefectFinder(faces, rest)
        self._sound_at_rest = ~DefectFinder(faces).defective(rest)

    @cached_property
    def _uniform_factors(self) -> SuperLU:
        """Factors for vertices that are all free and pulled alike; only `first_round` needs them."""
        return screened_factors(self.laplacian, np.full(len(self.rest), PULL))

    def defective(
        self, moved: Float64[np.ndarray, "v 3"], near: Bool[np.ndarray, " f"] | None = None
    ) -> Bool[np.ndarray, " f"]:
        """Mark the faces with defects that the rest shape does not have; with `near`, at least those among these."""
        return self._finder.defective(moved, near) & self._sound_at_rest

    def updated(
        self, defective: Bool[np.ndarray, " f"], before: Float64[np.ndarray, "v 3"], moved: Float64[np.ndarray, "v 3"]
    ) -> Bool[np.ndarray, " f"]:
        """Return the defective faces, given those of other positions, which saves time where few vertices differ."""
        return self._finder.updated(defective, before, moved) & self._sound_at_rest

    def flipped_places(self, moved: Float64[np.ndarray, "v 3"]) -> list[Bool[np.ndarray, " v"]]:
        """Mark the corners of faces that point against the local rotation of the surface, one connected place each."""
        corners = np.flatnonzero(faces_to_vertices(self._finder.flipped(moved), self.faces, len(moved)))
        parts = connected_parts(self.edges, corners)
        return [np.isin(np.arange(len(moved)), corners[parts == part]) for part in np.unique(parts)]

    def rotations(self, moved: Float64[np.ndarray, "v 3"]) -> Float64[np.ndarray, "v 3 3"]:
        """Return for every vertex the rotation that best aligns its edges at rest with the present ones."""
        rotations = np.empty((len(moved), 3, 3))
        _rotations(self.edges.indptr, self.edges.indices, self.rest, moved, np.arange(len(moved)), rotations)
        return rotations

    def first_round(self, tracked: Float64[np.ndarray, "v 3"]) -> Pose:
        """Relax all vertices of one frame alike, as every effort begins."""
        moved = self.settle(tracked, tracked, np.full(len(tracked), PULL))
        return Pose(moved, self.defective(moved))

    def relaxed(
        self, tracked: Float64[np.ndarray, "v 3"], effort: Effort, first: Pose
    ) -> tuple[Float64[np.ndarray, "v 3"], int]:
        """Return the relaxed positions of one frame after its `first_round`, and how many faces have defects there."""
        pull = np.full(len(tracked), PULL)
        moved, defective = first
        for _ in range(effort.rounds - 1):
            if not defective.any():
                break
            yielding = grown(faces_to_vertices(defective, self.faces, len(moved)), self.edges, effort.rings)
            pull[yielding] *= effort.yielding
            before, moved = moved, self.settle(moved, tracked, pull, yielding)
            defective = self.updated(defective, before, moved)
        return moved, int(defective.sum())

    def settle(
        self,
        start: Float64[np.ndarray, "v 3"],
        tracked: Float64[np.ndarray, "v 3"],
        pull: Float64[np.ndarray, " v"],
        free: Bool[np.ndarray, " v"] | None = None,
        passes: int = PASSES,
    ) -> Float64[np.ndarray, "v 3"]:
        """Minimize the energy over the free vertices, all of them if None.

        Args:
            start: positions from which the first rotations are estimated.
            tracked: positions that the vertices are pulled to.
            pull: weight of the pull of every vertex, against 1 for each of its edges.
            free: vertices that may move.
            passes: alternations of rotations and positions.
        """
        moved, forces = start.copy(), np.empty_like(start)
        rotations = np.empty((len(start), 3, 3))
        rows = near = np.arange(len(start))
        alike = free is None and bool((pull == PULL).all())
        if free is not None:
            rows, near = np.flatnonzero(free), np.flatnonzero(grown(free, self.edges, 1))
            factors = screened_factors(self.laplacian[rows][:, rows], pull[rows])
            held = self.laplacian[rows][:, ~free] @ start[~free]
        for _ in range(passes):
            _rotations(self.edges.indptr, self.edges.indices, self.rest, moved, near, rotations)
            _forces(self.edges.indptr, self.edges.indices, self.rest, rotations, rows, forces)
            wanted = forces[rows] + pull[rows, None] * tracked[rows]
            if free is not None:
                moved[rows] = factors.solve(wanted - held)
            else:
                moved = (
                    self._uniform_factors.solve(wanted) if alike else solve_screened(self.edges, pull, wanted, moved)
                )
        return moved


@njit(cache=True, nogil=True)
@no_type_check
def _rotations(starts, neighbors, rest, moved, selected, rotations):
    """Write for every selected vertex the rotation that best aligns its edges at rest with the present ones."""
    covariance = np.zeros((3, 3))
    for v in selected:
        covariance[:] = 0
        for k in range(starts[v], starts[v + 1]):
            j = neighbors[k]
            for a in range(3):
                for b in range(3):
                    covariance[a, b] += (moved[j, a] - moved[v, a]) * (rest[j, b] - rest[v, b])
        nearest_rotation(covariance, rotations[v])


@njit(cache=True, nogil=True)
@no_type_check
def _forces(starts, neighbors, rest, rotations, selected, forces):
    """Write the right-hand side for selected vertices: edges at rest, turned by the mean rotation of both ends."""
    for v in selected:
        forces[v] = 0
        for k in range(starts[v], starts[v + 1]):
            j = neighbors[k]
            for a in range(3):
                for b in range(3):
                    turn = 0.5 * (rotations[v, a, b] + rotations[j, a, b])
                    forces[v, a] += turn * (rest[v, b] - rest[j, b])
