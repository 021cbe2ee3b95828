"""Separation of parts that a motion has pushed into each other, such as an arm that sinks into the body.

A video does not show the distance between a body and an arm in front of it, so tracking puts the arm inside. First,
parts are pushed apart, in all frames together and almost only along the rays of the input camera, which leaves its
picture as it is but for occlusions. Where that does not help, what lies inside another part shrinks back to a cap over
the place where it enters.
"""

from collections.abc import Callable
from functools import partial
from itertools import product

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from scipy.ndimage import gaussian_filter1d
from scipy.sparse import coo_array, csr_array, diags_array, eye_array, kron
from scipy.sparse.linalg import LinearOperator, cg
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.kernels.workers import run_parallel
from dg4d_lib.mesh.extraction.silhouettes import silhouette_iou
from dg4d_lib.mesh.extraction.unfold import unfold
from dg4d_lib.mesh.folds import self_intersecting
from dg4d_lib.mesh.models.control_graph import symmetric_matrix
from dg4d_lib.mesh.neighbors import connected_parts, faces_to_vertices, graph_laplacian, grown, screened_factors
from dg4d_lib.mesh.tracking.elastic import MAX_LOSS
from dg4d_lib.mesh.tracking.submerged import InnerBalls, Submerged

PULLS = (20.0, 20.0, 0.05)  # weights of shifts to the right, up and along the rays, against 1 per edge of the nodes
BRACE = 3.0  # largest weight of an edge of the nodes, which grows with its length
FRAMES = 1.0  # weight of an edge from a node to itself at the next frame
PUSH = 10.0  # weight of a contact
ROUNDS = 16  # largest number of rounds of contact search and pushing
PATIENCE = 6  # rounds without fewer crossings, after which pushing ends
SLACK = 0.004  # world units between parts
STEP = 0.03  # largest push of a contact in a round, world units
ALIKE = 0.3  # least cosine between the push of a contact and that of its surroundings
STEADY = 3.0  # frames, standard deviation: over which the direction is averaged
MANY, EVERY = 60, 3  # in frames with more submerged vertices than this, every third one makes a contact
TOLERANCE, ITERATIONS = 1e-3, 60  # of the linear solver
GAIN = 0.5  # least share of resolved crossings for which a push is kept
LOOSE = 1e-6  # pull of a cap's vertices to their positions, against 1 per edge: holds pieces that are inside entirely
KEPT = 0.02  # share of the distance to the membrane that is kept, so that a long limb does not shrink to a point
GRAIN = 3e-5  # world units, about a step of positions in files; crossings are counted after rounding to it
CAPS = (1, 2, 4, 6, 8)  # rings of vertices around submerged ones that shrink with them, one attempt after the other


def separate(
    vertices: Float[Tensor, "v 3"],
    offsets: Float[Tensor, "t v 3"],
    faces: Int[Tensor, "f 3"],
    silhouettes: Bool[Tensor, "t k h w"],
    loop: bool = False,
) -> tuple[Float[Tensor, "t v 3"], int]:
    """Return offsets by which fewer faces cross others, and the number of frames in which faces did.

    Frames without crossings change only where that keeps the motion steady.

    Args:
        vertices: in the reference frame, not split along seams.
        offsets: of the tracked vertices at every frame.
        faces: counter-clockwise seen from outside.
        silhouettes: of the frames (`render_silhouettes`). Pushing apart may cost 0.003 of their IoU at the input view,
            in the mean of the frames with crossings; a cap costs its frame at most 0.003, all views weighed.
        loop: the last frame is followed by the first one.
    """
    moved = (vertices + offsets).double().numpy()
    triangles = faces.numpy()
    crossing = _crossings(moved, triangles)
    counts = crossing.sum(1)
    if not counts.any():
        return offsets, 0
    balls = InnerBalls(vertices.double().numpy(), triangles)

    def iou(frames: Float64[np.ndarray, "m v 3"], rows: Int[np.ndarray, " m"], views: int) -> Float[np.ndarray, " m"]:
        overlaps = silhouette_iou(torch.from_numpy(frames).float(), faces, silhouettes[rows, :views])
        found: Float[np.ndarray, " m"] = overlaps.numpy()
        return found

    pushed, crossing = push_apart(balls, moved, crossing, loop)
    mended = pushed.copy()

    def mend(frame: int) -> None:
        mended[frame] = unfold(pushed[frame], triangles)

    still = np.flatnonzero(crossing.any(1))
    run_parallel([partial(mend, int(frame)) for frame in still])
    crossed, left = np.flatnonzero(counts), np.zeros_like(counts)
    left[still] = _crossings(mended[still], triangles).sum(1)
    fewer = left.sum() <= GAIN * counts.sum()
    if fewer and (iou(mended[crossed], crossed, 1) - iou(moved[crossed], crossed, 1)).mean() >= -MAX_LOSS:
        moved, counts = mended, left

    def shrink(frame: int) -> None:
        here, views = np.array([frame]), silhouettes.shape[1]
        enough = iou(moved[here], here, views)[0] - MAX_LOSS
        moved[frame] = cap(balls, moved[frame], lambda attempt: bool(iou(attempt[None], here, views)[0] >= enough))

    run_parallel([partial(shrink, int(frame)) for frame in np.flatnonzero(counts)])
    return torch.from_numpy(moved).to(offsets) - vertices, len(crossed)


