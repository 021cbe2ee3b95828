"""Motion of control nodes from frame to frame of a video, by optical flow from renders of the model to the frames.

Every frame is found by rounds: render the model, follow the optical flow from the render to the frame, and solve for
rigid transforms of the nodes by Gauss-Newton steps, with an as-rigid-as-possible energy (Sorkine and Alexa 2007) that
is robust so that joints may bend. Where parts move farther than their size, flow fails; so each frame is also tried
from a start that matches patches of the surface anywhere near, and from the pose at the most similar known frame.
Where a frame fits much worse than the one before, parts of the model are searched (`part_search`). The best stays.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import csr_array
from torch import Tensor
from torch.nn import functional

from dg4d_lib.asset_settings import AssetSettings
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.fitting.node_pose import Pose, rotation, rotation_vector
from dg4d_lib.fitting.normal_equations import NormalEquations
from dg4d_lib.fitting.part_search import PartSearch
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.quaternion import quat_multiply
from dg4d_lib.images import luminance
from dg4d_lib.mesh.models.control_graph import SHORTEST, ControlGraph, symmetric_matrix
from dg4d_lib.rasterizer.interface import Rasterizer, Rendering
from dg4d_lib.video.optical_flow import optical_flow

STEPS = 2  # Gauss-Newton steps per round
MATCH_STEPS = 4  # towards matched patches
FOLLOWED = 1500  # largest number of Gaussians that follow the flow
FLOW_UNIT = 0.01  # flow error up to which its loss is quadratic, share of the picture's side
ROBUST = 0.02  # relative stretch, or radians, up to which the rigidity is quadratic
LOG_SCALE = 0.3  # relative stretch, or radians, above which a logarithmic rigidity stays well below a linear one
DEPTH_SLACK = 0.05  # world units by which a Gaussian may lie behind the visible surface
SLANTED = 0.5  # cosine of normal and line of sight from which a mirror plane counts fully
STILL = 0.15  # weight of the position in the last frame, against the extrapolated position
UNSEEN = 0.1  # factor on the weights of displacements that a video hardly shows; the weights suit the refinement
GAIN = 0.02  # least relative decrease of the error by another start
LOST, JUMP = 0.1, 1.3  # parts are searched from this error, and this ratio to the error of the last frame
WINDOW = 8  # search of patches, in pixels of a picture of half the size, at 64 pixels of `asset.size`
ALPHA_WEIGHT = 0.5  # weight of alpha relative to color in patches
LARGEST_COST = 0.3  # largest cost of a pixel, which bounds the effect of occlusions
NEIGHBORS, SPREAD = 2, 0.3  # rounds and weight of the neighbors' costs
PULL = 0.003  # cost of the farthest places of a patch
SHARP = 0.01  # cost difference from which a place counts as distinct from the best one

# Arguments of NormalEquations.add: derivatives of residuals by the unknowns of nodes, these nodes, the residuals
_Term: TypeAlias = tuple[Float[np.ndarray, "n k d 6"], Int[np.ndarray, "n k"], Float[np.ndarray, "n d"]]


@dataclass(frozen=True)
class _Targets:
    """Pixels (column, row) that Gaussians should come to, with weights."""

    rows: Int[np.ndarray, " k"]
    pixels: Float[np.ndarray, "k 2"]
    weights: Float[np.ndarray, " k"]


class FlowTracker:
    """Tracks a model from frame to frame.

    Attributes:
        cloud: the Gaussians that are rendered; others with the same means may take their place before frame 1.
    """

    def __init__(
        self,
        cloud: Gaussians,
        graph: ControlGraph,
        colors: Float[Tensor, "t s s 3"],
        alphas: Float[Tensor, "t s s 1"],
        rasterize: Rasterizer,
        settings: AssetSettings,
        normal: Float[np.ndarray, " 3"] | None = None,
    ) -> None:
        """Store the model and the frames.

        Args:
            cloud: Gaussians of the model at rest, as `rasterize` should draw them.
            graph: control graph whose points are the Gaussians.
            colors: frames over white.
            alphas: of the frames.
            rasterize: rasterizer.
            settings: of the fit.
            normal: of the model's mirror plane, in which it moves; None if it has none.
        """
        self.cloud, self._normal = cloud, normal
        self._graph, self._rasterize, self._settings = graph, rasterize, settings
        self._alphas, self._frames = alphas, torch.cat([colors, alphas], -1)
        self._camera = replace(OrbitCamera(), width=settings.size, height=settings.size)
        self._viewmat = self._camera.viewmat().double().numpy()
        self._rest = cloud.means.double().numpy()
        self._nodes = graph.nodes.double().numpy()
        self._indices, self._weights = graph.indices.numpy(), graph.weights.double().numpy()
        self._edges = graph.edges.numpy()
        self._spans = self._nodes[self._edges[:, 1]] - self._nodes[self._edges[:, 0]]
        self._lengths = np.linalg.norm(self._spans, axis=1).clip(SHORTEST)
        self._unit = float(np.linalg.norm(np.ptp(self._nodes, axis=0))) / 10
        dark = luminance(colors - (1 - alphas)).sum() < 0.5 * alphas.sum()
        self._backdrop = 1.0 if dark else 0.0  # the one that contrasts with the subject
        self._pictures = self._over(colors, alphas)
        self._features = _features(self._pictures, alphas)
        self._lumas = luminance(self._pictures).cpu().numpy()

    def follow_flow(self, pose: Pose, frame: int) -> Pose:
        """Return a pose that follows the optical flow to a frame, without regard to other frames."""
        return self._follow_rounds(pose, pose, pose, frame)

    def track(self, poses: Mapping[int, Pose], trail: Sequence[int], frame: int) -> Pose:
        """Return the pose at a frame.

        Args:
            poses: at the frames that are known.
            trail: those of them that lead to the frame, in order.
            frame: number of the frame.
        """
        last = poses[trail[-1]]
        start = poses[trail[max(len(trail) - 2, 0)]].continued(last)
        found = self._follow_rounds(start, start, last, frame)
        matched, targets = start, self._patch_targets(start, frame)
        for _ in range(MATCH_STEPS):
            matched = self._gauss_newton_step(matched, targets, start, last)
        found = self._pick_better(found, self._follow_rounds(matched, matched, last, frame), frame)
        known = sorted(poses)
        alike = known[int((self._frames[known] - self._frames[frame]).square().mean((1, 2, 3)).argmin())]
        if alike != trail[-1]:  # the motion may come back
            again = poses[alike]
            found = self._pick_better(found, self._follow_rounds(again, again, again, frame), frame)
        if self.error(found, frame) > max(LOST, JUMP * self.error(last, trail[-1])):
            posed = self._parts.best_pose(last, frame)
            found = self._pick_better(found, self._follow_rounds(posed, posed, last, frame), frame)
        return found

    def _pick_better(self, found: Pose, other: Pose, frame: int) -> Pose:
        """Return the first pose, or the other one if its error is smaller by `GAIN`."""
        return other if self.error(other, frame) < (1 - GAIN) * self.error(found, frame) else found

    def error(self, pose: Pose, frame: int) -> float:
        """Return the root mean square difference of the render and a frame, over the subject."""
        rendering = self._render(pose)[0]
        difference = torch.cat([rendering.color[0], rendering.alpha[0]], -1) - self._frames[frame]
        smooth = functional.avg_pool2d(difference.movedim(-1, 0)[None], 3, 1, 1)
        return float(smooth.square().mean().sqrt() / self._alphas[frame].mean().clamp(min=1e-3).sqrt())

    @cached_property
    def _parts(self) -> PartSearch:
        return PartSearch(self.cloud, self._graph, self._pictures, self._alphas, self._backdrop, self._rasterize)

    def _follow_rounds(self, pose: Pose, expected: Pose, last: Pose, frame: int) -> Pose:
        """Return the pose after rounds of optical flow."""
        for _ in range(self._settings.track_iterations):
            targets = self._flow_targets(pose, frame)
            for _ in range(STEPS):
                pose = self._gauss_newton_step(pose, targets, expected, last)
        return pose

    def _flow_targets(self, pose: Pose, frame: int) -> _Targets:
        """Return where the optical flow from the render moves the visible Gaussians."""
        rendering, pixels, visible = self._render_visible(pose)
        picture = luminance(self._over(rendering.color, rendering.alpha))[0].cpu().numpy()
        flow = np.moveaxis(optical_flow(picture, self._lumas[frame])[::-1], 0, -1)  # columns, rows
        column, row = self._cells(pixels[visible]).T
        return _Targets(visible, pixels[visible] + flow[row, column], np.ones(len(visible)))

    @torch.no_grad()
    def _patch_targets(self, pose: Pose, frame: int) -> _Targets:
        """Return where the patches around the nodes are found in a frame, by color and alpha."""
        rendering, pixels, visible = self._render_visible(pose)
        reach = max(2, WINDOW * self._settings.size // 64)
        ours = _features(self._over(rendering.color, rendering.alpha), rendering.alpha)[0]
        theirs = functional.pad(self._features[frame], (reach,) * 4, mode="replicate")
        column, row = torch.from_numpy(self._cells(pixels[visible]) // 2).T
        down, right = torch.meshgrid(*[torch.arange(2 * reach + 1)] * 2, indexing="ij")
        places = theirs[:, row[:, None] + down.reshape(-1), column[:, None] + right.reshape(-1)]
        cost = (places - ours[:, row, column][..., None]).square().sum(0).clamp(max=LARGEST_COST).double().numpy()
        nodes, count = self._indices[visible, 0], len(self._nodes)
        owned = csr_array((np.ones(len(visible)), (nodes, np.arange(len(visible)))), shape=(count, len(visible)))
        beside = symmetric_matrix(self._edges, np.ones(len(self._edges)), count)
        total, pieces = owned @ cost, owned @ np.ones(len(visible))
        for _ in range(NEIGHBORS):
            total, pieces = total + SPREAD * (beside @ total), pieces + SPREAD * (beside @ pieces)
        offsets = np.stack([right.reshape(-1).numpy(), down.reshape(-1).numpy()], 1) - reach
        mean = total / np.maximum(pieces, 1e-9)[:, None] + PULL * np.square(offsets / reach).sum(1)
        best = mean.argmin(1)
        above = mean - mean[np.arange(count), best][:, None]
        sure = np.square(1 - np.exp(-above / SHARP).mean(1))  # of patches that are alike everywhere: 0
        return _Targets(visible, pixels[visible] + 2.0 * offsets[best][nodes], sure[nodes])

    def _render_visible(self, pose: Pose) -> tuple[Rendering, Float[np.ndarray, "n 2"], Int[np.ndarray, " k"]]:
        """Return the render, the pixels of all Gaussians, and evenly spaced ones of those that are visible."""
        rendering, points = self._render(pose)
        pixels, depth, _ = self._projected(points)
        column, row = self._cells(pixels).T
        alpha = rendering.alpha[0, ..., 0].numpy()[row, column]
        surface = rendering.depth[0, ..., 0].numpy()[row, column] / alpha.clip(1e-3)
        visible = np.flatnonzero((depth < surface + DEPTH_SLACK) & (alpha > 0.5))
        return rendering, pixels, visible[:: max(1, -(-len(visible) // FOLLOWED))]

    @torch.no_grad()
    def _render(self, pose: Pose) -> tuple[Rendering, Float[np.ndarray, "n 3"]]:
        points = self._points(pose, np.arange(len(self._rest)))[0]
        turned = self._graph.blend_rotations(pose.quats()[None])[0]
        state = replace(
            self.cloud,
            means=torch.from_numpy(points).to(self.cloud.means),
            quats=quat_multiply(turned, self.cloud.quats),
        )
        return self._rasterize(state, [self._camera], torch.ones(3)), points

    def _points(
        self, pose: Pose, rows: Int[np.ndarray, " k"]
    ) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k n 3"]]:
        """Return some of the Gaussians' means, and their turned offsets from the nodes that move them."""
        shares, arms = pose.shares(self._rest[rows], self._nodes, self._indices[rows], self._weights[rows])
        return shares.sum(1), arms

    def _projected(
        self, points: Float[np.ndarray, "k 3"]
    ) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, " k"], Float[np.ndarray, "k 2 3"]]:
        """Return pixels (column, row), depths, and derivatives of the pixels by the points."""
        turn, focal = self._viewmat[:3, :3], self._camera.focal
        seen = points @ turn.T + self._viewmat[:3, 3]
        depth = seen[:, 2].clip(0.1)
        slope = np.zeros((len(points), 2, 3))
        slope[:, 0, 0] = slope[:, 1, 1] = focal / depth
        slope[:, :, 2] = -focal * seen[:, :2] / np.square(depth)[:, None]
        return seen[:, :2] / depth[:, None] * focal + self._settings.size / 2, seen[:, 2], slope @ turn

    def _cells(self, pixels: Float[np.ndarray, "k 2"]) -> Int[np.ndarray, "k 2"]:
        cells: Int[np.ndarray, "k 2"] = np.floor(pixels).astype(np.int64).clip(0, self._settings.size - 1)
        return cells

    def _over(self, colors: Float[Tensor, "t s s 3"], alphas: Float[Tensor, "t s s 1"]) -> Float[Tensor, "t s s 3"]:
        """Return pictures over the backdrop that contrasts, from those over white."""
        return colors - (1 - alphas) * (1 - self._backdrop)

    def _gauss_newton_step(self, pose: Pose, targets: _Targets, expected: Pose, last: Pose) -> Pose:
        """Return the pose after a Gauss-Newton step on all losses."""
        settings, count = self._settings, len(self._nodes)
        each = np.arange(count)[:, None]
        terms = [*self._flow_terms(pose, targets), *self._rigidity_terms(pose)]
        place = np.concatenate([expected.shifts[:, :2], last.shifts[:, 2:]], 1)  # depth is not extrapolated
        for target, weight in ((place, settings.inertia), (last.shifts, STILL * settings.inertia)):
            scale = np.sqrt(weight / count) / self._unit
            blocks = np.zeros((count, 1, 3, 6))
            blocks[..., 3:] = scale * np.eye(3)
            terms.append((blocks, each, (pose.shifts - target) * scale))
        unseen = [(np.array([0.0, 0.0, 1.0]), settings.depth)]
        if self._normal is not None:
            unseen.append((self._normal, across_weight(settings, self._normal)))
        for direction, weight in unseen:
            scale = np.sqrt(UNSEEN * weight / count) / self._unit
            blocks = np.zeros((count, 1, 1, 6))
            blocks[..., 3:] = scale * direction
            terms.append((blocks, each, (pose.shifts @ direction * scale)[:, None]))
        equations = NormalEquations(count)
        for term in terms:
            equations.add(*term)
        scale = np.sqrt(settings.whole_depth) / count / self._unit
        equations.add_sum(5, scale, pose.shifts[:, 2].sum() * scale)
        step = equations.solve()
        return Pose(rotation(step[:, :3]) @ pose.turns, pose.shifts + step[:, 3:])

    def _flow_terms(self, pose: Pose, targets: _Targets) -> list[_Term]:
        if not len(targets.rows):
            return []
        points, arms = self._points(pose, targets.rows)
        pixels, _, slope = self._projected(points)
        unit = FLOW_UNIT * self._settings.size
        error = (pixels - targets.pixels) / unit
        robust = targets.weights * self._settings.flow / len(points) / np.sqrt(1 + np.square(error).sum(1))
        scale = np.sqrt(robust)
        slope *= scale[:, None, None] / unit
        moved = np.broadcast_to(slope[:, None], (*arms.shape[:2], 2, 3))
        blocks = np.concatenate([-moved @ _cross(arms), moved], -1) * self._weights[targets.rows][..., None, None]
        return [(blocks, self._indices[targets.rows], error * scale[:, None])]

    def _rigidity_terms(self, pose: Pose) -> list[_Term]:
        settings, edges = self._settings, len(self._edges)
        weight, log = settings.rigidity, settings.rigidity_loss == "log"
        places, eye, none = self._nodes + pose.shifts, np.eye(3), np.zeros((edges, 3, 3))
        terms = []
        for start, end, sign in ((0, 1, 1.0), (1, 0, -1.0)):
            first, second = self._edges[:, start], self._edges[:, end]
            turned = np.einsum("eij,ej->ei", pose.turns[first], sign * self._spans)
            stretch = (places[second] - places[first] - turned) / self._lengths[:, None]
            scale = np.sqrt(weight / (2 * edges) / _softened(stretch, log))
            unit = (scale / self._lengths)[:, None, None]
            blocks = np.stack(
                [
                    np.concatenate([_cross(turned) * unit, -eye * unit], -1),
                    np.concatenate([none, eye * unit], -1),
                ],
                1,
            )
            terms.append((blocks, np.stack([first, second], 1), stretch * scale[:, None]))
        first, second = self._edges.T
        bend = rotation_vector(pose.turns[second] @ pose.turns[first].swapaxes(1, 2))
        scale = np.sqrt(weight * settings.bending / edges / _softened(bend, log))
        unit = scale[:, None, None] * eye
        blocks = np.stack([np.concatenate([-unit, none], -1), np.concatenate([unit, none], -1)], 1)
        terms.append((blocks, self._edges, bend * scale[:, None]))
        return terms


