"""Metrics of ActionBench (Sabathier et al. 2026, ActionMesh): chamfer distances of moving surfaces after alignment.

Definitions of the published evaluation (facebookresearch/actionmesh, folder actionbench, commit 66db12e), with points
sampled on the surfaces:

  CD-3D   chamfer distance after an alignment of every frame by itself, mean over frames
  CD-4D   chamfer distance after the alignment of the first frame alone, mean over frames
  CD-M    distance over time of points that are nearest neighbors in the first frame, aligned as for CD-4D

All are sums of both directions, of distances that are not squared. An alignment has a rotation, a translation and a
scale per axis, found by gradient descent on the squared chamfer distance from the 24 rotations of a cube.

Deviations: the 24 starts are compared on few points, and only the best few are refined; alignment may use fewer points
(published: 10,000). The published units are those of ActionBench's files; ours are chosen by `unit_box`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations, product
from statistics import fmean

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize

from dg4d_lib.adam import Adam
from dg4d_lib.errors import BadInput

LEARNING_RATE, ITERATIONS = 0.01, 200  # Adam, per alignment (published)
QUERIES = 10_000  # points whose nearest neighbors are averaged in CD-3D and CD-4D (published)
SCREEN_POINTS, SCREEN_ITERATIONS, FINALISTS = 200, 40, 2  # selection among the 24 starts (ours)
FEW = 1 << 16  # pairs of points up to which all distances are computed
WIDEST = 1.0  # half of the longest side of the box that the true animation fills


@dataclass(frozen=True)
class Alignment:
    """Map of points to (scale * point) rotation + translation, with points as rows.

    Attributes:
        scale: factor per axis, before the rotation.
        rotation: orthogonal matrix, determinant 1.
        translation: world units.
    """

    scale: Float[Tensor, " 3"]
    rotation: Float[Tensor, "3 3"]
    translation: Float[Tensor, " 3"]

    def __call__(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Return the aligned points."""
        return (self.scale * points) @ self.rotation + self.translation


def unit_box(ground_truth: Float[Tensor, "t n 3"]) -> tuple[Float[Tensor, " 3"], float]:
    """Return center and factor that fit a whole animation into [-1, 1] along its longest axis."""
    low, high = ground_truth.flatten(0, 1).amin(0), ground_truth.flatten(0, 1).amax(0)
    return (low + high) / 2, 2 * WIDEST / max(float((high - low).max()), 1e-12)


def chamfer_3d(
    points: Float[Tensor, "t n 3"], ground_truth: Float[Tensor, "t m 3"], alignments: Sequence[Alignment]
) -> float:
    """Return the mean over frames of the chamfer distance, each frame by its own alignment."""
    frames = zip(points, ground_truth, alignments, strict=True)
    return fmean(chamfer_sum(align(ours), theirs) for ours, theirs, align in frames)


def chamfer_4d(points: Float[Tensor, "t n 3"], ground_truth: Float[Tensor, "t m 3"], alignment: Alignment) -> float:
    """Return the mean over frames of the chamfer distance, all frames by the alignment of the first."""
    return chamfer_3d(points, ground_truth, [alignment] * len(points))


def chamfer_motion(
    tracked: Float[Tensor, "t n 3"], ground_truth: Float[Tensor, "u m 3"], alignment: Alignment
) -> float:
    """Return the mean distance over time of points that are nearest neighbors in the first frame.

    Args:
        tracked: points that stay on one place of the surface.
        ground_truth: likewise.
        alignment: of the first frame.

    Raises:
        BadInput: different numbers of frames.
    """
    if len(tracked) != len(ground_truth):
        raise BadInput(f"motion is compared frame by frame; given {len(tracked)} and {len(ground_truth)} frames")
    ours = align_all(tracked, alignment)
    total = 0.0
    for here, there in ((ours, ground_truth), (ground_truth, ours)):
        nearest = nearest_indices(there[0], here[0])
        total += float((there[:, nearest] - here).norm(dim=-1).mean())
    return total


def chamfer_sum(a: Float[Tensor, "n 3"], b: Float[Tensor, "m 3"], queries: int = QUERIES) -> float:
    """Return the sum of the mean distances from either cloud to the nearest points of the other.

    Args:
        a: points in random order.
        b: likewise.
        queries: number of points of each cloud whose distances are averaged, the first ones.
    """
    forth, _ = cKDTree(b.numpy()).query(a[:queries].numpy())
    back, _ = cKDTree(a.numpy()).query(b[:queries].numpy())
    return float(np.mean(forth) + np.mean(back))


