"""Motion of a skinned model, by its skeleton: rotations of the joints, fitted to a driving video.

Joints keep their distances, so that an arm that points at the camera is an arm, and a model at rest finds the pose of
the first frame, however far it is. A few numbers per frame are found by descents from coarse to fine: the first frame,
then every frame from those before it, then all frames together.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from dg4d_lib.asset_settings import AssetSettings
from dg4d_lib.cameras.orbit import RADIUS
from dg4d_lib.fitting.asset_fit import AssetFit
from dg4d_lib.fitting.asset_motion import thinned_graph
from dg4d_lib.fitting.asset_pose import Placement
from dg4d_lib.fitting.frame_variables import FrameVariables
from dg4d_lib.fitting.losses import check_finite
from dg4d_lib.fitting.node_motion import Descent, NodeMotion
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.mirror import mirror_normal
from dg4d_lib.geometry.quaternion import quat_multiply, quat_to_rotmat, rotate
from dg4d_lib.mesh.models.skeleton import JointGraph
from dg4d_lib.rasterizer.interface import Rasterizer
from dg4d_lib.video.driving import DrivingVideo

ADVICE = "set asset.skeleton to false"
COARSE = 64  # pixels of the compared pictures in a search
POINTS = 4000  # Gaussians in a search
RATES = (0.06, 0.02, 0.007)  # learning rates of the search: distant poses need large steps, near ones small steps
SEARCHED, FINISHED = 100, 40  # iterations at the first frame, coarse and fine
TRACKED, TRUED = 30, 12  # the same at every other frame
FINER, TRACKING = 0.01, 0.02  # learning rates of the fine descents, and of the coarse ones while tracking
FACTORS = {"turns": 2.0, "global_turn": 0.5, "global_shift": 0.2, "global_depth": 0.4}  # on the learning rates
EVENNESS = 0.5  # of the step sizes of a frame: 1 keeps the ratios of gradients, 0 normalizes each coordinate
AT_REST, AS_BEFORE = 0.002, 0.002  # weights of rotations, and of their changes while tracking
WHOLE_DEPTH = 0.15  # least weight of `whole_depth` for videos, as in other descents
STEADY = 0.01  # weight of accelerations of the rotations
CONTINUED = 0.7  # share of the last motion that is extrapolated
Report = Callable[[int, dict[str, float]], None]


@dataclass(frozen=True)
class JointVariables(FrameVariables):
    """Rotations of joints relative to their parents, and motion of the whole model about the first node.

    Rotations are vectors along the axis of twice the tangent of half the angle.

    Attributes:
        turns: of the nodes; unused for the first one.
        global_turn: rotation of the whole model.
        global_shift: translation of the whole model to the right and up.
        global_depth: translation of the whole model towards the camera; separate, since a step shows less.
    """

    turns: Float[Tensor, "t m 3"]
    global_turn: Float[Tensor, "t 3"]
    global_shift: Float[Tensor, "t 2"]
    global_depth: Float[Tensor, "t 1"]

    @classmethod
    def still(cls, joints: JointGraph) -> "JointVariables":
        """Return the variables of one frame at rest."""
        nodes = joints.graph.nodes
        return cls(nodes.new_zeros(1, len(nodes), 3), *(nodes.new_zeros(1, count) for count in (3, 2, 1)))

    @property
    def posture(self) -> "JointVariables":
        """The same rotations without a translation of the model."""
        return replace(
            self, global_shift=torch.zeros_like(self.global_shift), global_depth=torch.zeros_like(self.global_depth)
        )


class JointChains:
    """Forward kinematics: from rotations of joints to the transforms of all nodes."""

    def __init__(self, joints: JointGraph) -> None:
        self.nodes, self.turning = joints.graph.nodes, joints.turning.to(joints.graph.nodes)[:, None]
        parents = joints.parents
        self.spans = torch.cat([self.nodes[:1], self.nodes[1:] - self.nodes[torch.from_numpy(parents[1:])]])
        depth = np.zeros(len(parents), int)
        for node in range(1, len(parents)):
            depth[node] = depth[parents[node]] + 1
        order = np.argsort(depth, kind="stable")
        place = np.argsort(order)
        self.back = torch.from_numpy(place)  # of every node, where it is found
        self.levels: list[tuple[Tensor, Tensor]] = []  # nodes, and a matrix that picks their parents from all before
        for level in range(1, depth.max() + 1):
            selected = order[depth[order] == level]
            picked = np.eye(int((depth < level).sum()), dtype=np.float32)[place[parents[selected]]]
            self.levels.append((torch.from_numpy(selected), torch.from_numpy(picked)))

    def motion(self, variables: JointVariables) -> NodeMotion:
        """Return the motion of the nodes."""
        local = _quats(variables.turns * self.turning)
        quats = _quats(variables.global_turn)[:, None]
        places = (self.nodes[0] + torch.cat([variables.global_shift, variables.global_depth], -1))[:, None]
        for selected, picked in self.levels:
            above = picked @ quats
            spans = rotate(quat_to_rotmat(above), self.spans[selected])
            places = torch.cat([places, picked @ places + spans], 1)
            quats = torch.cat([quats, quat_multiply(above, local[:, selected])], 1)
        still = quats.new_tensor((1.0, 0, 0, 0)).expand(len(quats), 4)
        shifts = places[:, self.back] - self.nodes
        return NodeMotion(quats[:, self.back], shifts, still, torch.zeros_like(shifts[:, 0]))


def fit_skeleton_motion(
    cloud: Gaussians,
    joints: JointGraph,
    video: DrivingVideo,
    rasterize: Rasterizer,
    settings: AssetSettings,
    generator: torch.Generator,
    report: Report = lambda iteration, values: None,
) -> NodeMotion:
    """Fit the rotations of a placed model's joints to a video of the camera at azimuth and elevation 0.

    Args:
        cloud: Gaussians of the model at rest.
        joints: whose points are the Gaussians.
        video: its first frame shows the model in any pose, about where it was placed.
        rasterize: rasterizer.
        settings: of the fit.
        generator: draws the frames of joint iterations.
        report: called after every iteration with (iterations done, named losses).

    Raises:
        FitDiverged: the loss became non-finite.
    """
    steady = settings.model_copy(update={"whole_depth": max(settings.whole_depth, WHOLE_DEPTH)})
    search = _Search(cloud, joints, video, rasterize, steady, report)
    poses = [search.first_pose()]
    for frame in range(1, len(video)):
        start = poses[-1] if frame == 1 else poses[-2].continued(poses[-1], CONTINUED)
        rough, _ = search.descend(search.coarse, start, frame, TRACKED, TRACKING, steady=True)
        poses.append(search.descend(search.fine, rough, frame, TRUED, FINER, steady=True)[0])
    return search.refine_jointly(JointVariables.joined(poses), generator)


def skeleton_iterations(settings: AssetSettings, frames: int) -> int:
    """Return the number of iterations that a fit reports."""
    return len(RATES) * SEARCHED + FINISHED + (TRACKED + TRUED) * (frames - 1) + settings.joint_iterations


@dataclass(frozen=True)
class PosedModel:
    """A model in the pose of a picture.

    Attributes:
        placement: of the model at rest; its agreement is that of the posed model.
        cloud: Gaussians as the picture shows them, world units.
        difference: from the picture; its losses of color and alpha.
    """

    placement: Placement
    cloud: Gaussians
    difference: float


def pose_model(
    cloud: Gaussians,
    joints: JointGraph,
    subject: Float[Tensor, "h w 4"],
    placement: Placement,
    rasterize: Rasterizer,
    settings: AssetSettings,
) -> PosedModel:
    """Pose a model as a picture shows it, and correct its placement.

    The outline at rest tells neither size nor place of a model that is posed. What the pose has moved in depth becomes
    a scale.

    Args:
        cloud: Gaussians at rest, placed.
        joints: whose points are the Gaussians.
        subject: square picture, straight alpha.
        placement: of the model at rest, which the Gaussians have.
        rasterize: rasterizer.
        settings: of the fit.
    """
    video = DrivingVideo(subject[None, ..., :3], subject[None, ..., 3:], 1.0)
    search = _Search(cloud, joints, video, rasterize, settings.model_copy(update={"whole_depth": 0.0}))
    pose = search.first_pose()
    motion = search.chains.motion(pose)
    posed = replace(
        cloud,
        means=motion.points(cloud.means, joints.graph)[0],
        quats=quat_multiply(motion.rotations(joints.graph)[0], cloud.quats),
    )
    outline = search.fine.silhouettes(motion)[0]
    both, either = outline & (search.fine.alphas[0] > 0.5), outline | (search.fine.alphas[0] > 0.5)
    center = joints.graph.nodes[0]
    nearer = float((RADIUS - center[2]) / (RADIUS - center[2] - pose.global_depth[0, 0]).clamp(min=0.1))
    goal = torch.cat([(center[:2] + pose.global_shift[0]) * nearer, center[2:]])
    found = replace(
        placement,
        scale=placement.scale * nearer,
        shift=nearer * (placement.shift - center) + goal,
        agreement=float(both.sum() / either.sum().clamp(min=1)),
        posed=True,
    )
    return PosedModel(found, posed, search.fine.difference(motion))


class _Search:
    """Descents over the variables of a skeleton."""

    def __init__(
        self,
        cloud: Gaussians,
        joints: JointGraph,
        video: DrivingVideo,
        rasterize: Rasterizer,
        settings: AssetSettings,
        report: Report = lambda iteration, values: None,
    ) -> None:
        normal = mirror_normal(cloud.means.double().numpy(force=True)) if settings.across else None
        thin, graph = thinned_graph(cloud, joints.graph, min(POINTS, settings.fit_points))
        self.joints, self.settings, self.report, self.done = joints, settings, report, 0
        self.chains, self.whole_depth = JointChains(joints), settings.whole_depth
        self.coarse, self.fine = (
            AssetFit(thin, graph, video, rasterize, settings.model_copy(update={"size": size}), normal)
            for size in (min(COARSE, settings.size), settings.size)
        )

    def first_pose(self) -> JointVariables:
        """Return the pose at the first frame."""
        still = JointVariables.still(self.joints)
        found = [self.descend(self.coarse, still, 0, SEARCHED, rate) for rate in RATES]
        start = min(found, key=lambda one: one[1])[0]
        return self.descend(self.fine, start, 0, FINISHED, FINER)[0]

    def descend(
        self,
        fit: AssetFit,
        start: JointVariables,
        frame: int,
        iterations: int,
        rate: float,
        steady: bool = False,
    ) -> tuple[JointVariables, float]:
        """Descend from a start; also return the picture loss. With `steady`, changes of rotations are penalized."""
        variables = start.trainable()
        descent = Descent(vars(variables), FACTORS, evenness=EVENNESS)
        loss = float("inf")
        for step in range(iterations):
            losses = self._losses(fit, self.chains.motion(variables), variables, [frame])
            if steady:
                losses["inertia"] = AS_BEFORE * (variables.turns - start.turns).square().sum(-1).mean()
            loss = float((losses["color"] + losses["alpha"]).detach())
            self._step(losses, variables, f"frame {frame}, iteration {step + 1}")
            descent.step(rate * (1 - 0.9 * step / iterations))
        return variables.detach(), loss

    def refine_jointly(self, start: JointVariables, generator: torch.Generator) -> NodeMotion:
        """Refine all frames together."""
        variables, frames, iterations = start.trainable(), len(start.turns), self.settings.joint_iterations
        descent = Descent(vars(variables), FACTORS, evenness=EVENNESS)
        for step in range(iterations):
            count = min(self.settings.joint_frames, frames)
            selected = torch.randperm(frames, generator=generator)[:count].sort().values
            motion = self.chains.motion(variables)
            losses = self._losses(self.fine, motion.at(selected), variables, selected.tolist())
            if frames > 2:
                acceleration = self.fine.relative(motion.nodes(self.fine.graph).diff(n=2, dim=0)).square()
                turning = variables.turns.diff(n=2, dim=0).square()
                losses["inertia"] = (
                    self.settings.smoothness * acceleration.sum(-1).mean() + STEADY * turning.sum(-1).mean()
                )
            self._step(losses, variables, f"joint iteration {step + 1}")
            descent.step(FINER * (1 - 0.9 * step / iterations))
        with torch.no_grad():
            return self.chains.motion(variables)

    def _losses(
        self, fit: AssetFit, motion: NodeMotion, variables: JointVariables, frames: list[int]
    ) -> dict[str, Tensor]:
        posture = self.chains.motion(variables.posture)
        nearer = self.whole_depth * fit.relative(variables.global_depth).square().mean()
        bent = AT_REST * variables.turns.square().sum(-1).mean()
        return {**fit.picture_losses(motion, frames), "unseen": fit.unseen(posture) + nearer, "bending": bent}

    def _step(self, losses: dict[str, Tensor], variables: JointVariables, place: str) -> None:
        """Compute the gradients of the sum of the losses."""
        values = list(vars(variables).values())
        for value in values:
            value.grad = None
        total = torch.stack(list(losses.values())).sum()
        total.backward()
        check_finite("animate_asset", {"loss": total}, [one.grad for one in values], place, ADVICE, self.fine.cloud)
        self.done += 1
        self.report(self.done, {name: float(value.detach()) for name, value in losses.items()})


def _quats(turns: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 4"]:
    """Return unit quaternions of vectors along the axis of twice the tangent of half the angle."""
    return functional.normalize(torch.cat([torch.ones_like(turns[..., :1]), 0.5 * turns], -1), dim=-1)
