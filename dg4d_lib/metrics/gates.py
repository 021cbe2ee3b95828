"""Quality gates: acceptance criteria of an asset that need no ground truth.

Ten measures compare the asset with its input image and driving video, and with itself from other sides. Their bounds,
in `GateSettings`, are calibrated on good assets and on deliberately degraded ones (benchmarks/gates.py). Most measures
are taken of both forms of an asset, splats and mesh, and the worse one counts.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from scipy.ndimage import label
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool2d

from dg4d_lib.asset_settings import GateSettings
from dg4d_lib.metrics.image import iou, mean_of_shown, psnr
from dg4d_lib.metrics.video import EPS, temporal_error

SUBJECT_ALPHA = 0.5  # pixels with a larger alpha belong to the subject
FLOATER_ALPHA = 0.05  # fainter floaters are invisible (ours)
CONNECTIVITY = np.ones((3, 3))  # 8-connected components
RIM = 3  # pixels inside the silhouette that sharpness ignores, because a silhouette is always sharp
STILL = 0.002  # imperceptible change per frame and subject pixel, colors in [0, 1] (ours)
PLAIN = 0.002  # color gradient per pixel of an image without texture (ours)
DEPTH_TOLERANCE = 0.05  # world units between the positions of one point in two views (ours)
SPLATS, MESH = "splats", "mesh"  # the forms of an asset
LOW, HIGH = "low", "high"  # sides of the bounds

# Advice by gate and side of the bounds, and by form where it depends on that.
_Advice = Mapping[tuple[str, str], str | Mapping[str, str]]
_TRACKED: _Advice = {
    ("fidelity", LOW): {
        SPLATS: "raise static.iterations or motion.iterations (the report's image shows which)",
        MESH: "raise mesh.render_size",
    },
    ("silhouette", LOW): "if single frames fail, raise motion.iterations; if all do, check the cut-out for remaining "
    "background",
    ("consistency", LOW): "the shape falls apart from other sides: raise static.iterations and static.views, or try "
    "another seed",
    ("flicker", HIGH): "raise motion.iterations or deformation.smoothness_weight (typical: 0.01)",
    ("floaters", HIGH): {
        SPLATS: "raise static.prune_opacity, or remove specks from the cut-out",
        MESH: "raise mesh.min_component, or remove specks from the cut-out",
    },
    ("flaws", HIGH): "use mesh.source=gaussians with another mesh.density_threshold or a larger mesh.grid",
    ("folds", HIGH): "for complex motions: --set mesh.mode=per_frame; else use a smaller mesh.grid",
    ("agreement", LOW): "for missing thin parts: --set mesh.source=gaussians --set mesh.density_threshold=0.25; for "
    "complex motions: --set mesh.mode=per_frame",
    ("sharpness", LOW): {SPLATS: "raise static.iterations", MESH: "raise mesh.texture_size and mesh.render_size"},
    ("sharpness", HIGH): "lower static.color_lr",
    ("motion", LOW): "raise motion.iterations",
    ("motion", HIGH): "lower motion.plane_lr or motion.network_lr",
}
_PER_FRAME: _Advice = {
    **_TRACKED,
    ("flaws", HIGH): "use another mesh.density_threshold or a larger mesh.grid",
    ("folds", HIGH): "use a smaller mesh.grid",
    ("agreement", LOW): "for missing thin parts: lower mesh.density_threshold (default: 0.5) or raise mesh.grid",
}
_OWN_MODEL: _Advice = {
    ("fidelity", LOW): "raise asset.joint_iterations or asset.nodes; the colors stay those of the model",
    ("silhouette", LOW): "if single frames fail, raise asset.joint_iterations or asset.nodes; if all do, give "
    "--asset-azimuth, or check the cut-out for remaining background",
    ("consistency", LOW): "raise asset.points",
    ("flicker", HIGH): "raise asset.smoothness",
    ("floaters", HIGH): "parts of the model lie apart from it; no setting removes them",
    ("flaws", HIGH): "raise asset.rigidity",
    ("folds", HIGH): "raise asset.rigidity",
    ("agreement", LOW): "raise asset.points",
    ("sharpness", LOW): {SPLATS: "raise asset.points", MESH: "raise mesh.texture_size"},
    ("sharpness", HIGH): "the texture of the model is sharper than the picture; no setting changes it",
    ("motion", LOW): "raise asset.joint_iterations or lower asset.smoothness",
    ("motion", HIGH): "raise asset.smoothness",
}


@dataclass(frozen=True)
class RgbaImages:
    """Square images of a subject.

    Attributes:
        color: over white, in [0, 1].
        alpha: in [0, 1].
    """

    color: Float[Tensor, "b s s 3"]
    alpha: Float[Tensor, "b s s 1"]


@dataclass(frozen=True)
class Turntable:
    """Renders of one frame from a closed ring of cameras, in order.

    Attributes:
        alpha: in [0, 1], one image per camera.
        depth: camera z of the surface, world units; arbitrary where alpha is 0.
        viewmats: world to camera, OpenCV axes.
        focal: of all cameras, pixels.
    """

    alpha: Float[Tensor, "b s s 1"]
    depth: Float[Tensor, "b s s 1"]
    viewmats: Float[Tensor, "b 4 4"]
    focal: float


@dataclass(frozen=True)
class GateInputs:
    """Images that the gates compare, all of the same size.

    Attributes:
        picture: the input image, a batch of one.
        video: frames of the driving video.
        input_views: the asset from the input camera at these frames, by form.
        side_views: the asset from other sides and at other frames, the same ones for every form.
        turntable: the splats from all around.
        flaws: broken edges and triangles of the mesh, per triangle.
        folds: share of the triangles of the mesh that cross others, are flipped or folded, in the worst frame.
        own_model: the mesh is a model of the user's own; flaws and folds are those that its motion adds.
        per_frame: every frame has a mesh of its own.
    """

    picture: RgbaImages
    video: RgbaImages
    input_views: Mapping[str, RgbaImages]
    side_views: Mapping[str, RgbaImages]
    turntable: Turntable
    flaws: float
    folds: float
    own_model: bool = False
    per_frame: bool = False


@dataclass(frozen=True)
class Gate:
    """Measure with its bounds.

    Attributes:
        name: in reports.
        values: by form of the asset; finite.
        least: lower bound; None: unbounded.
        most: upper bound; None: unbounded.
        unit: of the values; empty for ratios.
        meaning: description in one line.
        advice: remedy for a failed gate; empty if it passed.
    """

    name: str
    values: Mapping[str, float]
    least: float | None
    most: float | None
    unit: str
    meaning: str
    advice: str = ""

    @property
    def form(self) -> str:
        """Form of the asset with the worst value."""
        return min(self.values, key=lambda form: self._margin(self.values[form]))

    @property
    def value(self) -> float:
        """Worst value of all forms."""
        return self.values[self.form]

    @property
    def passed(self) -> bool:
        """True if all values are within the bounds, ends included."""
        return self._margin(self.value) >= 0

    def side(self, value: float) -> str:
        """Return the side of the bounds on which a value lies, `low` or `high`; empty within them."""
        if self.least is not None and value < self.least:
            return LOW
        return HIGH if self.most is not None and value > self.most else ""

    def _margin(self, value: float) -> float:
        """Return the distance of a value to the nearest bound; negative outside."""
        below = math.inf if self.least is None else value - self.least
        above = math.inf if self.most is None else self.most - value
        return min(below, above)


def evaluate_gates(inputs: GateInputs, settings: GateSettings) -> list[Gate]:
    """Evaluate all gates, in the order of the report."""
    video, input_views, side_views = inputs.video, inputs.input_views, inputs.side_views
    video_floaters = float(floaters(video).mean())
    gates = [
        Gate(
            "fidelity",
            {
                form: float(mean_of_shown(fidelity(images, video), _subject(images, video)))
                for form, images in input_views.items()
            },
            settings.fidelity_least,
            None,
            "dB",
            "agreement with the video from the input camera: PSNR on the subject, mean over frames",
        ),
        Gate(
            "silhouette",
            {form: float(iou(images.alpha, video.alpha).min()) for form, images in input_views.items()},
            settings.silhouette_least,
            None,
            "",
            "overlap of the silhouette with the video's from the input camera, in the worst frame",
        ),
        Gate(
            "consistency",
            {SPLATS: consistency(inputs.turntable)},
            settings.consistency_least,
            None,
            "",
            "share of the points seen from one side that the next view, 15 degrees further, does not contradict",
        ),
        Gate(
            "flicker",
            {form: flicker(images, video) for form, images in input_views.items()},
            None,
            settings.flicker_most,
            "",
            "error of the changes from frame to frame; 0 is the video itself, 1 a frozen asset",
        ),
        Gate(
            "floaters",
            {form: max(0.0, float(floaters(images).mean()) - video_floaters) for form, images in side_views.items()},
            None,
            settings.floaters_most,
            "",
            "share of the alpha that is disconnected from the subject, over sides and frames, minus the video's share",
        ),
        Gate(
            "flaws",
            {MESH: inputs.flaws},
            None,
            settings.flaws_most,
            "",
            "share of defects per triangle: open or non-manifold edges, degenerate or inverted triangles; defects that "
            "your own model already has do not count",
        ),
        Gate(
            "folds",
            {MESH: inputs.folds},
            None,
            settings.added_folds_most if inputs.own_model else settings.folds_most,
            "",
            "share of triangles that cross others, are flipped or folded, in the worst frame; visible as dark creases "
            "under light; those that your own model has at rest do not count",
        ),
        Gate(
            "agreement",
            {MESH: float(iou(side_views[MESH].alpha, side_views[SPLATS].alpha).mean())},
            settings.agreement_least,
            None,
            "",
            "overlap of the silhouettes of mesh and splats, over sides and frames",
        ),
        Gate(
            "sharpness",
            {form: sharpness(_first(images), inputs.picture) for form, images in input_views.items()},
            settings.sharpness_least,
            settings.sharpness_most,
            "",
            "color gradients inside the subject, relative to the input image; low: blurred, high: noisy",
        ),
        Gate(
            "motion",
            {form: motion(images, video) for form, images in input_views.items()},
            settings.motion_least,
            settings.motion_most,
            "",
            "amount of change from frame to frame, relative to the video; near 0: frozen",
        ),
    ]
    advice = _OWN_MODEL if inputs.own_model else _PER_FRAME if inputs.per_frame else _TRACKED
    return [gate if gate.passed else replace(gate, advice=_advice_on(gate, advice)) for gate in gates]


def _advice_on(gate: Gate, advice: _Advice) -> str:
    """Return the remedy of a failed gate, for the forms that fail on the side of the worst value."""
    side = gate.side(gate.value)
    found = advice.get((gate.name, side), "")  # no side if a value is not a number
    if isinstance(found, str):
        return found
    forms = [form for form, value in gate.values.items() if gate.side(value) == side]
    return found[forms[0]] if len(forms) == 1 else "; ".join(f"{form}: {found[form]}" for form in forms)


def fidelity(images: RgbaImages, video: RgbaImages) -> Float[Tensor, " b"]:
    """Return the PSNR in dB over the union of the silhouettes."""
    return psnr(images.color, video.color, _subject(images, video))


def _subject(images: RgbaImages, video: RgbaImages) -> Float[Tensor, "b h w 1"]:
    """Return 1 in the union of the silhouettes, else 0."""
    return (torch.maximum(images.alpha, video.alpha) > SUBJECT_ALPHA).to(video.alpha)


def flicker(images: RgbaImages, video: RgbaImages) -> float:
    """Return the temporal error relative to the video's changes plus imperceptible ones."""
    if len(video.color) < 2:
        return 0.0
    changes = max(EPS, _changes(video))
    return float(temporal_error(images.color, video.color)) * changes / (changes + _still(video))


