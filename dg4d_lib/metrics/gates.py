"""Whether an asset is good enough to be handed on, judged without knowing the truth.

Nine measures compare what was made with the picture and the video it was made from, and with itself from other sides.
Their bounds, in `GateSettings`, are calibrated on good assets and on deliberately spoiled ones (benchmarks/gates.py).
Most measures are taken of both forms of an asset, its splats and its mesh, and the worse one counts.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from scipy.ndimage import label
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool2d

from dg4d_lib.asset_settings import GateSettings
from dg4d_lib.metrics.image import iou, psnr
from dg4d_lib.metrics.video import NOTHING, temporal_error

SUBJECT_ALPHA = 0.5  # alpha from which a pixel belongs to the subject
FLOATER_ALPHA = 0.05  # alpha below which nobody sees a floater
TOUCHING = np.ones((3, 3))  # pixels that share a corner hang together
RIM = 3  # pixels inside the outline where sharpness is not measured: an outline is sharp by itself
STILL = 0.002  # change per frame and pixel of the subject, colors in [0, 1], below which nothing seems to move
PLAIN = 0.002  # color gradient per pixel below which there is nothing to be sharp
SAME_PLACE = 0.05  # world units between the places of one point as two sides show it
SPLATS, MESH = "splats", "mesh"  # the forms of an asset


@dataclass(frozen=True)
class RgbaImages:
    """Square pictures of a subject.

    Attributes:
        color: over white, in [0, 1].
        alpha: alpha in [0, 1].
    """

    color: Float[Tensor, "b s s 3"]
    alpha: Float[Tensor, "b s s 1"]


@dataclass(frozen=True)
class Turntable:
    """Seen from all around at one moment: neighbors beside each other, the last beside the first.

    Attributes:
        alpha: alpha in [0, 1], a picture per camera.
        depth: camera z of what is seen, world units; any number where nothing is.
        cameras: world to camera, OpenCV axes.
        focal: of all of them, pixels.
    """

    alpha: Float[Tensor, "b s s 1"]
    depth: Float[Tensor, "b s s 1"]
    cameras: Float[Tensor, "b 4 4"]
    focal: float


@dataclass(frozen=True)
class GateInputs:
    """All that the gates look at; every picture has the same size.

    Attributes:
        picture: the input, one picture: the first moment.
        video: frames of the driving video.
        seen: the asset from the input camera at the moments of these frames, by its form.
        around: pairs of a side and a moment, the same ones for every form.
        turn: the splats from all around.
        flaws: of the mesh: broken edges and triangles, per triangle.
    """

    picture: RgbaImages
    video: RgbaImages
    seen: Mapping[str, RgbaImages]
    around: Mapping[str, RgbaImages]
    turn: Turntable
    flaws: float


@dataclass(frozen=True)
class Gate:
    """A measure and its bounds.

    Attributes:
        name: by which it is listed.
        values: by the form of the asset that was measured; finite.
        least: no value may be below; None: nothing is too small.
        most: nor above; None: nothing is too large.
        unit: of the values; empty for ratios and shares.
        meaning: what is measured, in one line.
        advice: what to do where it fails.
    """

    name: str
    values: Mapping[str, float]
    least: float | None
    most: float | None
    unit: str
    meaning: str
    advice: str

    @property
    def form(self) -> str:
        """The form of the asset that is worse."""
        return min(self.values, key=lambda form: self._room(self.values[form]))

    @property
    def value(self) -> float:
        """Of the worse form."""
        return self.values[self.form]

    @property
    def passed(self) -> bool:
        """Whether every value lies within the bounds, which belong to them."""
        return self._room(self.value) >= 0

    def _room(self, value: float) -> float:
        """How far a value is from the nearest bound; negative beyond it."""
        below = math.inf if self.least is None else value - self.least
        above = math.inf if self.most is None else self.most - value
        return min(below, above)


def evaluate_gates(evidence: GateInputs, settings: GateSettings) -> list[Gate]:
    """Every gate, in the order of a report."""
    video, seen, around = evidence.video, evidence.seen, evidence.around
    own = float(floaters(video).mean())
    return [
        Gate(
            "fidelity",
            {form: float(fidelity(pictures, video).mean()) for form, pictures in seen.items()},
            settings.fidelity_least,
            None,
            "dB",
            "how well it shows the video from the input view: PSNR on the subject, mean over frames",
            "raise static.iterations, motion.iterations or mesh.render_size; the picture says which",
        ),
        Gate(
            "silhouette",
            {form: float(iou(pictures.alpha, video.alpha).min()) for form, pictures in seen.items()},
            settings.silhouette_least,
            None,
            "",
            "overlap of its outline with the video's from the input view, in the worst frame: one torn frame is enough",
            "a limb or a spike in one frame: raise motion.iterations; everywhere: is background left in the cut-out?",
        ),
        Gate(
            "consistency",
            {SPLATS: consistency(evidence.turn)},
            settings.consistency_least,
            None,
            "",
            "share of the points seen from one side that the next side, 15 degrees on, does not contradict",
            "the shape falls apart when it is turned: more static.iterations and static.views, or another seed",
        ),
        Gate(
            "flicker",
            {form: flicker(pictures, video) for form, pictures in seen.items()},
            None,
            settings.flicker_most,
            "",
            "changes from frame to frame that are not the video's; 0 is the video itself, 1 a frozen asset",
            "more motion.iterations, or a smoother deformation (deformation.smoothness_weight=0.01)",
        ),
        Gate(
            "floaters",
            {form: max(0.0, float(floaters(pictures).mean()) - own) for form, pictures in around.items()},
            None,
            settings.floaters_most,
            "",
            "share of what is seen that hangs apart from the subject, over sides and moments, less the video's own",
            "raise static.prune_opacity or mesh.min_component; remove specks from the cut-out",
        ),
        Gate(
            "flaws",
            {MESH: evidence.flaws},
            None,
            settings.flaws_most,
            "",
            "edges on rims and between wrong sides, triangles without area, parts turned inside out: per triangle",
            "extract again with another mesh.density_threshold or a finer mesh.grid",
        ),
        Gate(
            "agreement",
            {MESH: float(iou(around[MESH].alpha, around[SPLATS].alpha).mean())},
            settings.agreement_least,
            None,
            "",
            "overlap of the outlines of mesh and splats, over sides and moments",
            "lower mesh.density_threshold for thin parts, or take mesh.mode=per_frame for motions no mesh can follow",
        ),
        Gate(
            "sharpness",
            {form: sharpness(_first(pictures), evidence.picture) for form, pictures in seen.items()},
            settings.sharpness_least,
            settings.sharpness_most,
            "",
            "color gradients inside the subject, in units of the input picture's: low is blurred, high is noise",
            "blurred: raise mesh.texture_size, mesh.render_size, static.iterations; noisy: lower static.color_lr",
        ),
        Gate(
            "motion",
            {form: motion(pictures, video) for form, pictures in seen.items()},
            settings.motion_least,
            settings.motion_most,
            "",
            "how much changes from frame to frame, in units of the video's: near 0 is frozen, far above 1 explodes",
            "raise motion.iterations if too little moves; lower motion.plane_lr or motion.network_lr if too much",
        ),
    ]


def fidelity(pictures: RgbaImages, video: RgbaImages) -> Float[Tensor, " b"]:
    """PSNR where either of two pictures shows the subject, dB."""
    region = torch.maximum(pictures.alpha, video.alpha) > SUBJECT_ALPHA
    return psnr(pictures.color, video.color, region.to(video.alpha))


def flicker(pictures: RgbaImages, video: RgbaImages) -> float:
    """The temporal error, in units of the video's changes or of what seems still, whichever there is."""
    if len(video.color) < 2:
        return 0.0
    changes = max(NOTHING, _changes(video))
    return float(temporal_error(pictures.color, video.color)) * changes / (changes + _still(video))


