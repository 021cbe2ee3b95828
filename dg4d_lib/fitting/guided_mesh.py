"""Tracking of an extracted mesh through the driving video, where the Gaussians' own motion cannot guide it.

Gaussians that are fitted to fast limbs change places: those of one leg form another one some frames later, and a mesh
that follows them tears. Here the mesh follows the pictures instead, and the Gaussians only give its shape.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from skimage.measure import perimeter
from torch import Tensor

from dg4d_lib.asset_settings import AssetSettings
from dg4d_lib.fitting.surface_tracking import DESCENT, LOST, swinging, swinging_is_better, track_vertices
from dg4d_lib.fitting.tracking_order import is_loop, tracking_orders
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.extraction.density import density_field
from dg4d_lib.mesh.extraction.extract import extract_surface, select_level
from dg4d_lib.mesh.extraction.silhouettes import ALPHA_THRESHOLD, render_silhouettes, silhouette_iou
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh.tracking.color_registration import register_to_colors
from dg4d_lib.mesh.tracking.outline_registration import LAST_ROUNDS, register_to_outlines
from dg4d_lib.mesh.tracking.reference_frame import evenly_spaced
from dg4d_lib.rasterizer.interface import Rasterizer
from dg4d_lib.settings import MeshSettings
from dg4d_lib.video.driving import DrivingVideo

TRACKING = DESCENT.model_copy(update={"size": 128})
TRIAL = DESCENT.model_copy(
    update={"size": 64, "nodes": 100, "fit_points": 2500, "track_iterations": 12, "joint_iterations": 0}
)
TRIAL_ROUNDS = ((2, 4),)  # passes of the registration to outlines in a trial
TRIAL_FRAMES = 6  # frames at which silhouettes are compared
TRIAL_GRID = 48  # cells per axis of the density field
CANDIDATES = 3  # candidate frames with long outlines, besides the given ones
HANDLE_COST = 0.01  # allowed loss of IoU per handle that another frame has less
APART = 1 / 10  # smallest distance of two candidates, share of the frames
SHORTLIST, MARGIN = 2, 0.03  # largest number of frames for full extraction, and their largest IoU gap to the best trial


def follow_video(
    vertices: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    states: Gaussians,
    video: DrivingVideo,
    reference_frame: int,
    rasterize: Rasterizer,
    generator: torch.Generator,
) -> Float[Tensor, "t v 3"]:
    """Return the offsets by which the surface of one frame follows the driving video, before any registration.

    A surface that loses the outline is tracked a second time, with limbs that swing.

    Args:
        vertices: surface of the reference frame, not split along seams.
        faces: counter-clockwise seen from outside.
        states: the cloud at every frame (fields "t n 3").
        video: of the camera at azimuth and elevation 0.
        reference_frame: frame that the surface was extracted from.
        rasterize: the splatting backend.
        generator: draws the frames of joint iterations.

    Raises:
        FitDiverged: the loss became non-finite.
    """
    rest = states.at(reference_frame)
    silhouettes = render_silhouettes(states, range(len(video)), rasterize, video.alpha[..., 0])

    def track(tracking: AssetSettings) -> tuple[float, Float[Tensor, "t v 3"]]:
        moved = track_vertices(vertices, faces, rest, video, rasterize, tracking, generator, reference_frame)
        return float(silhouette_iou(moved, faces, silhouettes).mean()), moved

    overlap, moved = track(TRACKING)
    if overlap < LOST:
        second, other = track(swinging(TRACKING))
        moved = other if swinging_is_better(overlap, second) else moved
    return moved - vertices


def register_tracking(
    vertices: Float[Tensor, "v 3"],
    offsets: Float[Tensor, "t v 3"],
    faces: Int[Tensor, "f 3"],
    states: Gaussians,
    video: DrivingVideo,
    reference_frame: int,
    level: float,
    rasterize: Rasterizer,
    settings: MeshSettings,
) -> Float[Tensor, "t v 3"]:
    """Return the offsets of `follow_video`, registered to the outlines of the video, from frame to frame.

    Args:
        vertices: surface of the reference frame, not split along seams.
        offsets: of the vertices at every frame.
        faces: counter-clockwise seen from outside.
        states: the cloud at every frame (fields "t n 3").
        video: of the camera at azimuth and elevation 0.
        reference_frame: frame that the surface was extracted from.
        level: density of the surface.
        rasterize: the splatting backend.
        settings: mesh settings.
    """
    orders, alpha = tracking_orders(video, reference_frame), video.alpha[..., 0]
    return register_to_outlines(
        vertices, offsets, faces, states, alpha, level, rasterize, settings, orders=orders, loop=is_loop(video)
    )


def refine_tracking(
    mesh: TexturedMesh,
    sources: Int[Tensor, " w"],
    vertices: Float[Tensor, "v 3"],
    offsets: Float[Tensor, "t v 3"],
    faces: Int[Tensor, "f 3"],
    states: Gaussians,
    video: DrivingVideo,
    level: float,
    rasterize: Rasterizer,
    settings: MeshSettings,
) -> Float[Tensor, "t v 3"]:
    """Return the offsets of `register_tracking`, registered to the colors of the video and to its outlines again.

    Args:
        mesh: textured, split along seams.
        sources: vertex that every split vertex copies.
        vertices: surface of the reference frame, not split along seams.
        offsets: of the vertices at every frame.
        faces: counter-clockwise seen from outside, not split along seams.
        states: the cloud at every frame (fields "t n 3").
        video: of the camera at azimuth and elevation 0.
        level: density of the surface.
        rasterize: the splatting backend.
        settings: mesh settings.
    """
    pictures = video.over(video.frames.new_ones(3))
    offsets = register_to_colors(mesh, sources, vertices, offsets, faces, pictures)
    alpha = video.alpha[..., 0]
    return register_to_outlines(vertices, offsets, faces, states, alpha, level, rasterize, settings, LAST_ROUNDS)


def rank_guided_references(
    states: Gaussians,
    video: DrivingVideo,
    rasterize: Rasterizer,
    settings: MeshSettings,
    given: int,
    generator: torch.Generator,
    handles: Callable[[int], int] = lambda frame: 0,
) -> list[tuple[int, float]]:
    """Rank frames by how well their surfaces follow the driving video, by trials on a coarse grid.

    A frame yields to another one whose surface has fewer handles, where limbs that touch have grown together.

    Args:
        states: the cloud at every frame (fields "t n 3").
        video: of the camera at azimuth and elevation 0.
        rasterize: the splatting backend.
        settings: mesh settings.
        given: a frame that is tried too, besides the first one and those with the longest outlines.
        generator: draws the frames of joint iterations.
        handles: returns the number of handles of the surface that the mesh would have from a frame.

    Returns:
        Up to two frames that are about equal, the best first, each with the mean intersection over union of silhouettes
        over frames and views, in [0, 1].

    Raises:
        FitDiverged: the cloud is empty, or the loss became non-finite.
    """
    compared = evenly_spaced(len(video), TRIAL_FRAMES)
    alpha = video.alpha[compared][..., 0]
    silhouettes = render_silhouettes(states, compared, rasterize, alpha)
    coarse = settings.model_copy(update={"grid": min(TRIAL_GRID, settings.grid), "fairing": 0.0})
    scores = {}
    for frame in dict.fromkeys([0, given, *frames_with_long_outlines(video, CANDIDATES)]):
        rest = states.at(frame)
        field = density_field(rest, coarse)
        level, _ = select_level(field, rest, rasterize, settings.density_threshold)
        vertices, faces = (torch.from_numpy(array) for array in extract_surface(field, level))
        moved = track_vertices(vertices, faces, rest, video, rasterize, TRIAL, generator, frame)[compared]
        selected = states.states(compared)
        offsets = register_to_outlines(
            vertices, moved - vertices, faces, selected, alpha, level, rasterize, coarse, TRIAL_ROUNDS
        )
        scores[frame] = float(silhouette_iou(vertices + offsets, faces, silhouettes).mean())
    merits = {frame: score - HANDLE_COST * handles(frame) for frame, score in scores.items()}
    ranked = sorted(merits, key=lambda frame: -merits[frame])
    near = [frame for frame in ranked if merits[frame] > merits[ranked[0]] - MARGIN]
    return [(frame, scores[frame]) for frame in near[:SHORTLIST]]


def frames_with_long_outlines(video: DrivingVideo, count: int) -> list[int]:
    """Return frames whose outlines are long for their area, the longest first: limbs do not touch there."""
    masks = (video.alpha[..., 0] > ALPHA_THRESHOLD).numpy(force=True)
    lengths = [perimeter(mask, 8) / max(mask.sum(), 1) ** 0.5 for mask in masks]
    selected: list[int] = []
    for frame in sorted(range(len(video)), key=lambda frame: -lengths[frame]):
        if len(selected) < count and all(abs(frame - other) > APART * len(video) for other in selected):
            selected.append(frame)
    return selected
