"""Placement of a user's model in the frame of a cut-out: azimuth, scale and position, from outlines and colors.

The model is rendered from azimuths all around (and with other axes up, where its format leaves that open), each time
scaled and moved to the outline of the subject. The best candidates are refined by gradients. A model that agrees with
the picture as it stands keeps its place.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from dg4d_lib.adam import Adam
from dg4d_lib.cameras.orbit import RADIUS, OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.fitting.asset_fit import antialiased
from dg4d_lib.fitting.losses import WHITE, resize_cutouts
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.transform import thinned
from dg4d_lib.geometry.quaternion import quat_multiply, quat_to_rotmat
from dg4d_lib.rasterizer.interface import Rasterizer

SIZE = 64  # pixels of the search
FINE_SIZE = 96  # pixels of the refinement
PICTURE_SIZE = 256  # pixels per side of the pictures for the user
SEARCHED = 2500  # Gaussians in the search
STEPS = 24  # azimuths of the search
KEPT = 3  # candidates that are refined
APART = 60  # degrees between the azimuths of placements that count as different
ITERATIONS = 40
REACH = 0.6  # world units: half diagonal of a model without a picture
STANDS = 0.08  # score bonus of the identity placement: its depth is right, too, which outlines hardly show
UPRIGHT = {"y": (1.0, 0.0, 0.0, 0.0), "z": (math.sqrt(0.5), -math.sqrt(0.5), 0.0, 0.0), "-y": (0.0, 1.0, 0.0, 0.0)}


@dataclass(frozen=True)
class Placement:
    """Similarity from the coordinates of a model to the world.

    Attributes:
        quat: rotation, wxyz, unit.
        scale: factor, above 0.
        shift: translation, world units.
        azimuth_deg: azimuth of the model from which the picture was taken.
        agreement: IoU of the outlines of model and subject.
        color_error: root mean square difference of the colors where both are.
        posed: the picture shows another pose than the model has at rest, and `agreement` is that of the posed model.
    """

    quat: Float[Tensor, " 4"]
    scale: float
    shift: Float[Tensor, " 3"]
    azimuth_deg: float = 0.0
    agreement: float = 1.0
    color_error: float = 0.0
    posed: bool = False

    @classmethod
    def identity(cls) -> "Placement":
        """Return the identity placement: model and world coordinates are equal."""
        return cls(torch.tensor(UPRIGHT["y"]), 1.0, torch.zeros(3))

    @property
    def matrix(self) -> Float[np.ndarray, "4 4"]:
        """Affine matrix, float64."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.scale * quat_to_rotmat(self.quat.double()).numpy()
        matrix[:3, 3] = self.shift.double().numpy()
        return matrix

    @property
    def score(self) -> float:
        """Agreement less color error, higher is better."""
        return self.agreement - self.color_error

    def apply(self, cloud: Gaussians) -> Gaussians:
        """Return the placed Gaussians; their colors must not depend on the view."""
        return _similar(cloud, self.quat, torch.tensor(self.scale).log(), self.shift)


def centered_placement(cloud: Gaussians, azimuth_deg: float, up: str = "y") -> Placement:
    """Return the placement of a model in the middle of the frame, seen from an azimuth.

    Args:
        cloud: Gaussians in the coordinates of the model.
        azimuth_deg: azimuth of the model, 0 on its +z.
        up: axis that points up: y, z or -y.
    """
    quat = quat_multiply(_turn(-azimuth_deg), torch.tensor(UPRIGHT[up]))
    turned = cloud.means @ quat_to_rotmat(quat).T
    low, high = turned.amin(0), turned.amax(0)
    extent = float((high - low).norm()) / 2
    if not 0 < extent < math.inf:
        raise BadInput("the model has no extent: all of its points are in one place; export it again")
    scale = REACH / extent
    return Placement(quat, scale, -scale * (low + high) / 2, azimuth_deg)


def find_placement(
    cloud: Gaussians,
    subject: Float[Tensor, "h w 4"],
    rasterize: Rasterizer,
    azimuth_deg: float | None = None,
    ups: Sequence[str] = ("y",),
) -> Placement:
    """Find the placement in which a model agrees best with a cut-out of the camera at azimuth and elevation 0.

    Args:
        cloud: Gaussians in the coordinates of the model.
        subject: square picture, straight alpha.
        rasterize: rasterizer.
        azimuth_deg: azimuth of the model, if the user gave it.
        ups: axes that may point up.
    """
    sparse, best = _coarse_search(cloud, subject, rasterize, azimuth_deg, ups)
    refined = [_refine(sparse, one, subject, rasterize, azimuth_deg is None) for one in best[:KEPT]]
    as_it_stands = Placement.identity()
    tried = [*refined, *([as_it_stands] if not azimuth_deg else [])]
    results = judge(cloud, tried, subject, rasterize, FINE_SIZE)
    found = max(results[: len(refined)], key=lambda one: one.score)
    if not azimuth_deg and results[-1].score + STANDS >= found.score:
        return results[-1]
    return found