def motion(pictures: RgbaImages, video: RgbaImages) -> float:
    """How much changes in all, in units of the video's changes; nothing in nothing is 1."""
    return (_changes(pictures) + _still(video)) / (_changes(video) + _still(video))


def floaters(pictures: RgbaImages) -> Float[Tensor, " b"]:
    """Share of the alpha in pieces away from the largest one; 0 where there is nothing."""
    return torch.tensor([_apart(alpha) for alpha in pictures.alpha[..., 0].cpu().numpy()])


def consistency(turn: Turntable) -> float:
    """How solid something is: share of the points seen from one side that the next side does not contradict.

    Every pixel of the subject is a point in space by its depth. The neighbor may see something in front of that point:
    then it says nothing about it. If it sees through the point, or past it, the two contradict each other: so do faces
    that are painted at a depth of their own for every side, and clouds that only look like the subject from the front.
    0 where nothing is seen.
    """
    size = turn.depth.shape[1]
    points = _rays(size, turn.focal).to(turn.depth) * turn.depth
    onward = torch.linalg.solve(turn.cameras, turn.cameras.roll(-1, 0), left=False).to(points)
    there = points @ onward[:, None, :3, :3].mT + onward[:, None, None, :3, 3]
    depth = there[..., 2:]
    places = there[..., :2] / depth * (2 * turn.focal / size)
    neighbor = torch.cat([turn.alpha, turn.depth], -1).roll(-1, 0).movedim(-1, 1)
    alpha, found = grid_sample(neighbor, places, align_corners=False).movedim(1, -1).split(1, -1)
    solid = alpha > SUBJECT_ALPHA
    asked = (turn.alpha > SUBJECT_ALPHA) & ~(solid & (found < depth - SAME_PLACE))
    agreed = asked & solid & (found <= depth + SAME_PLACE)
    return float(agreed.sum() / asked.sum().clamp_min(1))


