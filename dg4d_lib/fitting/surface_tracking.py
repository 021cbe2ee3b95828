"""Tracking of a subject's surface through its video, from its surface at the first frame."""

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial import cKDTree

from dg4d_lib.asset_settings import AssetSettings
from dg4d_lib.fitting.asset_motion import Report, fit_asset_motion
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.mesh.extraction.topology import group_vertices
from dg4d_lib.mesh.models.control_graph import build_control_graph
from dg4d_lib.rasterizer.interface import Rasterizer
from dg4d_lib.video.driving import DrivingVideo

CELL = 0.02  # world units: vertices in one cell move alike; distances along a finer surface take a minute


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
    vertices = surface.vertices.double().numpy()
    first, index = group_vertices(vertices, CELL)
    points = vertices[first]
    faces = index[surface.faces.numpy()]
    whole = (faces != np.roll(faces, 1, 1)).all(1)
    graph = build_control_graph(points, faces[whole], settings.nodes)
    nearest = torch.from_numpy(np.asarray(cKDTree(points).query(gaussians.means.double().numpy())[1]))
    motion = fit_asset_motion(gaussians, graph.of(nearest), video, rasterize, settings, generator, report)
    bound = graph.of(torch.from_numpy(index))
    moved = [motion.at(slice(frame, frame + 1)).points(surface.vertices, bound)[0] for frame in range(1, len(video))]
    return [surface, *(replace(surface, vertices=vertices) for vertices in moved)]
