"""Motion of a surface of two rigid parts, one of which opens about a hinge on the other."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from dg4d_lib.asset_settings import AssetSettings
from dg4d_lib.deformation.on_parts import AnyField, OnParts
from dg4d_lib.fitting.asset_fit import AssetFit
from dg4d_lib.fitting.asset_motion import Report, report_after, thinned_graph
from dg4d_lib.fitting.hinge import Cut, HingeSearch
from dg4d_lib.fitting.rigid_fit import ITERATIONS, fit_rigid_motion
from dg4d_lib.fitting.rigid_parts import RigidMotion, of_one_part, two_rigid_parts
from dg4d_lib.fitting.surface_tracking import bind_vertices
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.mirror import mirror_normal
from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.rasterizer.interface import Rasterizer
from dg4d_lib.video.driving import DrivingVideo

WORSE = 2.5  # largest error of two rigid parts relative to the free motion: insides are unknown
NEAR = 0.12  # world units: edges between the parts this close to the hinge connect them
TORN, MOST = 0.4, 0.98  # least log ratio of edge lengths at an opening lid, and the quantile that is compared
HINGE_ITERATIONS = 2 * ITERATIONS  # largest number of reported iterations


@dataclass(frozen=True)
class Hinged:
    """Motion of a surface of two parts.

    Attributes:
        surfaces: one per frame.
        motion: of both parts.
        cut: between them.
    """

    surfaces: list[InflatedSurface]
    motion: RigidMotion
    cut: Cut

    def carrying(self, field: AnyField, gaussians: Gaussians) -> OnParts:
        """Return the deformation of Gaussians at rest that move with their parts and by a field."""
        motion, owners = self.motion, self.cut.above(gaussians.means).long()
        return OnParts(field, owners, gaussians.quats, motion.centers, motion.quats, motion.places)


def track_hinge(
    free: Sequence[InflatedSurface],
    gaussians: Gaussians,
    video: DrivingVideo,
    rasterize: Rasterizer,
    settings: AssetSettings,
    report: Report = lambda iteration, values: None,
) -> Hinged | None:
    """Track a surface as two rigid parts joined by a hinge, if such a motion explains the video.

    Args:
        free: the surface at all frames of a motion along the video without parts.
        gaussians: static, fitted to the first frame, near the surface.
        video: of the camera at azimuth and elevation 0.
        rasterize: rasterizer.
        settings: of the fit.
        report: called after every step with (steps done, named losses).

    Returns:
        None if the free motion does not tear between two parts (a waist bends, a lid opens),
        two rigid parts do not show the video, or none of the hinges stands out.
    """
    surface = free[0]
    vertices = torch.stack([one.vertices for one in free])
    points, graph, bound = bind_vertices(surface.vertices, surface.faces, settings)
    tree = cKDTree(surface.vertices.numpy())

    def nearest(places: Float[Tensor, "n 3"]) -> Int[Tensor, " n"]:
        return torch.from_numpy(np.asarray(tree.query(places.numpy())[1]))

    rigid = two_rigid_parts(bound, vertices)
    if rigid is None:
        return None
    cut = Cut.between(graph.nodes, rigid.parts)
    if not _tears(vertices[:, nearest(graph.nodes)], graph.edges, cut.above(graph.nodes)):
        return None
    thin, moving = thinned_graph(gaussians, bound.of(nearest(gaussians.means)), settings.fit_points)
    normal = mirror_normal(points) if settings.across else None
    fit = AssetFit(thin, moving, video, rasterize, settings, normal, resting=True)
    shifts = (vertices - vertices[0])[:, nearest(thin.means)]
    allowed = WORSE * fit.difference_of(fit.cloud.means + shifts)
    rigid = fit_rigid_motion(fit, rigid, report)
    if fit.difference(rigid.of_nodes(graph)) > allowed:
        return None
    found = HingeSearch(fit, rigid, surface.vertices, surface.faces).best(cut)
    if found is None:
        return None
    parts, hinge = found.parts, found.hinge
    fit = fit.with_graph(of_one_part(moving, parts, found.cut.above(thin.means).long()))
    start = hinge.opened(replace(rigid, parts=parts), found.angles)
    ends = graph.nodes[graph.edges]
    held = (parts[graph.edges[:, 0]] != parts[graph.edges[:, 1]]) & (hinge.distances(ends.mean(1)) < NEAR)
    edges = torch.nonzero(held)[:, 0]
    rigid = fit_rigid_motion(fit, start, partial(report_after, report, ITERATIONS), edges)
    opened = rigid.of_nodes(fit.graph)
    if fit.difference(opened) > allowed:
        return None
    owners = found.cut.above(surface.vertices).long()
    moved = opened.points(surface.vertices, of_one_part(bound, parts, owners))
    return Hinged([surface, *(replace(surface, vertices=one) for one in moved[1:])], rigid, found.cut)


def _tears(nodes: Float[Tensor, "t m 3"], edges: Int[Tensor, "e 2"], above: Bool[Tensor, " m"]) -> bool:
    """Return True if edges across a cut change their length more than bending the surface would."""
    across = edges[above[edges[:, 0]] != above[edges[:, 1]]]
    if not len(across):
        return False
    lengths = (nodes[:, across[:, 0]] - nodes[:, across[:, 1]]).norm(dim=-1).clamp(min=1e-6)
    strain = (lengths / lengths[0]).log().abs()
    return float(strain.quantile(MOST, dim=1).max()) >= TORN