def sharpness(pictures: RgbaImages, truth: RgbaImages) -> float:
    """Color gradients inside the subject, in units of the truth's; nothing in nothing is 1."""
    outside = torch.minimum(pictures.alpha, truth.alpha) <= SUBJECT_ALPHA
    inside = max_pool2d(outside.movedim(-1, 1).float(), 2 * RIM + 1, 1, RIM)[:, 0] == 0
    ours, theirs = (_gradient(each.color, inside) for each in (pictures, truth))
    return (ours + PLAIN) / (theirs + PLAIN)


def _first(pictures: RgbaImages) -> RgbaImages:
    return RgbaImages(pictures.color[:1], pictures.alpha[:1])


def _changes(pictures: RgbaImages) -> float:
    return float(pictures.color.diff(dim=0).abs().mean(-1).sum())


def _still(video: RgbaImages) -> float:
    """The changes of a video in which nothing seems to move."""
    return STILL * float(video.alpha[1:].sum()) + NOTHING


def _apart(alpha: NDArray[np.float32]) -> float:
    pieces, count = label(alpha > FLOATER_ALPHA, TOUCHING)
    masses = np.bincount(pieces.ravel(), alpha.ravel(), count + 1)[1:]
    return 1 - float(masses.max() / masses.sum()) if count else 0.0


def _rays(size: int, focal: float) -> Float[Tensor, "s s 3"]:
    """From the camera through the middles of the pixels to depth 1."""
    line = (torch.arange(size) + 0.5 - size / 2) / focal
    y, x = torch.meshgrid(line, line, indexing="ij")
    return torch.stack([x, y, torch.ones_like(x)], -1)


def _gradient(color: Float[Tensor, "b s s 3"], inside: Bool[Tensor, "b s s"]) -> float:
    """The mean length of the color's gradient where a pixel and its neighbors are inside."""
    across, down = color.diff(dim=2)[:, :-1], color.diff(dim=1)[:, :, :-1]
    lengths = (across.square() + down.square()).sum(-1).sqrt()
    counted = inside[:, :-1, :-1]
    return float((lengths * counted).sum() / counted.sum().clamp_min(1))
