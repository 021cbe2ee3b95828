"""Motion of a user's model: rigid transforms of control nodes on its surface, fitted to a driving video.

The frames are tracked one after the other, by optical flow (`flow_tracking`) or by descent, then all are refined
together, under the losses of `asset_fit`. Where a few rigid parts explain the motion, and show the video better, they
replace it (`rigid_fit`).
"""

from collections.abc import Callable
from functools import partial
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float

from dg4d_lib.asset_settings import AssetSettings
from dg4d_lib.fitting.asset_fit import AssetFit
from dg4d_lib.fitting.flow_tracking import FlowTracker
from dg4d_lib.fitting.node_motion import NodeDescent, NodeMotion, NodeVariables
from dg4d_lib.fitting.node_pose import Pose
from dg4d_lib.fitting.rigid_fit import ITERATIONS as RIGID_ITERATIONS
from dg4d_lib.fitting.rigid_fit import fit_rigid_motion
from dg4d_lib.fitting.rigid_parts import find_rigid_parts
from dg4d_lib.fitting.tracking_order import tracking_orders
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.transform import thinned
from dg4d_lib.geometry.mirror import mirror_normal
from dg4d_lib.mesh.models.control_graph import ControlGraph
from dg4d_lib.rasterizer.interface import Rasterizer
from dg4d_lib.video.driving import DrivingVideo

FLOW_SHARE = 0.6  # share of the iterations with a flow loss; later ones use picture losses alone
EXPLAINED = 0.04  # error of the first frame up to which the model is at rest there
Report = Callable[[int, dict[str, float]], None]


def fit_asset_motion(
    cloud: Gaussians,
    graph: ControlGraph,
    video: DrivingVideo,
    rasterize: Rasterizer,
    settings: AssetSettings,
    generator: torch.Generator,
    report: Report = lambda iteration, values: None,
    surface: Float[np.ndarray, "p 3"] | None = None,
    resting: bool = False,
) -> NodeMotion:
    """Fit the motion of a placed model to a video of the camera at azimuth and elevation 0.

    Args:
        cloud: Gaussians of the model at rest.
        graph: control graph whose points are the Gaussians.
        video: its first frame shows the model about at rest.
        rasterize: rasterizer.
        settings: of the fit.
        generator: draws the frames of joint iterations.
        report: called after every iteration with (iterations done, named losses).
        surface: points of the model's surface at rest, whose mirror plane counts; None: the means of the Gaussians.
        resting: the first frame shows the model exactly at rest.

    Raises:
        FitDiverged: the loss became non-finite.
    """
    surface = cloud.means.double().numpy(force=True) if surface is None else surface
    normal = mirror_normal(surface) if settings.across else None
    thin, bound = thinned_graph(cloud, graph, settings.fit_points)
    found: list[tuple[float, NodeMotion, AssetFit]] = []
    done = 0
    for rigidity_loss in _rigidity_losses(settings):
        one = settings.model_copy(update={"rigidity_loss": rigidity_loss})
        fit = AssetFit(thin, bound, video, rasterize, one, normal, resting)
        motion = _track_and_refine(fit, video, one, generator, partial(report_after, report, done))
        found.append((fit.difference(motion), motion, fit))
        done += _free_iterations(one, len(video))
    difference, motion, fit = min(found, key=lambda one: one[0])
    most = settings.rigid_parts
    rigid = find_rigid_parts(motion, fit.graph, fit.cloud.means, most) if most else None
    if rigid is None:
        return motion
    better = fit_rigid_motion(fit, rigid, partial(report_after, report, done)).of_nodes(fit.graph)
    return better if fit.difference(better) < difference else motion


def iterations(settings: AssetSettings, frames: int) -> int:
    """Return the largest number of iterations that a fit reports."""
    free = len(_rigidity_losses(settings)) * _free_iterations(settings, frames)
    return free + (RIGID_ITERATIONS if settings.rigid_parts else 0)


def report_after(report: Report, before: int, done: int, values: dict[str, float]) -> None:
    """Report iterations, offset by those of earlier fits."""
    report(before + done, values)


def _free_iterations(settings: AssetSettings, frames: int) -> int:
    return settings.track_iterations * frames + settings.joint_iterations


def _rigidity_losses(settings: AssetSettings) -> list[Literal["l1", "log"]]:
    return ["l1", "log"] if settings.rigidity_loss == "best" else [settings.rigidity_loss]


