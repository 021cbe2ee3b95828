"""Registration of a tracked mesh to the outlines of the subject, frame by frame.

The mesh is pulled to the isosurface of the Gaussians along its normals, and its outlines to those of the driving video
at the input view and of the Gaussians from the side, by iterative closest points in the picture. It holds together by
an as-rigid-as-possible energy; every step starts from the last positions, so a limb may grow longer or shorter. Folds
and crossings are smoothed away in between.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.normals import vertex_normals
from dg4d_lib.kernels.workers import run_parallel
from dg4d_lib.mesh.extraction.density import DensityField, density_field
from dg4d_lib.mesh.extraction.silhouettes import ALPHA_THRESHOLD, enlarged_masks, surroundings
from dg4d_lib.mesh.extraction.unfold import unfold
from dg4d_lib.mesh.fairing import LowPass, bump_filter
from dg4d_lib.mesh.tracking.elastic import ElasticBody
from dg4d_lib.mesh.tracking.isosurface_projection import steps_to_isosurface
from dg4d_lib.mesh.tracking.nonrigid_registration import closest_steps
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh
from dg4d_lib.rasterizer.interface import Rasterizer
from dg4d_lib.settings import MeshSettings

SIZE = 512  # pixels of the compared outlines
AZIMUTHS_DEG = (0.0, 90.0)  # the input view and the right side
FACING = 12.0  # weight of unit normals in the distance of outline points, pixels; keeps the sides of a limb apart
LONGEST = 24.0  # pixels of a step
BLUR = 2.0  # standard deviation of the mask whose gradient is the normal of an outline, pixels
FIRST_ROUNDS = ((2, 6),)  # passes to the isosurface alone, and to outlines too; then folds and crossings are smoothed
LAST_ROUNDS = ((0, 2), (0, 2))  # smoothing draws outlines in a little, so they are fitted again
GOOD_OVERLAP = 0.97  # IoU with the silhouette of the video, above which a frame needs no other start
GAIN = 0.005  # least gain of IoU by another start
SPEED = 0.5  # share of the last step that is extrapolated beyond the middle of a loop
ROTATIONS = 2  # alternations of rotations and positions per pass
PULL, OUTLINE_PULL = 0.5, 3.0  # weights of the positions of vertices, on outlines and elsewhere, against 1 per edge


@dataclass(frozen=True)
class Outline:
    """Points on the border of a mask.

    Attributes:
        points: column and row, pixels, and outward unit normals times `FACING`.
        pixels: row and column of the pixels of the mask along its border.
    """

    points: Float[np.ndarray, "p 4"]
    pixels: tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]


def outline_of(mask: Bool[np.ndarray, "h w"]) -> Outline:
    """Return the border pixels of a mask with outward normals."""
    top, left, cropped = _cropped(mask, round(6 * BLUR))
    rows, columns = np.nonzero(cropped & ~ndimage.binary_erosion(cropped))
    blurred = ndimage.gaussian_filter(cropped.astype(np.float64), BLUR)
    down, right = (np.asarray(np.gradient(blurred, axis=axis)) for axis in (0, 1))
    normals = -np.stack([right[rows, columns], down[rows, columns]], 1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-6)
    rows, columns = rows + top, columns + left
    points = np.concatenate([np.stack([columns, rows], 1) + 0.5, FACING * normals], 1)
    return Outline(points.astype(np.float64), (rows, columns))


def _cropped(mask: Bool[np.ndarray, "h w"], margin: int) -> tuple[int, int, Bool[np.ndarray, "i j"]]:
    """Return first row, first column and content of the part of a mask that is not empty, with a margin."""
    if not mask.any():
        return 0, 0, mask[:2, :2]
    rows, columns = surroundings(mask, margin)
    return rows.start, columns.start, mask[rows, columns]


def register_to_outlines(
    vertices: Float[Tensor, "v 3"],
    offsets: Float[Tensor, "t v 3"],
    faces: Int[Tensor, "f 3"],
    states: Gaussians,
    alpha: Float[Tensor, "t h w"],
    level: float,
    rasterize: Rasterizer,
    settings: MeshSettings,
    rounds: Sequence[tuple[int, int]] = FIRST_ROUNDS,
    orders: Sequence[Sequence[int]] = (),
    loop: bool = False,
) -> Float[Tensor, "t v 3"]:
    """Return offsets by which the outlines of the mesh agree with those of the subject.

    Args:
        vertices: in the reference frame, not split along seams.
        offsets: of the tracked vertices at every frame.
        faces: counter-clockwise seen from outside.
        states: the cloud at every frame (fields "t n 3").
        alpha: of the driving video, at the input view.
        level: density of the surface.
        rasterize: the splatting backend.
        settings: mesh settings.
        rounds: passes to the isosurface alone and passes to outlines too, after which folds and crossings are smoothed
            away.
        orders: of the frames, each from the reference frame on. A frame that misses the outline of the video is tried
            again from where the correction of the frame before puts it. Empty: every frame for itself.
        loop: the two orders are the halves of a loop, and go on into each other as far as that is better.
    """
    cameras = [OrbitCamera(0, azimuth, width=SIZE, height=SIZE) for azimuth in AZIMUTHS_DEG]
    masks = [enlarged_masks(alpha, SIZE)]
    black = torch.zeros(3, device=states.means.device)
    for camera in cameras[1:]:
        with torch.no_grad():
            alphas = [rasterize(states.at(frame), [camera], black).alpha[0, ..., 0] for frame in range(len(offsets))]
        masks.append(torch.stack(alphas) > ALPHA_THRESHOLD)
    body = ElasticBody(vertices.double().numpy(), faces.numpy())
    smooth = bump_filter(body.rest, body.faces, settings.fairing)
    registered, overlaps = offsets.clone(), [-1.0] * len(offsets)

    def improve(frame: int, start: Float[Tensor, "v 3"]) -> bool:
        """Register a frame from a start; return True if its silhouette agrees better with the video's than before."""
        targets = [outline_of(mask[frame].numpy(force=True)).points for mask in masks]
        field = density_field(states.at(frame), settings)
        moved = _registered(body, vertices + start, faces, targets, cameras, field, level, rounds, smooth).to(offsets)
        overlap = _overlap(moved, faces, cameras[0], masks[0][frame])
        better = overlap > overlaps[frame] + GAIN
        if better:
            registered[frame], overlaps[frame] = moved - vertices, overlap
        return better

    def hand_on(order: Sequence[int]) -> None:
        for before, frame in pairwise(order):
            if overlaps[frame] < GOOD_OVERLAP:
                improve(frame, offsets[frame] + registered[before] - offsets[before])

    def go_on(order: Sequence[int], other: Sequence[int]) -> None:
        before, last = order[-2:]
        for frame in other[:0:-1]:
            if not improve(frame, registered[last] + SPEED * (registered[last] - registered[before])):
                return
            before, last = last, frame

    run_parallel([partial(improve, frame, offsets[frame]) for frame in range(len(offsets))])
    run_parallel([partial(hand_on, order) for order in orders])
    if loop:
        go_on(*orders)
        go_on(*orders[::-1])
    return registered