def distinct_placements(
    cloud: Gaussians,
    subject: Float[Tensor, "h w 4"],
    rasterize: Rasterizer,
    azimuth_deg: float | None = None,
    ups: Sequence[str] = ("y",),
) -> list[Placement]:
    """Return the best placements of different azimuths, for a model whose pose in the picture is not known.

    Outlines tell the front from the back only of a model that stands as the picture shows it. The arguments are those
    of `find_placement`.
    """
    sparse, ranked = _coarse_search(cloud, subject, rasterize, azimuth_deg, ups)
    selected: list[Placement] = []
    for one in ranked:
        if all(_degrees_between(one.azimuth_deg, other.azimuth_deg) >= APART for other in selected):
            selected.append(one)
    return [_refine(sparse, one, subject, rasterize, azimuth_deg is None) for one in selected[:KEPT]]


def _coarse_search(
    cloud: Gaussians,
    subject: Float[Tensor, "h w 4"],
    rasterize: Rasterizer,
    azimuth_deg: float | None,
    ups: Sequence[str],
) -> tuple[Gaussians, list[Placement]]:
    """Return some of the Gaussians, and placements all around, the best first."""
    sparse = thinned(cloud, max(1, len(cloud) // SEARCHED))
    azimuths = [azimuth_deg] if azimuth_deg is not None else [360 * step / STEPS for step in range(STEPS)]
    candidates = [centered_placement(sparse, azimuth, up) for up in ups for azimuth in azimuths]
    for _ in range(2):
        candidates = _match_outlines(sparse, candidates, subject, rasterize)
    judged = judge(sparse, candidates, subject, rasterize, SIZE)
    return sparse, sorted(judged, key=lambda one: -one.score)


def _degrees_between(first: float, second: float) -> float:
    return abs((first - second + 180) % 360 - 180)


def judge(
    cloud: Gaussians, placements: Sequence[Placement], subject: Float[Tensor, "h w 4"], rasterize: Rasterizer, size: int
) -> list[Placement]:
    """Return the placements with their agreement and color error."""
    target, mask = resize_cutouts(subject[None], size)
    judged = []
    for placement, (color, alpha) in zip(placements, _renders(cloud, placements, rasterize, size), strict=True):
        ours, theirs = alpha > 0.5, mask[0] > 0.5
        both, either = (ours & theirs).sum(), (ours | theirs).sum()
        error = ((color - target[0]).square().mean(-1, keepdim=True) * (ours & theirs)).sum() / both.clamp(min=1)
        judged.append(replace(placement, agreement=float(both / either.clamp(min=1)), color_error=float(error.sqrt())))
    return judged


def picture_of_both(
    cloud: Gaussians, placement: Placement, subject: Float[Tensor, "h w 4"], rasterize: Rasterizer
) -> Float[Tensor, "size width 3"]:
    """Draw subject, placed model and the outlines of both in a row, over white; red: subject alone, blue: model."""
    target, mask = resize_cutouts(subject[None], PICTURE_SIZE)
    ((color, alpha),) = _renders(cloud, [placement], rasterize, PICTURE_SIZE)
    overlay = torch.cat([1 - alpha, 1 - torch.maximum(alpha, mask[0]), 1 - mask[0]], -1)
    return torch.cat([target[0], color, overlay], 1).clamp(0, 1)


def _renders(
    cloud: Gaussians, placements: Sequence[Placement], rasterize: Rasterizer, size: int
) -> list[tuple[Float[Tensor, "s s 3"], Float[Tensor, "s s 1"]]]:
    """Return color over white and alpha of every placement; opacities follow its scale, so none share a batch."""
    camera = OrbitCamera(width=size, height=size)
    with torch.no_grad():
        renderings = [
            rasterize(antialiased(one.apply(cloud), camera), [camera], torch.tensor(WHITE)) for one in placements
        ]
    return [(one.color[0], one.alpha[0]) for one in renderings]


def _match_outlines(
    cloud: Gaussians, placements: Sequence[Placement], subject: Float[Tensor, "h w 4"], rasterize: Rasterizer
) -> list[Placement]:
    """Scale and move placements so that area and center of their outlines are those of the subject."""
    mask = resize_cutouts(subject[None], SIZE)[1][0]
    area, center = _area_and_center(mask)
    framed = []
    for placement, (_, alpha) in zip(placements, _renders(cloud, placements, rasterize, SIZE), strict=True):
        ours, middle = _area_and_center(alpha)
        ratio = float((area / ours.clamp(min=1e-3)).sqrt().clamp(0.2, 5))
        pixel = RADIUS * 2 * math.tan(math.radians(OrbitCamera().fov_y_deg) / 2) / SIZE  # world units at the origin
        step = (center - ratio * (middle - SIZE / 2) - SIZE / 2) * pixel
        shift = ratio * placement.shift + torch.tensor([float(step[0]), -float(step[1]), 0.0])
        framed.append(replace(placement, scale=placement.scale * ratio, shift=shift))
    return framed


def _area_and_center(mask: Float[Tensor, "s s 1"]) -> tuple[Float[Tensor, ""], Float[Tensor, " 2"]]:
    """Return area and center (column, row) of a mask, in pixels."""
    weights = mask[..., 0]
    area = weights.sum()
    places = torch.arange(len(weights)) + 0.5
    center = torch.stack([(weights.sum(0) * places).sum(), (weights.sum(1) * places).sum()]) / area.clamp(min=1e-3)
    return area, center


def _refine(
    cloud: Gaussians, start: Placement, subject: Float[Tensor, "h w 4"], rasterize: Rasterizer, turning: bool
) -> Placement:
    """Refine azimuth, scale and position by gradients; the distance to the camera stays."""
    target, mask = resize_cutouts(subject[None], FINE_SIZE)
    camera = OrbitCamera(width=FINE_SIZE, height=FINE_SIZE)
    values = {name: torch.zeros(size, requires_grad=True) for name, size in (("turn", 1), ("grow", 1), ("move", 2))}
    rates = {"turn": 0.03 if turning else 0.0, "grow": 0.01, "move": 0.006}
    adam = Adam(({"params": value, "lr": rates[name]} for name, value in values.items()), betas=(0.9, 0.98))
    area = mask.mean().clamp(min=1e-3)
    cloud = replace(cloud, opacity_logits=antialiased(start.apply(cloud), camera).opacity_logits)
    for _ in range(ITERATIONS):
        quat, log_scale, shift = _similarity_of(start, values)
        rendering = rasterize(_similar(cloud, quat, log_scale, shift), [camera], torch.tensor(WHITE))
        color, alpha = (rendering.color - target).movedim(-1, 1), (rendering.alpha - mask).movedim(-1, 1)
        loss = torch.stack(
            [
                (functional.avg_pool2d(part, level).square().mean() * weight)
                for level in (1, 4, 8)
                for part, weight in ((color, 1.0), (alpha, 2.0))
            ]
        ).sum()
        adam.zero_grad()
        (loss / area).backward()
        adam.step()
    with torch.no_grad():
        quat, log_scale, shift = _similarity_of(start, values)
    azimuth = (start.azimuth_deg - math.degrees(float(values["turn"].detach()))) % 360
    unit = functional.normalize(quat.detach(), dim=-1)
    return Placement(unit, float(log_scale.exp()), shift.detach(), azimuth)


def _similarity_of(
    start: Placement, values: dict[str, Tensor]
) -> tuple[Float[Tensor, " 4"], Float[Tensor, ""], Float[Tensor, " 3"]]:
    half = values["turn"][0] / 2
    zero = torch.zeros(())
    turn = torch.stack([half.cos(), zero, half.sin(), zero])
    log_scale = math.log(start.scale) + values["grow"][0]
    center = quat_to_rotmat(turn) @ start.shift * values["grow"][0].exp()
    return quat_multiply(turn, start.quat), log_scale, center + torch.cat([values["move"], zero[None]])


def _similar(
    cloud: Gaussians, quat: Float[Tensor, " 4"], log_scale: Float[Tensor, ""], shift: Float[Tensor, " 3"]
) -> Gaussians:
    """Return a cloud under a similarity, differentiable."""
    return replace(
        cloud,
        means=log_scale.exp() * (cloud.means @ quat_to_rotmat(quat).T) + shift,
        log_scales=cloud.log_scales + log_scale,
        quats=quat_multiply(quat.expand_as(cloud.quats), cloud.quats),
    )


def _turn(azimuth_deg: float) -> Float[Tensor, " 4"]:
    """Return the rotation about the vertical that moves azimuth 0 to an azimuth."""
    half = math.radians(azimuth_deg) / 2
    return torch.tensor([math.cos(half), 0.0, math.sin(half), 0.0])
