"""Losses of the motion of a user's model, over a driving video.

An as-rigid-as-possible energy (Sorkine and Alexa 2007), robust so that joints may bend, decides what the video leaves
open; accelerations, and displacements in depth and out of the plane of symmetry, are penalized.
"""

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dg4d_lib.adam import Adam
from dg4d_lib.asset_settings import AssetSettings
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.fitting.flow_tracking import DEPTH_SLACK, across_weight
from dg4d_lib.fitting.losses import WHITE, check_finite, pyramid_error, pyramid_residuals, resize_cutouts
from dg4d_lib.fitting.node_motion import NodeBasis, NodeMotion, NodeVariables
from dg4d_lib.fitting.node_pose import CONTINUED, Pose
from dg4d_lib.fitting.rigidity import edge_energy
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.quaternion import quat_multiply
from dg4d_lib.images import luminance
from dg4d_lib.mesh.models.control_graph import ControlGraph
from dg4d_lib.rasterizer.interface import BLUR, Rasterizer, Rendering
from dg4d_lib.video.driving import DrivingVideo
from dg4d_lib.video.optical_flow import optical_flow

ADVICE = "lower asset.lr"
FLOW_UNIT = 0.02  # flow error up to which its loss is quadratic, share of the picture's side
MATCH_ITERATIONS = 80  # iterations of the color fit at the first frame
MATCH_LR = (0.05, 0.1, 0.01)  # learning rates of harmonics, opacities and sizes
SPEEDS = (0.0, CONTINUED, 1.0)  # extrapolations of the last motion that are tried, where rotations are integrated