def outline_steps(
    moved: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    target: Float[np.ndarray, "p 4"],
    camera: OrbitCamera,
    detail: float | None = None,
) -> tuple[Float64[np.ndarray, "v 3"], Float64[np.ndarray, " v"]]:
    """Return steps of vertices along the outline of a mesh towards a target, parallel to the picture.

    Every point of one outline goes to the nearest of the other, and back; a point belongs to the triangle it lies on.

    Args:
        moved: vertices, world units.
        faces: indices into the vertices.
        target: `points` of the target's outline.
        camera: camera of the picture.
        detail: pixels; points step across the outline only, and those that are farther from the target do not count.
            None: points step in any direction, all of them, by at most `LONGEST`.

    Returns:
        Mean step of every vertex, world units, and its share of outline points, which is 0 away from the outline.
    """
    fragments = rasterize_mesh(moved, faces, [camera])
    ids = fragments.faces[0].numpy()
    outline = outline_of(ids >= 0)
    total = np.zeros((len(moved), 3))
    if len(target) == 0 or len(outline.points) == 0:
        return total, np.zeros(len(moved))
    steps = closest_steps(outline.points, target)
    if detail is not None:
        normals = outline.points[:, 2:] / FACING
        steps = (steps * normals).sum(1, keepdims=True) * normals
    lengths = np.linalg.norm(steps, axis=1)
    counted = np.flatnonzero(lengths <= (np.inf if detail is None else detail))
    steps = (steps * np.minimum(1, LONGEST / np.maximum(lengths, 1e-9))[:, None])[counted]
    rows, columns = (places[counted] for places in outline.pixels)
    depth = fragments.depth[0].numpy()[rows, columns]
    axes = camera.viewmat().numpy()[:2, :3]  # right and down
    in_world = steps @ axes * (depth / camera.focal)[:, None]
    weights = fragments.barycentrics[0].numpy()[rows, columns].astype(np.float64)
    corners = faces.numpy()[ids[rows, columns]]
    share = np.bincount(corners.ravel(), weights.ravel(), len(moved)).astype(np.float64)
    for axis in range(3):
        total[:, axis] = np.bincount(corners.ravel(), (weights * in_world[:, axis, None]).ravel(), len(moved))
    return total / share.clip(1e-6)[:, None], share.clip(max=1)


