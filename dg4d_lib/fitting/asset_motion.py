"""Motion of a user's model: rigid transforms of control nodes on its surface, fitted to a driving video.

The frames are tracked one after the other, then all are refined together. An as-rigid-as-possible energy along the
surface (Sorkine and Alexa 2007), robust so that joints may bend, decides what the video leaves open; accelerations and
displacements in depth are penalized.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.fitting.losses import WHITE, check_finite, resize_cutouts
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.quaternion import quat_multiply, quat_to_rotmat
from dg4d_lib.mesh.models.control_graph import ControlGraph
from dg4d_lib.rasterizer.interface import Rasterizer
from dg4d_lib.settings import AssetSettings
from dg4d_lib.video.driving import DrivingVideo

ADVICE = "lower asset.lr"
LEVELS = (1, 2, 4, 8)  # pooling of the compared pictures; coarse ones see far motion
ROBUST = 0.05  # relative stretch up to which the rigidity is quadratic
ROTATION_LR = 2.0  # learning rate of quaternions, times that of positions
Report = Callable[[int, dict[str, float]], None]


@dataclass(frozen=True)
class NodeMotion:
    """Rigid transforms of the nodes at every frame, and of the whole model.

    Attributes:
        quats: rotations of the nodes, wxyz, any non-zero norm.
        shifts: translations of the nodes.
        whole_quats: rotation of everything about the centroid of the nodes.
        whole_shifts: translation of everything.
    """

    quats: Float[Tensor, "t m 4"]
    shifts: Float[Tensor, "t m 3"]
    whole_quats: Float[Tensor, "t 4"]
    whole_shifts: Float[Tensor, "t 3"]

    def at(self, frames: slice | Int[Tensor, " k"]) -> "NodeMotion":
        """Return the motion of some frames."""
        return NodeMotion(**{name: value[frames] for name, value in vars(self).items()})

    def points(self, rest: Float[Tensor, "v 3"], graph: ControlGraph) -> Float[Tensor, "t v 3"]:
        """Return the points that the nodes of `graph` move, at every frame."""
        matrices = quat_to_rotmat(self.quats)  # t m 3 3
        origins = graph.nodes + self.shifts - (matrices @ graph.nodes[..., None])[..., 0]  # x -> R x + origin
        affine = torch.cat([matrices, origins[..., None]], -1).flatten(2)  # t m 12
        blended = (affine[:, graph.indices] * graph.weights[..., None]).sum(2).unflatten(-1, (3, 4))
        moved = (blended[..., :3] @ rest[..., None])[..., 0] + blended[..., 3]
        return self._placed(moved, graph)

    def nodes(self, graph: ControlGraph) -> Float[Tensor, "t m 3"]:
        """Return the nodes at every frame."""
        return self._placed(graph.nodes + self.shifts, graph)

    def rotations(self, graph: ControlGraph) -> Float[Tensor, "t v 4"]:
        """Return the blended rotations of the points, unit quaternions."""
        unit = functional.normalize(self.quats, dim=-1)
        blended = functional.normalize((unit[:, graph.indices] * graph.weights[..., None]).sum(2), dim=-1)
        whole = functional.normalize(self.whole_quats, dim=-1)
        return quat_multiply(whole[:, None].expand_as(blended), blended)

    def _placed(self, points: Float[Tensor, "t v 3"], graph: ControlGraph) -> Float[Tensor, "t v 3"]:
        center = graph.nodes.mean(0)
        turned = (points - center) @ quat_to_rotmat(self.whole_quats).mT
        return turned + center + self.whole_shifts[:, None]


def still(frames: int, graph: ControlGraph) -> NodeMotion:
    """Return the motion of a model at rest."""
    identity = graph.nodes.new_tensor((1.0, 0.0, 0.0, 0.0))
    count = len(graph.nodes)
    return NodeMotion(
        identity.expand(frames, count, 4).clone(),
        graph.nodes.new_zeros(frames, count, 3),
        identity.expand(frames, 4).clone(),
        graph.nodes.new_zeros(frames, 3),
    )


def fit_asset_motion(
    cloud: Gaussians,
    graph: ControlGraph,
    video: DrivingVideo,
    rasterize: Rasterizer,
    settings: AssetSettings,
    generator: torch.Generator,
    report: Report = lambda iteration, values: None,
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

    Raises:
        FitDiverged: the loss became non-finite.
    """
    fit = _Fit(cloud, graph, video, rasterize, settings)
    frames, done = len(video), 0
    tracked = [still(1, graph)]
    for frame in range(frames):
        start = tracked[-1]
        if frame > 1:
            start = _extrapolated(tracked[-2], tracked[-1])
        steps = settings.track_iterations
        current = _parameters(start)
        adam = _adam(current, settings.lr)
        expected = start.nodes(graph).detach()
        for step in range(steps):
            _set_lr(adam, settings.lr, 1 - 0.8 * step / steps)
            moved = NodeMotion(**current)
            losses = fit.losses(moved, [frame])
            losses["inertia"] = settings.inertia * fit.relative(moved.nodes(graph) - expected).square().mean()
            fit.step(adam, losses, current, f"frame {frame}, iteration {step + 1}")
            done += 1
            report(done, {name: float(value.detach()) for name, value in losses.items()})
        tracked.append(NodeMotion(**{name: value.detach() for name, value in current.items()}))
    whole = {name: torch.cat([getattr(one, name) for one in tracked[1:]]) for name in vars(tracked[0])}
    current = _parameters(NodeMotion(**whole))
    adam = _adam(current, settings.lr)
    for step in range(settings.joint_iterations):
        _set_lr(adam, 0.5 * settings.lr, 1 - 0.9 * step / settings.joint_iterations)
        count = min(settings.joint_frames, frames)
        chosen = torch.randperm(frames, generator=generator)[:count].sort().values
        moved = NodeMotion(**current)
        losses = fit.losses(moved.at(chosen), chosen.tolist())
        nodes = moved.nodes(graph)
        if frames > 2:
            acceleration = fit.relative(nodes[2:] - 2 * nodes[1:-1] + nodes[:-2])
            losses["inertia"] = settings.smoothness * acceleration.square().sum(-1).mean()
        fit.step(adam, losses, current, f"joint iteration {step + 1}")
        done += 1
        report(done, {name: float(value.detach()) for name, value in losses.items()})
    return NodeMotion(**{name: value.detach() for name, value in current.items()})