class AssetFit:
    """Losses of a fit, over its targets."""

    def __init__(
        self,
        cloud: Gaussians,
        graph: ControlGraph,
        video: DrivingVideo,
        rasterize: Rasterizer,
        settings: AssetSettings,
        normal: Float[np.ndarray, " 3"] | None,
        resting: bool = False,
    ) -> None:
        self.normal = normal  # of the mirror plane
        self.resting = resting  # exactly, at the first frame, which then stays so
        self.camera = replace(OrbitCamera(), width=settings.size, height=settings.size)
        self.plain, self.graph = cloud.detach(), graph
        self.cloud = antialiased(self.plain, self.camera)
        self.rasterize, self.settings = rasterize, settings
        cutouts = torch.cat([video.frames, video.alpha], -1)
        self.colors, self.alphas = resize_cutouts(cutouts, settings.size)
        self.area = float(self.alphas.mean().clamp(min=1e-3))  # of the subject, share of the picture
        self.unit = float((graph.nodes.amax(0) - graph.nodes.amin(0)).norm()) / 10
        self.basis = NodeBasis(graph, settings.smoothing, settings.integrate_rotations)

    def with_graph(self, graph: ControlGraph) -> "AssetFit":
        """Return the same fit of Gaussians that the nodes move by other weights."""
        other = copy(self)
        other.graph = graph
        return other

    def match_first_frame(self, pose: Pose) -> Gaussians:
        """Fit colors, opacities and sizes to the first frame: light, texture and gaps differ from the video's.

        Returns:
            The Gaussians that the fit renders from now on.
        """
        motion = NodeVariables.of(pose, self.basis).motion(self.basis)
        means, quats = motion.points(self.plain.means, self.graph)[0], motion.rotations(self.graph)[0]
        names = ("harmonics", "opacity_logits", "log_scales")
        values = {name: getattr(self.plain, name).clone().requires_grad_() for name in names}
        optimizer = Adam({"params": values[name], "lr": lr} for name, lr in zip(names, MATCH_LR, strict=True))
        for step in range(MATCH_ITERATIONS):
            state = replace(self.plain, means=means, quats=quat_multiply(quats, self.plain.quats), **values)
            rendering = self.rasterize(antialiased(state, self.camera), [self.camera], means.new_tensor(WHITE))
            loss = (rendering.color - self.colors[:1]).square().mean() + (
                rendering.alpha - self.alphas[:1]
            ).square().mean()
            optimizer.zero_grad()
            loss.backward()
            gradients = [value.grad for value in values.values()]
            check_finite(
                "animate_asset", {"loss": loss}, gradients, f"colors, iteration {step + 1}", ADVICE, self.plain
            )
            optimizer.step()
        found = replace(self.plain, **{name: value.detach() for name, value in values.items()})
        self.cloud = antialiased(found, self.camera)
        return self.cloud

    def relative(self, values: Tensor) -> Tensor:
        """Convert lengths to tenths of the model's size."""
        return values / self.unit

    @torch.no_grad()
    def start(self, tracked: Sequence[NodeVariables], frame: int) -> NodeVariables:
        """Return the initial variables of a frame, given those of earlier frames, of which the first is at rest.

        Where rotations are integrated, it is the extrapolation at one of several speeds, or the variables of the frame
        with the most similar picture, whichever has the smallest loss: wings turn back, and steps repeat.
        """
        if frame < 2:
            return tracked[-1]
        if not self.basis.integrated:
            return tracked[-2].continued(tracked[-1], CONTINUED)
        starts = [tracked[-2].continued(tracked[-1], speed) for speed in SPEEDS]
        picture = torch.cat([self.colors, self.alphas], -1)
        errors = [float(pyramid_error(picture[frame : frame + 1], picture[k : k + 1])) for k in range(frame)]
        starts.append(tracked[1 + min(range(frame), key=errors.__getitem__)])
        return min(starts, key=lambda one: sum(map(float, self.losses(one.motion(self.basis), [frame]).values())))

    @torch.no_grad()
    def difference(self, motion: NodeMotion) -> float:
        """Return the losses of color and alpha between a motion and the video, over all frames."""
        return self.difference_of(self._means(motion))

    @torch.no_grad()
    def difference_of(self, means: Float[Tensor, "t n 3"]) -> float:
        """Return the losses of color and alpha between the Gaussians at these means and the video, over all frames."""
        losses = self._picture_losses(means, list(range(len(means))))
        return float(losses["color"] + losses["alpha"])

    @torch.no_grad()
    def outline_errors(self, motion: NodeMotion) -> Float[Tensor, " t"]:
        """Return the weighted loss of alpha at every frame."""
        alphas = self._rendering(self._means(motion)).alpha
        return pyramid_residuals(alphas, self.alphas).square().sum(1) * (self.settings.alpha_weight / self.area)

    def residuals(self, motion: NodeMotion, frames: list[int]) -> Float[Tensor, "t r"]:
        """Return numbers per frame whose squares sum to the losses of color, alpha and shifts across the plane."""
        settings, rendering = self.settings, self._rendering(self._means(motion))
        parts = [
            math.sqrt(settings.color_weight / self.area) * pyramid_residuals(rendering.color, self.colors[frames]),
            math.sqrt(settings.alpha_weight / self.area) * pyramid_residuals(rendering.alpha, self.alphas[frames]),
        ]
        if self.normal is not None:
            shifts = self.relative(motion.nodes(self.graph) - self.graph.nodes)
            across = shifts @ torch.from_numpy(self.normal).to(shifts)
            parts.append(math.sqrt(across_weight(settings, self.normal) / across.shape[1]) * across)
        return torch.cat(parts, 1)

    def losses(self, motion: NodeMotion, frames: list[int]) -> dict[str, Tensor]:
        """Return the weighted losses of some frames."""
        return {
            **self.picture_losses(motion, frames),
            "rigidity": self.settings.rigidity * self.rigidity(motion),
            "unseen": self.unseen(motion),
        }

    def unseen(self, motion: NodeMotion) -> Float[Tensor, ""]:
        """Return the weighted loss of displacements in depth and across the mirror plane."""
        settings = self.settings
        shifts = self.relative(motion.nodes(self.graph) - self.graph.nodes)
        depth = shifts[..., 2]
        unseen = settings.depth * depth.square().mean() + settings.whole_depth * depth.mean(-1).square().mean()
        if self.normal is None:
            return unseen
        across = (shifts @ torch.from_numpy(self.normal).to(shifts)).square().mean()
        return unseen + across_weight(settings, self.normal) * across

    def picture_losses(self, motion: NodeMotion, frames: list[int]) -> dict[str, Tensor]:
        """Return the weighted losses of color and alpha of some frames."""
        return self._picture_losses(self._means(motion), frames)

    def _picture_losses(self, means: Float[Tensor, "t n 3"], frames: list[int]) -> dict[str, Tensor]:
        rendering = self._rendering(means)
        color = pyramid_error(rendering.color, self.colors[frames]) / self.area
        alpha = pyramid_error(rendering.alpha, self.alphas[frames]) / self.area
        return {"color": self.settings.color_weight * color, "alpha": self.settings.alpha_weight * alpha}

    @torch.no_grad()
    def silhouettes(self, motion: NodeMotion) -> Bool[Tensor, "t h w 1"]:
        """Return the rendered silhouettes of the model, alpha above 0.5."""
        return self._rendering(self._means(motion)).alpha > 0.5

    def _means(self, motion: NodeMotion) -> Float[Tensor, "t n 3"]:
        return motion.points(self.cloud.means, self.graph)

    def _rendering(self, means: Float[Tensor, "t n 3"]) -> Rendering:
        """Render the Gaussians at places per frame."""
        count = len(means)
        states = replace(
            self.cloud,
            means=means,
            log_scales=self.cloud.log_scales.expand(count, -1, -1),
            quats=self.cloud.quats.expand(count, -1, -1),
        )
        return self.rasterize(states, [self.camera] * count, means.new_tensor(WHITE))

    @torch.no_grad()
    def flow_targets(self, before: NodeMotion, frame: int) -> tuple[Int[Tensor, " k"], Float[Tensor, "k 2"]]:
        """Return the Gaussians that were visible before a frame, and the pixels that the optical flow moves them to."""
        means = before.points(self.cloud.means, self.graph)
        state = replace(self.cloud, means=means[0])
        rendering = self.rasterize(state, [self.camera], means.new_tensor(WHITE))
        pixels, depth = self._projected(means[0])
        size = self.settings.size
        column, row = pixels.floor().long().clamp(0, size - 1).T
        alpha = rendering.alpha[0, row, column, 0]
        surface = rendering.depth[0, row, column, 0] / alpha.clamp(min=1e-3)
        visible = torch.nonzero((depth < surface + DEPTH_SLACK) & (alpha > 0.5))[:, 0]
        earlier, later = (luminance(self.colors[number]).cpu().numpy() for number in (frame - 1, frame))
        flow = torch.from_numpy(optical_flow(earlier, later)).permute(1, 2, 0).to(means)  # rows, columns
        moved = pixels[visible] + flow[row[visible], column[visible]].flip(-1)
        return visible, moved

    def flow_loss(
        self, motion: NodeMotion, visible: Int[Tensor, " k"], targets: Float[Tensor, "k 2"]
    ) -> Float[Tensor, ""]:
        """Return the robust distance of projected Gaussians to their targets."""
        if len(visible) == 0:
            return targets.new_zeros(())
        means = motion.points(self.cloud.means[visible], self.graph.of(visible))[0]
        error = (self._projected(means)[0] - targets) / (FLOW_UNIT * self.settings.size)
        return ((error.square().sum(-1) + 1).sqrt() - 1).mean()

    def _projected(self, means: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 2"], Float[Tensor, " n"]]:
        """Return pixels (column, row) and depths of points."""
        matrix = self.camera.viewmat().to(means)
        seen = means @ matrix[:3, :3].T + matrix[:3, 3]
        return seen[:, :2] / seen[:, 2:].clamp(min=0.1) * self.camera.focal + self.settings.size / 2, seen[:, 2]

    def rigidity(self, motion: NodeMotion) -> Float[Tensor, ""]:
        """Return the robust as-rigid-as-possible energy of the graph."""
        return edge_energy(motion, self.graph, self.settings.bending, self.settings.rigidity_loss == "log")

    def step(self, losses: dict[str, Tensor], variables: NodeVariables, place: str) -> None:
        """Compute the gradients of the sum of the losses."""
        total = torch.stack(list(losses.values())).sum()
        for value in vars(variables).values():
            value.grad = None
        total.backward()
        gradients = [value.grad for value in vars(variables).values()]
        check_finite("animate_asset", {"loss": total}, gradients, place, ADVICE, self.cloud)


def antialiased(cloud: Gaussians, camera: OrbitCamera) -> Gaussians:
    """Return a cloud that covers as much after the rasterizer's low-pass filter as before it (Yu et al. 2024).

    Without this, small opaque Gaussians widen all outlines by a pixel, and the fit shrinks the model.
    """
    pixels2 = (cloud.log_scales.topk(2, -1).values.mean(-1) + math.log(camera.focal / camera.radius)).mul(2).exp()
    opacities = (cloud.opacities * pixels2 / (pixels2 + BLUR)).clamp(1e-3, 1 - 1e-3)
    return replace(cloud, opacity_logits=opacities.logit())