def _overlap(
    moved: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], camera: OrbitCamera, mask: Bool[Tensor, "h w"]
) -> float:
    """Return the intersection over union of the silhouette of a mesh and a mask."""
    shown = rasterize_mesh(moved, faces, [camera]).faces[0] >= 0
    return float((shown & mask).sum() / (shown | mask).sum().clamp(min=1))


def _registered(
    body: ElasticBody,
    start: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    targets: list[Float[np.ndarray, "_ 4"]],
    cameras: list[OrbitCamera],
    field: DensityField,
    level: float,
    rounds: Sequence[tuple[int, int]],
    smooth: LowPass,
) -> Float[Tensor, "v 3"]:
    """Return the registered vertices of one frame."""
    moved = start.double().numpy()
    for first, then in rounds:
        for number in range(first + then):
            shown = torch.from_numpy(moved).float()
            normals = vertex_normals(shown, faces).numpy()
            distances = smooth(steps_to_isosurface(field, shown.numpy(), normals, level))
            steps: NDArray[np.float64] = distances[:, None] * normals.astype(np.float64)
            pull = np.full(len(moved), PULL)
            if number >= first:
                at_outline, towards = _outline_pull(shown, faces, targets, cameras)
                steps += at_outline[:, None] * (towards - steps)
                pull += (OUTLINE_PULL - PULL) * at_outline
            moved = body.settle(moved, moved + steps, pull, passes=ROTATIONS)
        moved = unfold(moved, body.faces)
    return torch.from_numpy(moved)


def _outline_pull(
    moved: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    targets: list[Float[np.ndarray, "_ 4"]],
    cameras: list[OrbitCamera],
) -> tuple[Float64[np.ndarray, " v"], Float64[np.ndarray, "v 3"]]:
    """Return by how much every vertex lies on an outline, in [0, 1], and its mean step over the views."""
    total, share = np.zeros((len(moved), 3)), np.zeros(len(moved))
    for target, camera in zip(targets, cameras, strict=True):
        step, weight = outline_steps(moved, faces, target, camera)
        total += weight[:, None] * step
        share += weight
    return share.clip(max=1), total / share.clip(1e-6)[:, None]