def motion(images: RgbaImages, video: RgbaImages) -> float:
    """Return the total change relative to the video's; 1 if both are still."""
    return (_changes(images) + _still(video)) / (_changes(video) + _still(video))


def floaters(images: RgbaImages) -> Float[Tensor, " b"]:
    """Return the share of the alpha outside the largest connected component; 0 for an empty image."""
    return torch.tensor([_disconnected(alpha) for alpha in images.alpha[..., 0].cpu().numpy()])


def consistency(views: Turntable) -> float:
    """Return the share of points seen in one view that the next view does not contradict; 0 if nothing is seen.

    The depth of a pixel gives a point in space. If the next view sees a surface in front of it, the point is occluded
    and does not count. If it sees through the point or behind it, the views contradict each other, as they do for
    surfaces at another depth in every view and for clouds that resemble the subject only from the front.
    """
    size = views.depth.shape[1]
    points = _rays(size, views.focal).to(views.depth) * views.depth
    to_next = torch.linalg.solve(views.viewmats, views.viewmats.roll(-1, 0), left=False).to(points)
    moved = points @ to_next[:, None, :3, :3].mT + to_next[:, None, None, :3, 3]
    depth = moved[..., 2:]
    positions = moved[..., :2] / depth * (2 * views.focal / size)
    next_view = torch.cat([views.alpha, views.depth], -1).roll(-1, 0).movedim(-1, 1)
    alpha, seen_depth = grid_sample(next_view, positions, align_corners=False).movedim(1, -1).split(1, -1)
    solid = alpha > SUBJECT_ALPHA
    counted = (views.alpha > SUBJECT_ALPHA) & ~(solid & (seen_depth < depth - DEPTH_TOLERANCE))
    agreed = counted & solid & (seen_depth <= depth + DEPTH_TOLERANCE)
    return float(agreed.sum() / counted.sum().clamp_min(1))