def cap(
    balls: InnerBalls,
    moved: Float64[np.ndarray, "v 3"],
    allowed: Callable[[Float64[np.ndarray, "v 3"]], bool] = lambda vertices: True,
) -> Float64[np.ndarray, "v 3"]:
    """Return the vertices of one frame, submerged ones drawn to a membrane over the place where they enter.

    Where that leaves crossings, or nothing is submerged, the surroundings of the crossing become a membrane, too.

    Args:
        balls: inner balls of the surface.
        moved: vertices; they stay where no attempt has fewer crossings.
        allowed: tells whether an attempt may be kept.
    """
    faces, edges, laplacian = balls.body.faces, balls.body.edges, balls.body.laplacian
    crossing = self_intersecting(moved, faces)
    inside = np.zeros(len(moved), bool)
    inside[balls.submerged(moved, balls.centers(moved), crossing).vertices] = True
    fewest, best = int(crossing.sum()), moved
    around = inside | faces_to_vertices(crossing, faces, len(moved))
    for start, rings in product((inside, around), CAPS):
        region = grown(start, edges, rings)
        if not region.any() or region.all():
            continue
        attempt = moved.copy()
        wanted = LOOSE * moved[region] - laplacian[region][:, ~region] @ moved[~region]
        factors = screened_factors(laplacian[region][:, region], np.full(len(wanted), LOOSE))
        attempt[region] = factors.solve(wanted)
        attempt[region] += KEPT * (moved[region] - attempt[region])
        attempt = unfold(attempt, faces)
        left = int(self_intersecting(np.round(attempt / GRAIN) * GRAIN, faces).sum())
        if left < fewest and allowed(attempt):
            fewest, best = left, attempt
        if fewest == 0:
            break
    return best


def push_apart(
    balls: InnerBalls, moved: Float64[np.ndarray, "t v 3"], crossing: Bool[np.ndarray, "t f"], loop: bool
) -> tuple[Float64[np.ndarray, "t v 3"], Bool[np.ndarray, "t f"]]:
    """Push submerged parts out of others in all frames, as far as that is possible.

    Every round finds the contacts of the present positions, keeps those of earlier rounds, and solves for the smoothest
    shifts of the control nodes that move all of them apart.

    Args:
        balls: inner balls of the surface.
        moved: vertices of all frames.
        crossing: faces of these that cross others.
        loop: the last frame is followed by the first one.

    Returns:
        Vertices and crossing faces of all frames, with the fewest crossings that were found.
    """
    shifts = _Shifts(balls, moved, loop)
    directions = np.zeros((len(moved), len(balls.control.nodes), 3))
    contacts = np.empty((0, 3), np.int64)
    best, least, waited = moved, crossing, 0
    for number in range(ROUNDS):
        present, centers = shifts.apply()
        if number > 0:
            crossing = _crossings(present, balls.body.faces)
            best, least, waited = (present, crossing, 0) if crossing.sum() < least.sum() else (best, least, waited + 1)
        if not crossing.any() or waited == PATIENCE:
            break
        found, pushes = _submerged(balls, present, centers, crossing)
        steady = gaussian_filter1d(pushes, STEADY, axis=0, mode="wrap" if loop else "nearest")
        known = np.linalg.norm(steady, axis=2, keepdims=True) > 0
        directions = np.where(known, steady, directions)
        for frame, inside in enumerate(found):
            new = _contacts(balls, inside, present[frame], centers[frame], directions[frame])
            rows = np.concatenate([np.full((len(new), 1), frame), new], 1)
            contacts = np.unique(np.concatenate([contacts, rows]), axis=0)
        if not shifts.solve(contacts, present, centers):
            break
    return best, least