def iterations(settings: AssetSettings, frames: int) -> int:
    """Return the number of iterations that a fit reports."""
    return settings.track_iterations * frames + settings.joint_iterations


class _Fit:
    """Losses of a fit, over its targets."""

    def __init__(
        self,
        cloud: Gaussians,
        graph: ControlGraph,
        video: DrivingVideo,
        rasterize: Rasterizer,
        settings: AssetSettings,
    ) -> None:
        self.cloud, self.graph = cloud.detach(), graph
        self.rasterize, self.settings = rasterize, settings
        self.camera = replace(OrbitCamera(), width=settings.size, height=settings.size)
        cutouts = torch.cat([video.frames, video.alpha], -1)
        self.colors, self.alphas = resize_cutouts(cutouts, settings.size)
        self.area = float(self.alphas.mean().clamp(min=1e-3))  # of the subject, share of the picture
        self.unit = float((graph.nodes.amax(0) - graph.nodes.amin(0)).norm()) / 10
        first, second = graph.edges.T
        self.spans = graph.nodes[second] - graph.nodes[first]

    def relative(self, values: Tensor) -> Tensor:
        """Return lengths in tenths of the model's size."""
        return values / self.unit

    def losses(self, motion: NodeMotion, frames: list[int]) -> dict[str, Tensor]:
        """Return the weighted losses of some frames."""
        settings = self.settings
        means = motion.points(self.cloud.means, self.graph)
        count = len(frames)
        states = replace(
            self.cloud,
            means=means,
            log_scales=self.cloud.log_scales.expand(count, -1, -1),
            quats=self.cloud.quats.expand(count, -1, -1),
        )
        rendering = self.rasterize(states, [self.camera] * count, means.new_tensor(WHITE))
        color = _pyramid_error(rendering.color, self.colors[frames]) / self.area
        alpha = _pyramid_error(rendering.alpha, self.alphas[frames]) / self.area
        depth = self.relative(motion.nodes(self.graph)[..., 2] - self.graph.nodes[:, 2]).square().mean()
        return {
            "color": settings.color_weight * color,
            "alpha": settings.alpha_weight * alpha,
            "rigidity": settings.rigidity * self.rigidity(motion),
            "depth": settings.depth * depth,
        }

    def rigidity(self, motion: NodeMotion) -> Float[Tensor, ""]:
        """Return the robust as-rigid-as-possible energy of the graph."""
        first, second = self.graph.edges.T
        matrices = quat_to_rotmat(motion.quats)
        shifts = motion.shifts
        moved = self.spans + shifts[:, second] - shifts[:, first]
        lengths = self.graph.lengths[:, None]
        stretch = torch.cat(
            [
                (moved - (matrices[:, first] @ self.spans[..., None])[..., 0]) / lengths,
                (moved - (matrices[:, second] @ self.spans[..., None])[..., 0]) / lengths,
            ],
            1,
        )
        bend = (matrices[:, first] - matrices[:, second]).flatten(2)
        return _robust(stretch).mean() + self.settings.bending * _robust(bend).mean()

    def step(self, adam: torch.optim.Adam, losses: dict[str, Tensor], current: dict[str, Tensor], place: str) -> None:
        """Take a step down the sum of the losses."""
        total = torch.stack(list(losses.values())).sum()
        adam.zero_grad(set_to_none=True)
        total.backward()
        gradients = [value.grad for value in current.values()]
        check_finite("animate_asset", {"loss": total}, gradients, place, ADVICE, self.cloud)
        adam.step()