def sharpness(images: RgbaImages, reference: RgbaImages) -> float:
    """Return the color gradients inside the subject relative to the reference's; 1 if both are plain."""
    outside = torch.minimum(images.alpha, reference.alpha) <= SUBJECT_ALPHA
    inside = max_pool2d(outside.movedim(-1, 1).float(), 2 * RIM + 1, 1, RIM)[:, 0] == 0
    ours, theirs = (_gradient(each.color, inside) for each in (images, reference))
    return (ours + PLAIN) / (theirs + PLAIN)


def _first(images: RgbaImages) -> RgbaImages:
    return RgbaImages(images.color[:1], images.alpha[:1])


def _changes(images: RgbaImages) -> float:
    return float(images.color.diff(dim=0).abs().mean(-1).sum())


def _still(video: RgbaImages) -> float:
    """Return the total of imperceptible changes of a video."""
    return STILL * float(video.alpha[1:].sum()) + EPS


def _disconnected(alpha: NDArray[np.float32]) -> float:
    components, count = label(alpha > FLOATER_ALPHA, CONNECTIVITY)
    masses = np.bincount(components.ravel(), alpha.ravel(), count + 1)[1:]
    return 1 - float(masses.max() / masses.sum()) if count else 0.0


def _rays(size: int, focal: float) -> Float[Tensor, "s s 3"]:
    """Return the rays through the pixel centers, of depth 1."""
    line = (torch.arange(size) + 0.5 - size / 2) / focal
    y, x = torch.meshgrid(line, line, indexing="ij")
    return torch.stack([x, y, torch.ones_like(x)], -1)


def _gradient(color: Float[Tensor, "b s s 3"], inside: Bool[Tensor, "b s s"]) -> float:
    """Return the mean norm of the color gradient over pixels inside the mask."""
    across, down = color.diff(dim=2)[:, :-1], color.diff(dim=1)[:, :, :-1]
    lengths = (across.square() + down.square()).sum(-1).sqrt()
    counted = inside[:, :-1, :-1]
    return float((lengths * counted).sum() / counted.sum().clamp_min(1))