def _submerged(
    balls: InnerBalls,
    moved: Float64[np.ndarray, "t v 3"],
    centers: Float64[np.ndarray, "t b 3"],
    crossing: Bool[np.ndarray, "t f"],
) -> tuple[list[Submerged], Float64[np.ndarray, "t m 3"]]:
    """Return the submerged vertices of each frame, near its crossing faces, and `_pushes` of each."""
    found = dict[int, Submerged]()
    pushes = np.zeros((len(moved), len(balls.control.nodes), 3))

    def search(frame: int) -> None:
        found[frame] = balls.submerged(moved[frame], centers[frame], crossing[frame])
        pushes[frame] = _pushes(balls, found[frame], moved[frame], centers[frame])

    run_parallel([partial(search, frame) for frame in range(len(moved))])
    return [found[frame] for frame in range(len(moved))], pushes


def _crossings(moved: Float64[np.ndarray, "t v 3"], faces: Int[np.ndarray, "f 3"]) -> Bool[np.ndarray, "t f"]:
    """Mark the faces of every frame that cross others."""
    crossing = np.zeros((len(moved), len(faces)), bool)

    def search(frame: int) -> None:
        crossing[frame] = self_intersecting(moved[frame], faces)

    run_parallel([partial(search, frame) for frame in range(len(moved))])
    return crossing


def _pushes(
    balls: InnerBalls, inside: Submerged, moved: Float64[np.ndarray, "v 3"], centers: Float64[np.ndarray, "b 3"]
) -> Float64[np.ndarray, "m 3"]:
    """Return the sum of depth times direction over the submerged region at every control node, else 0."""
    pushes = np.zeros((len(balls.control.nodes), 3))
    if len(inside.vertices):
        towards = _unit(moved[inside.vertices] - centers[inside.balls])
        parts = connected_parts(balls.body.edges, inside.vertices)
        sums = np.stack([np.bincount(parts, inside.depths * towards[:, axis]) for axis in range(3)], 1)
        pushes[balls.node[inside.vertices]] = sums[parts]
    return pushes


def _contacts(
    balls: InnerBalls,
    inside: Submerged,
    moved: Float64[np.ndarray, "v 3"],
    centers: Float64[np.ndarray, "b 3"],
    directions: Float64[np.ndarray, "m 3"],
) -> Int[np.ndarray, "n 2"]:
    """Return vertices and balls that are to be pushed apart: those whose push agrees with its surroundings."""
    towards = _unit(moved[inside.vertices] - centers[inside.balls])
    agrees = (towards * _unit(directions[balls.node[inside.vertices]])).sum(1) > ALIKE
    selected = np.stack([inside.vertices[agrees], inside.balls[agrees]], 1)
    return selected if len(selected) <= MANY else selected[selected[:, 0] % EVERY == 0]