def _robust(values: Float[Tensor, "*b c"]) -> Float[Tensor, "*b"]:
    """Return a loss that is quadratic for small and linear for large vectors."""
    return (values.square().sum(-1) + ROBUST**2).sqrt() - ROBUST


def _pyramid_error(ours: Float[Tensor, "b h w c"], theirs: Float[Tensor, "b h w c"]) -> Float[Tensor, ""]:
    """Return the mean squared error, averaged over a pyramid."""
    difference = (ours - theirs).movedim(-1, 1)
    errors = [functional.avg_pool2d(difference, level).square().mean() for level in LEVELS]
    return torch.stack(errors).mean()


def _parameters(motion: NodeMotion) -> dict[str, Tensor]:
    return {name: value.detach().clone().requires_grad_() for name, value in vars(motion).items()}


def _adam(parameters: dict[str, Tensor], lr: float) -> torch.optim.Adam:
    factor = {"quats": ROTATION_LR, "shifts": 1.0, "whole_quats": ROTATION_LR, "whole_shifts": 1.0}
    groups = [{"params": [value], "lr": lr * factor[name], "factor": factor[name]} for name, value in parameters.items()]
    return torch.optim.Adam(groups, betas=(0.9, 0.98), eps=1e-12)


def _set_lr(adam: torch.optim.Adam, lr: float, progress: float) -> None:
    for group in adam.param_groups:
        group["lr"] = lr * progress * group["factor"]


def _extrapolated(before: NodeMotion, last: NodeMotion) -> NodeMotion:
    """Continue a motion at half its speed."""
    values = {name: getattr(last, name) + 0.5 * (getattr(last, name) - getattr(before, name)) for name in vars(last)}
    return NodeMotion(**values)