def across_weight(settings: AssetSettings, normal: Float[np.ndarray, " 3"]) -> float:
    """Return the weight of displacements across the mirror plane, less where it is seen nearly edge-on.

    The picture then shows displacements across the plane, and the plane gives no information on depth.
    """
    return float(settings.across * min(1.0, (normal[2] / SLANTED) ** 2))


def _features(pictures: Float[Tensor, "t s s 3"], alphas: Float[Tensor, "t s s 1"]) -> Float[Tensor, "t 4 h w"]:
    """Return blurred pictures of half the size."""
    both = torch.cat([pictures, ALPHA_WEIGHT * alphas], -1).movedim(-1, 1)
    return functional.avg_pool2d(functional.avg_pool2d(functional.avg_pool2d(both, 3, 1, 1), 3, 1, 1), 2)


def _softened(values: Float[np.ndarray, "n 3"], log: bool) -> Float[np.ndarray, " n"]:
    """Return the divisor that makes a quadratic loss linear for large values, or logarithmic."""
    divisor: Float[np.ndarray, " n"] = np.sqrt(np.square(values).sum(1) + ROBUST**2)
    return divisor * (1 + divisor / LOG_SCALE) if log else divisor


def _cross(vectors: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3 3"]:
    """Return the matrices of the cross products with vectors."""
    matrix = np.zeros((*vectors.shape, 3))
    x, y, z = np.moveaxis(vectors, -1, 0)
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -z, y, -x
    return matrix - matrix.swapaxes(-1, -2)
