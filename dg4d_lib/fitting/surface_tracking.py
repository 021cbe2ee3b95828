"""Tracking of a subject's surface through its video, from its surface at one frame."""

from dataclasses import replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from dg4d_lib.asset_settings import AssetSettings
from dg4d_lib.fitting.asset_motion import Report, fit_asset_motion, iterations, report_after
from dg4d_lib.fitting.tracking_order import tracking_orders
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.mesh.extraction.topology import group_vertices
from dg4d_lib.mesh.models.control_graph import ControlGraph, build_control_graph
from dg4d_lib.rasterizer.interface import Rasterizer
from dg4d_lib.video.driving import DrivingVideo

DESCENT = AssetSettings(  # for surfaces that are guesses: what flow takes for certain tears them
    tracking="descent",
    rigidity_loss="l1",
    track_iterations=40,
    joint_iterations=100,
    size=96,
    lr=0.006,
    smoothing=4.0,
    rigidity=0.3,
    inertia=0.02,
    smoothness=0.02,
    depth=0.005,
    whole_depth=0.15,
    across=0.0,
    rigid_parts=0,
)
LOST = 0.85  # overlap of silhouettes with the video, IoU, below which it does not tell which motion is the better one
WORSE = 0.05  # by which it may be smaller in a second try, for what is lost: limbs that swing do not stretch
GAIN = 0.01  # by which it must be larger in a second try, for what is not lost
CELL = 0.02  # world units: vertices in one cell move alike; distances along a finer surface take a minute


def swinging(settings: AssetSettings) -> AssetSettings:
    """Return the settings of the second try for surfaces that lose the outline: wings and limbs that swing far."""
    return settings.model_copy(update={"integrate_rotations": True, "rigidity": 0.5})


def swinging_is_better(overlap: float, swinging_overlap: float) -> bool:
    """Return True if the motion of the second try is kept.

    Args:
        overlap: of silhouettes with the video in the first try, IoU, mean over frames.
        swinging_overlap: likewise, in the second try.
    """
    return swinging_overlap > (overlap - WORSE if overlap < LOST else overlap + GAIN)


def tracking_iterations(settings: AssetSettings, video: DrivingVideo) -> int:
    """Return the number of iterations that `track_surface` reports."""
    orders = tracking_orders(video, 0)
    return sum(iterations(settings, len(chosen)) for chosen in orders if len(chosen) > 1)


def track_surface(
    surface: InflatedSurface,
    gaussians: Gaussians,
    video: DrivingVideo,
    rasterize: Rasterizer,
    settings: AssetSettings,
    generator: torch.Generator,
    report: Report = lambda iteration, values: None,
) -> list[InflatedSurface]:
    """Move a surface as a video shows it; sides that the video does not show move as rigidly as possible with it.

    Args:
        surface: of the first frame, which stays as it is.
        gaussians: static, fitted to the first frame, near the surface: what the fit renders.
        video: of the camera at azimuth and elevation 0.
        rasterize: rasterizer.
        settings: of the fit.
        generator: draws the frames of joint iterations.
        report: called after every iteration with (iterations done, named losses).

    Returns:
        Surfaces, one per frame.

    Raises:
        FitDiverged: the loss became non-finite.
    """
    moved = track_vertices(
        surface.vertices, surface.faces, gaussians, video, rasterize, settings, generator, report=report
    )
    return [surface, *(replace(surface, vertices=vertices) for vertices in moved[1:])]


def bind_vertices(
    vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], settings: AssetSettings
) -> tuple[Float[np.ndarray, "p 3"], ControlGraph, ControlGraph]:
    """Return points on a surface, the graph that moves them, and the one that moves the vertices.

    Args:
        vertices: world units.
        faces: of the surface.
        settings: number of nodes, and how they are joined.
    """
    points = vertices.double().numpy()
    first, index = group_vertices(points, CELL)
    points, joined = points[first], index[faces.numpy()]
    whole = (joined != np.roll(joined, 1, 1)).all(1)
    graph = build_control_graph(points, joined[whole], settings.nodes, settings.tracking == "flow")
    return points, graph, graph.of(torch.from_numpy(index))


def track_vertices(
    vertices: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    gaussians: Gaussians,
    video: DrivingVideo,
    rasterize: Rasterizer,
    settings: AssetSettings,
    generator: torch.Generator,
    reference_frame: int = 0,
    report: Report = lambda iteration, values: None,
) -> Float[Tensor, "t v 3"]:
    """Move the vertices of a surface as a video shows it, from its reference frame in both directions.

    Args:
        vertices: at the reference frame, where they stay as they are.
        faces: counter-clockwise seen from outside.
        gaussians: one state, fitted to the reference frame, near the surface: what the fit renders.
        video: of the camera at azimuth and elevation 0.
        rasterize: rasterizer.
        settings: of the fit.
        generator: draws the frames of joint iterations.
        reference_frame: frame of the video.
        report: called after every iteration with (iterations done, named losses).

    Raises:
        FitDiverged: the loss became non-finite.
    """
    points, graph, bound = bind_vertices(vertices, faces, settings)
    nearest = torch.from_numpy(np.asarray(cKDTree(points).query(gaussians.means.double().numpy())[1]))
    moved, done = vertices.repeat(len(video), 1, 1), 0
    for chosen in tracking_orders(video, reference_frame):
        if len(chosen) > 1:
            part = DrivingVideo(video.frames[chosen], video.alpha[chosen], video.fps)
            told = partial(report_after, report, done)
            motion = fit_asset_motion(
                gaussians, graph.of(nearest), part, rasterize, settings, generator, told, points, resting=True
            )
            done += iterations(settings, len(part))
            for number, frame in enumerate(chosen[1:], 1):
                moved[frame] = motion.at(slice(number, number + 1)).points(vertices, bound)[0]
    return moved