def align_all(points: Float[Tensor, "t n 3"], alignment: Alignment) -> Float[Tensor, "t n 3"]:
    """Return all frames after one alignment."""
    return torch.stack([alignment(frame) for frame in points])


def align_points(points: Float[Tensor, "n 3"], ground_truth: Float[Tensor, "m 3"]) -> Alignment:
    """Return the alignment of one cloud with another, by gradient descent from the rotations of a cube.

    Args:
        points: to be aligned, in random order.
        ground_truth: target, in random order.
    """
    starts = cube_rotations().to(points)
    losses, _ = _descend(points[:SCREEN_POINTS], ground_truth[:SCREEN_POINTS], starts, SCREEN_ITERATIONS)
    finalists = losses.argsort(stable=True)[:FINALISTS]
    losses, alignments = _descend(points, ground_truth, starts[finalists], ITERATIONS)
    return alignments[int(losses.argmin())]


def cube_rotations() -> Float[Tensor, "24 3 3"]:
    """Return the rotations that map the axes to axes, the identity first."""
    found = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        matrix = torch.diag(torch.tensor(signs, dtype=torch.float64))[list(order)]
        if torch.linalg.det(matrix) > 0:
            found.append(matrix)
    return torch.stack(found)


def nearest_indices(points: Float[Tensor, "n 3"], queries: Float[Tensor, "m 3"]) -> Int[Tensor, " m"]:
    """Return the index of the nearest point for every query."""
    return torch.from_numpy(cKDTree(points.numpy()).query(queries.numpy())[1].astype(np.int64))


@torch.enable_grad()
def _descend(
    points: Float[Tensor, "n 3"], ground_truth: Float[Tensor, "m 3"], starts: Float[Tensor, "k 3 3"], iterations: int
) -> tuple[Float[Tensor, " k"], list[Alignment]]:
    """Return the smallest loss of every start, and its alignment."""
    count = len(starts)
    scale = points.new_ones(count, 3).requires_grad_()
    rows = torch.eye(3).to(points)[:2].expand(count, 2, 3).clone().requires_grad_()
    translation = points.new_zeros(count, 3).requires_grad_()
    adam = Adam([{"params": [translation, rows, scale], "lr": LEARNING_RATE}])
    best = points.new_full((count,), torch.inf)
    kept = [value.detach().clone() for value in (scale, starts, translation)]
    for _ in range(iterations):
        rotations = starts @ _rotation(rows)
        moved = (scale[:, None] * points) @ rotations + translation[:, None]
        losses = _squared_chamfer(moved, ground_truth)
        better = losses.detach() < best
        best = torch.where(better, losses.detach(), best)
        for store, value in zip(kept, (scale, rotations, translation), strict=True):
            store[better] = value.detach()[better]
        adam.zero_grad()
        losses.sum().backward()
        adam.step()
    return best, [Alignment(*parts) for parts in zip(*kept, strict=True)]


def _squared_chamfer(moved: Float[Tensor, "k n 3"], ground_truth: Float[Tensor, "m 3"]) -> Float[Tensor, " k"]:
    """Return the sum of the mean squared distances to nearest neighbors in both directions, for every start."""
    there, back = _neighbors(moved.detach(), ground_truth)
    forth = (moved - ground_truth[there]).square().sum(-1).mean(-1)
    return forth + (moved.gather(1, back[..., None].expand(-1, -1, 3)) - ground_truth).square().sum(-1).mean(-1)


def _neighbors(
    moved: Float[Tensor, "k n 3"], ground_truth: Float[Tensor, "m 3"]
) -> tuple[Int[Tensor, "k n"], Int[Tensor, "k m"]]:
    """Return the indices of nearest neighbors in both directions; few points are compared one by one."""
    if moved.shape[1] * len(ground_truth) <= FEW:
        distances = torch.cdist(moved, ground_truth.expand(len(moved), -1, -1))
        return distances.argmin(2), distances.argmin(1)
    pairs = [(nearest_indices(ground_truth, each), nearest_indices(each, ground_truth)) for each in moved]
    there, back = zip(*pairs, strict=True)
    return torch.stack(there), torch.stack(back)


def _rotation(rows: Float[Tensor, "k 2 3"]) -> Float[Tensor, "k 3 3"]:
    """Return rotation matrices from two rows each, by Gram and Schmidt (Zhou et al. 2019)."""
    first = normalize(rows[:, 0], dim=-1)
    second = normalize(rows[:, 1] - (first * rows[:, 1]).sum(-1, keepdim=True) * first, dim=-1)
    return torch.stack([first, second, torch.linalg.cross(first, second)], 1)