def _track_and_refine(
    fit: AssetFit, video: DrivingVideo, settings: AssetSettings, generator: torch.Generator, report: Report
) -> NodeMotion:
    """Track all frames, then refine them together."""
    frames, done = len(video), settings.track_iterations * len(video)
    track = _track_by_flow if settings.tracking == "flow" else _track_by_descent
    variables = NodeVariables.joined(track(fit, video, settings, report)).trainable()
    descent = NodeDescent(variables, fit.basis, held=int(fit.resting))
    for step in range(settings.joint_iterations):
        selected = torch.randperm(frames, generator=generator)[: min(settings.joint_frames, frames)].sort().values
        moved = variables.motion(fit.basis)
        losses = fit.losses(moved.at(selected), selected.tolist())
        if frames > 2:
            nodes = moved.nodes(fit.graph)
            acceleration = fit.relative(nodes[2:] - 2 * nodes[1:-1] + nodes[:-2])
            losses["inertia"] = settings.smoothness * acceleration.square().sum(-1).mean()
        fit.step(losses, variables, f"joint iteration {step + 1}")
        descent.step(0.5 * settings.lr * (1 - 0.9 * step / settings.joint_iterations))
        done += 1
        report(done, {name: float(value.detach()) for name, value in losses.items()})
    return variables.detach().motion(fit.basis)


def _track_by_flow(fit: AssetFit, video: DrivingVideo, settings: AssetSettings, report: Report) -> list[NodeVariables]:
    """Track the frames by optical flow, loops from both ends; return their variables."""
    tracker = FlowTracker(fit.cloud, fit.graph, fit.colors, fit.alphas, fit.rasterize, settings, fit.normal)
    poses = {0: _first_pose(fit, tracker)}
    report(settings.track_iterations, {"color": tracker.error(poses[0], 0)})
    for order in tracking_orders(video, 0):
        for number, frame in enumerate(order[1:], 1):
            poses[frame] = tracker.track(poses, order[:number], frame)
            report(len(poses) * settings.track_iterations, {"color": tracker.error(poses[frame], frame)})
    return [NodeVariables.of(poses[frame], fit.basis) for frame in range(len(video))]


def _first_pose(fit: AssetFit, tracker: FlowTracker) -> Pose:
    """Return the pose at the first frame, with the colors of the Gaussians fitted to it.

    It is that at rest if colors, opacities and sizes explain the frame: outlines that differ, as by holes of a texture
    or gaps between the Gaussians, are not motion, and would become motion in depth at all frames.
    """
    rest, unmatched = Pose.rest(len(fit.graph.nodes)), tracker.cloud
    tracker.cloud = fit.match_first_frame(rest)
    fit.resting = fit.resting or tracker.error(rest, 0) <= EXPLAINED
    if fit.resting:
        return rest
    tracker.cloud = unmatched
    followed = tracker.follow_flow(rest, 0)
    tracker.cloud = fit.match_first_frame(followed)
    return followed


def _track_by_descent(
    fit: AssetFit, video: DrivingVideo, settings: AssetSettings, report: Report
) -> list[NodeVariables]:
    """Track the frames one after the other along gradients; return their variables."""
    tracked: list[NodeVariables] = [NodeVariables.still(1, fit.graph)] * (2 if fit.resting else 1)
    done = settings.track_iterations * (len(tracked) - 1)
    for frame in range(len(tracked) - 1, len(video)):
        start = fit.start(tracked, frame)
        variables, steps = start.trainable(), settings.track_iterations
        descent = NodeDescent(variables, fit.basis)
        expected = start.motion(fit.basis).nodes(fit.graph).detach()
        targets = fit.flow_targets(tracked[-1].motion(fit.basis), frame) if frame else None
        for step in range(steps):
            moved = variables.motion(fit.basis)
            losses = fit.losses(moved, [frame])
            if targets is not None and step < FLOW_SHARE * steps:
                losses["flow"] = settings.flow * fit.flow_loss(moved, *targets)
            losses["inertia"] = (
                settings.inertia * fit.relative(moved.nodes(fit.graph) - expected).square().sum(-1).mean()
            )
            fit.step(losses, variables, f"frame {frame}, iteration {step + 1}")
            descent.step(settings.lr * (1 - 0.8 * step / steps))
            done += 1
            report(done, {name: float(value.detach()) for name, value in losses.items()})
        tracked.append(variables.detach())
    return tracked[1:]


def thinned_graph(cloud: Gaussians, graph: ControlGraph, count: int) -> tuple[Gaussians, ControlGraph]:
    """Thin the Gaussians evenly to about `count`, enlarged to cover the same area; return them with their graph."""
    step = max(1, round(len(cloud) / count))
    return thinned(cloud, step), graph.of(torch.arange(0, len(cloud), step))
