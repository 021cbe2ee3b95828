"""Strands of a mesh that moves: they grow where a frame shows them best, and are found again in the others.

Tracking loses what is a pixel wide, so the mesh is tracked without strands. In every frame, a strand is shifted by the
surface around its root first, and then turns, stretches and bends to the middle lines that the picture shows there.
How far it comes towards the camera no picture tells: of some slopes, it gets the one at which it crosses the least.
A strand that most frames do not show is dropped: seen from the side, wings and hands are lines, too.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from dg4d_lib.kernels.workers import run_parallel
from dg4d_lib.mesh.extraction.silhouettes import enlarged_masks
from dg4d_lib.mesh.extraction.strands import (
    CAMERA,
    NEAR,
    SIZE,
    THICKEST,
    Grown,
    MiddleLines,
    Strand,
    Tube,
    covered_pixels,
    find_strands,
    middle_lines,
    pixels_of,
    with_strand,
)
from dg4d_lib.mesh.folds import self_intersecting
from dg4d_lib.mesh.neighbors import edge_graph, grown

TRIED = 40  # largest number of candidate strands, the longest first
NEW = 0.5  # least share of the points of a strand that belong to no earlier one
RINGS = 4  # rings of vertices around the root that carry the strand
TURNS_DEG, SCALES = np.arange(-60.0, 61, 5), np.arange(0.7, 1.31, 0.1)  # trial rotations and scales about the root
FAR = 24.0  # pixels from a middle line that count as lost
EFFORT = 4.0  # pixels: gain required for a turn by 60 degrees, or a change by half of the length
LOST = 3.0  # mean distance from middle lines, pixels, above which a frame does not show the strand
SHOWN = 0.4  # least share of its points that the surface does not cover
SEEN = 0.5  # least share of the frames that show it
STIFF = (3.0, 3.0, 2.0, 2.0, 1.0, 1.0)  # standard deviation of the steps of bending along the rings, by rounds
SHARP = 0.5  # cosine between steps of a tracked line below which tracking has lost it
SLOPES = (0.0, -0.25, 0.25, -0.5, 0.5, -1.0, 1.0, -1.5, 1.5)  # trial slopes of the depth along a strand
GENTLE = 4.0  # crossing faces per frame that a slope of 1 must avoid
USED = 8.0  # pixels around a strand whose middle lines are no targets of others

Vertices = Float64[np.ndarray, "v 3"]
Poses = Float64[np.ndarray, "p v 3"]  # of the frames, and of the rest shape


class Fit(NamedTuple):
    """Result of the search for a strand in one frame.

    Attributes:
        line: column and row of its points; None if it is not shown.
        turn: about its root, from where the surface carries it, radians.
        scale: of its length.
        distance: of its points from middle lines, mean, pixels.
    """

    line: Float64[np.ndarray, "k 2"] | None
    turn: float
    scale: float
    distance: float


def grow_moving_strands(
    vertices: Float[Tensor, "v 3"],
    offsets: Float[Tensor, "t v 3"],
    faces: Int[Tensor, "f 3"],
    alpha: Float[Tensor, "t i j"],
    reference_frame: int,
) -> tuple[Float[Tensor, "w 3"], Float[Tensor, "t w 3"], Int[Tensor, "g 3"], tuple[Tube, ...]]:
    """Return the mesh and its offsets with the strands that the video shows beyond its outlines, and the strands.

    Args:
        vertices: in the reference frame, welded, world units.
        offsets: of the vertices at every frame.
        faces: counter-clockwise seen from outside.
        alpha: of the video, at the input view.
        reference_frame: in which the surface is best; strands grow there first.
    """
    poses = torch.cat([vertices + offsets, vertices[None]]).double().numpy()
    corners, covered = faces.numpy(), np.zeros((len(alpha), SIZE, SIZE), bool)
    targets, candidates = [np.zeros((0, 2))] * len(alpha), list[tuple[int, Strand]]()

    def find_candidates(frame: int) -> None:
        covered[frame] = covered_pixels(poses[frame], corners)
        seen = _uncovered_lines(alpha[frame], covered[frame])
        targets[frame] = _targets(seen)
        candidates.extend((frame, strand) for strand in find_strands(seen))

    run_parallel([partial(find_candidates, frame) for frame in range(len(alpha))])
    candidates.sort(key=lambda one: (one[0] != reference_frame, -len(one[1].points), one[0]))
    tubes: tuple[Tube, ...] = ()
    tries = 0
    for frame, strand in candidates:
        if tries == TRIED:
            break
        if len(targets[frame]) == 0 or _mark_near(strand.points, targets[frame], USED / 2).mean() < NEW:
            continue
        tries += 1
        larger = with_strand(Grown(poses[frame], corners, tubes), strand)
        if larger is None:
            continue
        moved = np.concatenate([poses, np.repeat(larger.vertices[None, poses.shape[1] :], len(poses), 0)], 1)
        moved, lines, shown = _track_strand(larger.vertices, larger.faces, larger.tubes[-1], moved, targets, covered)
        if shown < SEEN:
            continue
        moved[frame] = larger.vertices
        corners, tubes = larger.faces, larger.tubes
        poses = _best_slope(moved, corners, tubes, len(tubes) - 1)
        targets = _drop_near(targets, lines)
    if not tubes:
        return vertices, offsets, faces, ()
    together = torch.from_numpy(poses).to(vertices)
    return together[-1], together[:-1] - together[-1], torch.from_numpy(corners).to(faces), tubes


def find_strands_again(
    vertices: Float[Tensor, "v 3"],
    offsets: Float[Tensor, "t v 3"],
    faces: Int[Tensor, "f 3"],
    tubes: Sequence[Tube],
    alpha: Float[Tensor, "t i j"],
) -> Float[Tensor, "t v 3"]:
    """Return the offsets with strands where the video shows them, for a surface that has moved since they grew.

    Args:
        vertices: in the reference frame, welded, world units.
        offsets: of the vertices at every frame.
        faces: counter-clockwise seen from outside.
        tubes: strands of the mesh.
        alpha: of the video, at the input view.
    """
    poses = torch.cat([vertices + offsets, vertices[None]]).double().numpy()
    corners, strands = faces.numpy(), np.zeros(len(vertices), bool)
    strands[np.concatenate([_vertices_of(tube) for tube in tubes])] = True
    body = corners[~strands[corners].any(1)]
    covered, targets = np.zeros((len(alpha), SIZE, SIZE), bool), [np.zeros((0, 2))] * len(alpha)

    def find_targets(frame: int) -> None:
        covered[frame] = covered_pixels(poses[frame], body)
        targets[frame] = _targets(_uncovered_lines(alpha[frame], covered[frame]))

    run_parallel([partial(find_targets, frame) for frame in range(len(alpha))])
    for index, tube in enumerate(tubes):
        poses, lines, _ = _track_strand(poses[-1], corners, tube, poses, targets, covered, known=True)
        poses = _best_slope(poses, corners, tubes, index)
        targets = _drop_near(targets, lines)
    return torch.from_numpy(poses[:-1]).to(offsets) - vertices


def _uncovered_lines(alpha: Float[Tensor, "i j"], covered: Bool[np.ndarray, "h w"]) -> MiddleLines:
    """Return the middle lines of the parts of a frame that the surface does not cover."""
    return middle_lines(enlarged_masks(alpha[None], SIZE)[0].numpy(force=True), covered)


def _targets(lines: MiddleLines) -> Float64[np.ndarray, "p 2"]:
    """Return column and row of the pixels of middle lines that may be strands."""
    pixels = np.stack(np.nonzero(lines.marks & (lines.radius <= THICKEST)), 1)
    targets: Float64[np.ndarray, "p 2"] = pixels[:, ::-1] + lines.corner + 0.5
    return targets


def _mark_near(
    points: Float64[np.ndarray, "p 2"], others: Float64[np.ndarray, "q 2"], distance: float
) -> Bool[np.ndarray, " p"]:
    """Mark the points that are near one of the others."""
    return np.asarray(cKDTree(others).query(points)[0]) < distance


def _drop_near(
    targets: list[Float64[np.ndarray, "_ 2"]], lines: list[Float64[np.ndarray, "k 2"]]
) -> list[Float64[np.ndarray, "_ 2"]]:
    """Return the targets of every frame that are not near a line."""
    return [
        here[~_mark_near(here, line, USED)] if len(here) else here for here, line in zip(targets, lines, strict=True)
    ]


def _vertices_of(tube: Tube) -> Int[np.ndarray, " n"]:
    """Return the vertices of a strand."""
    return np.append(tube.rings.ravel(), tube.tip)


def _track_strand(
    shape: Vertices,
    faces: Int[np.ndarray, "f 3"],
    tube: Tube,
    poses: Poses,
    targets: list[Float64[np.ndarray, "_ 2"]],
    covered: Bool[np.ndarray, "t h w"],
    known: bool = False,
) -> tuple[Poses, list[Float64[np.ndarray, "k 2"]], float]:
    """Return all poses with a strand where the frames show it, its lines there, and the share of those that do.

    Args:
        shape: vertices with the strand as it grew.
        faces: of the mesh with the strand.
        tube: the strand.
        poses: of the other vertices.
        targets: column and row of the pixels of middle lines, by frame.
        covered: pixels of the mesh without the strand.
        known: the poses have the strand, where tracking left it.
    """
    own, moved = _vertices_of(tube), poses.copy()
    near = np.zeros(len(shape), bool)
    near[tube.root] = True
    near = grown(near, edge_graph(faces, len(near)), RINGS)
    near[own] = False
    lines, fits = [np.zeros((0, 2))] * len(targets), [Fit(None, 0.0, 1.0, FAR)] * len(targets)

    def carry(frame: int) -> None:
        pose = moved[frame]
        tracked = _projected_line(pose, tube)[0] if known and frame < len(targets) else None
        pose[own] = shape[own] + (pose[near] - shape[near]).mean(0)
        if frame == len(targets):
            return
        lines[frame], root = _projected_line(pose, tube)
        fits[frame] = _fit_line(lines[frame], root, targets[frame], covered[frame])
        if tracked is not None and _is_regular(tracked, lines[frame], root):
            other = _fit_line(tracked, root, targets[frame], covered[frame])
            if other.line is None:
                other = other._replace(line=tracked, distance=FAR)
            fits[frame] = min(fits[frame], other, key=lambda fit: np.inf if fit.line is None else fit.distance)

    run_parallel([partial(carry, frame) for frame in range(len(moved))])
    shown = np.flatnonzero([fit.line is not None for fit in fits])
    if len(shown) == 0:
        return moved, lines, 0.0
    for frame, fit in enumerate(fits):
        line, root = _projected_line(moved[frame], tube)
        turn, scale = (np.interp(frame, shown, [getattr(fits[k], name) for k in shown]) for name in ("turn", "scale"))
        lines[frame] = _turn_lines(line, root, np.array([turn]), np.array([scale]))[0] if fit.line is None else fit.line
        _place_strand(shape, moved[frame], tube, lines[frame])
    return moved, lines, len(shown) / len(targets)


def _best_slope(poses: Poses, faces: Int[np.ndarray, "f 3"], tubes: Sequence[Tube], index: int) -> Poses:
    """Return all poses with a strand in the slope, the same in all, at which it crosses few faces (`GENTLE`)."""
    own = np.zeros(poses.shape[1], bool)
    own[_vertices_of(tubes[index])] = True
    near, eye = own[faces].any(1), CAMERA.position().numpy()
    shifts = np.zeros_like(poses)
    for pose, shift in zip(poses, shifts, strict=True):
        tube = tubes[index]
        middle = np.concatenate([pose[tube.root].mean(0, keepdims=True), _ring_centers(pose, tube)])
        lengths = np.linalg.norm(np.diff(middle, axis=0), axis=1).cumsum()
        rays = pose[_vertices_of(tube)] - eye
        shift[_vertices_of(tube)] = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        shift[_vertices_of(tube)] *= np.append(np.repeat(lengths[:-1], len(tube.root)), lengths[-1])[:, None]
        for later in tubes[index + 1 :]:
            shift[_vertices_of(later)] += shift[later.root].mean(0)  # strands that grew out of it go with it
    counts = np.zeros((len(SLOPES), len(poses)), np.int64)

    def count(pose: int) -> None:
        for row, slope in zip(counts, SLOPES, strict=True):
            row[pose] = self_intersecting(poses[pose] + slope * shifts[pose], faces, near).sum()

    run_parallel([partial(count, pose) for pose in range(len(poses))])
    best = (counts.mean(1) + GENTLE * np.abs(SLOPES)).argmin()
    sloped: Poses = poses + SLOPES[best] * shifts
    return sloped


def _projected_line(pose: Vertices, tube: Tube) -> tuple[Float64[np.ndarray, "k 2"], Float64[np.ndarray, "1 2"]]:
    """Return column and row of the middle line of a strand, and those of its root."""
    return pixels_of(_ring_centers(pose, tube))[0], pixels_of(pose[tube.root].mean(0, keepdims=True))[0]


def _place_strand(shape: Vertices, pose: Vertices, tube: Tube, line: Float64[np.ndarray, "k 2"]) -> None:
    """Move a strand to a line in the picture, at the depth that it has; its rings are those of the shape, turned."""
    centers = _ring_centers(pose, tube)
    step = line - pixels_of(centers)[0]
    after = centers + step * pixels_of(centers)[1][:, None] / CAMERA.focal @ CAMERA.viewmat().numpy()[:2, :3]
    before = _ring_centers(shape, tube)
    directions = zip(_directions(shape, tube, before), _directions(pose, tube, after), strict=True)
    turns = [Rotation.align_vectors(to[None], along[None])[0] for along, to in directions]
    for ring, center, new, turn in zip(tube.rings, before, after, turns, strict=False):
        pose[ring] = turn.apply(shape[ring] - center) + new
    pose[tube.tip] = after[-1]


def _ring_centers(pose: Vertices, tube: Tube) -> Float64[np.ndarray, "k 3"]:
    """Return the middle line of a strand."""
    return np.concatenate([pose[tube.rings].mean(1), pose[tube.tip, None]])


def _directions(pose: Vertices, tube: Tube, centers: Float64[np.ndarray, "k 3"]) -> Float64[np.ndarray, "k 3"]:
    """Return the directions of a middle line that begins at the root of a strand."""
    root = pose[tube.root].mean(0, keepdims=True)
    directions: Float64[np.ndarray, "k 3"] = np.gradient(np.concatenate([root, centers]), axis=0)[1:]
    return directions


def _turn_lines(
    line: Float64[np.ndarray, "k 2"],
    root: Float64[np.ndarray, "1 2"],
    turns: Float64[np.ndarray, " n"],
    scales: Float64[np.ndarray, " n"],
) -> Float64[np.ndarray, "n k 2"]:
    """Return a line, turned and scaled about its root."""
    cosines, sines = scales * np.cos(turns), scales * np.sin(turns)
    matrices = np.stack([np.stack([cosines, sines], -1), np.stack([-sines, cosines], -1)], 1)
    turned: Float64[np.ndarray, "n k 2"] = (line - root) @ matrices + root
    return turned


def _fit_line(
    line: Float64[np.ndarray, "k 2"],
    root: Float64[np.ndarray, "1 2"],
    targets: Float64[np.ndarray, "p 2"],
    covered: Bool[np.ndarray, "h w"],
) -> Fit:
    """Return a line, turned and scaled about its root and bent to the targets, if the frame shows it."""
    if len(targets) == 0:
        return Fit(None, 0.0, 1.0, FAR)
    tree = cKDTree(targets)

    def distances(points: Float64[np.ndarray, "*n 2"]) -> tuple[Float64[np.ndarray, "*n"], Bool[np.ndarray, "*n"]]:
        """Return the distances of points from middle lines, and mark those that the surface covers."""
        columns, rows = np.moveaxis(points.astype(np.int64).clip(0, SIZE - 1), -1, 0)
        near = np.asarray(tree.query(points, distance_upper_bound=FAR)[0]).clip(max=FAR)
        return near, covered[rows, columns]

    turns, scales = (grid.ravel() for grid in np.meshgrid(np.radians(TURNS_DEG), SCALES))
    tried = _turn_lines(line, root, turns, scales)
    near, hidden = distances(tried)
    costs = np.where(hidden, NEAR, near).mean(-1) + EFFORT * (np.abs(turns) / np.radians(60) + 2 * np.abs(scales - 1))
    best = costs.argmin()
    bent = tried[best]
    for stiff in STIFF:
        apart, nearest = map(np.asarray, tree.query(bent, distance_upper_bound=FAR))
        steps = np.zeros_like(bent)
        steps[apart < FAR] = targets[nearest[apart < FAR]] - bent[apart < FAR]
        along = np.gradient(np.concatenate([root, bent]), axis=0)[1:]
        along /= np.linalg.norm(along, axis=1, keepdims=True).clip(1e-9)
        steps -= (steps * along).sum(1, keepdims=True) * along  # points keep their distances
        bent = bent + ndimage.gaussian_filter1d(steps, stiff, axis=0, mode="nearest")
    near, hidden = distances(bent)
    distance = float(near[~hidden].mean()) if (~hidden).any() else FAR
    shown = (~hidden).mean() >= SHOWN and distance <= LOST
    return Fit(bent if shown else None, float(turns[best]), float(scales[best]), distance)


def _is_regular(
    line: Float64[np.ndarray, "k 2"], other: Float64[np.ndarray, "k 2"], root: Float64[np.ndarray, "1 2"]
) -> bool:
    """Return whether a line has the length of another one, about, and no sharp bend."""
    steps, others = (np.diff(np.concatenate([root, points]), axis=0) for points in (line, other))
    lengths = np.linalg.norm(steps, axis=1)
    share = lengths.sum() / max(float(np.linalg.norm(others, axis=1).sum()), 1e-9)
    cosines = (steps[1:] * steps[:-1]).sum(1) / (lengths[1:] * lengths[:-1]).clip(1e-9)
    return bool(SCALES[0] <= share <= SCALES[-1] and cosines.min(initial=1) > SHARP)