class _Shifts:
    """Shifts of control nodes at all frames: to the right, up and along the rays of the input camera.

    They minimize the sum of squared differences between neighboring nodes and successive frames, of squared shifts
    (weights `PULLS`), and of squared overlaps that are left at contacts (weight `PUSH`), by conjugate gradients.
    """

    def __init__(self, balls: InnerBalls, moved: Float64[np.ndarray, "t v 3"], loop: bool) -> None:
        frames, nodes = len(moved), len(balls.control.nodes)
        lengths = balls.control.lengths.double().numpy()
        stiffness = (lengths / np.median(lengths)).clip(1, BRACE)
        space = graph_laplacian(symmetric_matrix(balls.control.edges.numpy(), stiffness, nodes))
        following = np.stack([np.arange(frames), np.arange(1, frames + 1) % frames], 1)[: None if loop else -1]
        time = graph_laplacian(symmetric_matrix(following, np.ones(len(following)), frames))
        self._laplacian = csr_array(kron(eye_array(frames), space) + FRAMES * kron(time, eye_array(nodes)))
        factors = {pull: screened_factors(self._laplacian, np.full(frames * nodes, pull)) for pull in set(PULLS)}
        self._factors = [factors[pull] for pull in PULLS]
        self._balls, self._moved = balls, moved
        self._centers = np.stack([balls.centers(frame) for frame in moved])
        self._axes, self._center_axes = _axes(moved), _axes(self._centers)
        self._values = np.zeros((3, frames, nodes))

    def apply(self) -> tuple[Float64[np.ndarray, "t v 3"], Float64[np.ndarray, "t b 3"]]:
        """Return the shifted vertices and centers of balls."""
        balls = self._balls
        return (
            self._moved + _shifted(balls.blend, self._values, self._axes),
            self._centers + _shifted(balls.ball_blend, self._values, self._center_axes),
        )

    def solve(
        self,
        contacts: Int[np.ndarray, "n 3"],
        moved: Float64[np.ndarray, "t v 3"],
        centers: Float64[np.ndarray, "t b 3"],
    ) -> bool:
        """Set the shifts that move the contacts apart which are too close at present; tell whether there are any.

        Args:
            contacts: frame, vertex and ball.
            moved: present vertices.
            centers: present centers of the balls.
        """
        frame, vertex, ball = contacts.T
        arms, radii = moved[frame, vertex] - centers[frame, ball], self._balls.radii[ball] + SLACK
        lacking = radii - np.linalg.norm(arms, axis=1)
        close = lacking > 0
        if not close.any():
            return False
        (frame, vertex, ball), towards, lacking = contacts[close].T, _unit(arms[close]), lacking[close]
        frames, nodes = self._values.shape[1:]
        at_vertex = np.einsum("qi,qai->aq", towards, self._axes[frame, vertex])
        at_center = np.einsum("qi,qai->aq", towards, self._center_axes[frame, ball])
        of_vertex, of_ball = self._balls.blend[vertex], self._balls.ball_blend[ball]
        parts = []
        for axis in range(3):
            part = (diags_array(at_vertex[axis]) @ of_vertex - diags_array(at_center[axis]) @ of_ball).tocoo()
            parts.append((part.data, part.row, (axis * frames + frame[part.row]) * nodes + part.col))
        data, rows, columns = (np.concatenate(column) for column in zip(*parts, strict=True))
        jacobian = csr_array(coo_array((data, (rows, columns)), shape=(len(frame), 3 * frames * nodes)))
        transposed = csr_array(jacobian.T)
        wanted = lacking.clip(max=STEP) + jacobian @ self._values.ravel()

        def normal(values: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
            by_axis = values.reshape(3, -1)
            smooth = np.stack([self._laplacian @ row + pull * row for row, pull in zip(by_axis, PULLS, strict=True)])
            result: Float64[np.ndarray, " n"] = smooth.ravel() + PUSH * (transposed @ (jacobian @ values))
            return result

        def preconditioned(values: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
            by_axis = zip(self._factors, values.reshape(3, -1), strict=True)
            return np.concatenate([factors.solve(np.ascontiguousarray(row)) for factors, row in by_axis])

        size = (self._values.size,) * 2
        solved, _ = cg(
            LinearOperator(size, matvec=normal, dtype=np.float64),
            PUSH * (transposed @ wanted),
            x0=self._values.ravel(),
            rtol=TOLERANCE,
            maxiter=ITERATIONS,
            M=LinearOperator(size, matvec=preconditioned, dtype=np.float64),
        )
        self._values = solved.reshape(self._values.shape)
        return True


def _shifted(
    blend: csr_array, values: Float64[np.ndarray, "3 t m"], axes: Float64[np.ndarray, "t p 3 3"]
) -> Float64[np.ndarray, "t p 3"]:
    """Return the displacements of points, in world units, by the values of the nodes along the axes of the points."""
    blended = np.stack([(blend @ axis.T).T for axis in values], 2)
    displacements: Float64[np.ndarray, "t p 3"] = np.einsum("tpa,tpai->tpi", blended, axes)
    return displacements


def _axes(points: Float64[np.ndarray, "t p 3"]) -> Float64[np.ndarray, "t p 3 3"]:
    """Return the directions to the right, up and along the ray of the input camera at every point."""
    rays = _unit(points - OrbitCamera().position().numpy())
    right = _unit(np.cross(rays, (0.0, 1.0, 0.0)))
    return np.stack([right, np.cross(right, rays), rays], 2)


def _unit(vectors: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3"]:
    """Return the vectors with length 1; 0 stays."""
    unit: Float64[np.ndarray, "*n 3"] = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True).clip(1e-12)
    return unit
