"""Losses and validation figures of the shape prior."""

from dataclasses import dataclass
from statistics import mean

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from dg4d_lib.errors import FitDiverged
from dg4d_lib.shape_prior.frustum import KNOTS
from dg4d_lib.shape_prior.network import ShapePriorNetwork, not_finite
from training.shape_prior.batches import Batch

COLOR_WEIGHT = 0.1
MOMENT_WEIGHT = 0.1
POINT_WEIGHT = 0.5
SYMMETRY_WEIGHT = 0.02
LOWER_LR = "the last checkpoint stays as it is; begin another run with a lower --lr in another folder"


@dataclass(frozen=True)
class Losses:
    """Terms of the training loss, each a scalar before its weight."""

    occupancy: Float[Tensor, ""]
    color: Float[Tensor, ""]
    moment: Float[Tensor, ""]
    point: Float[Tensor, ""]
    symmetry: Float[Tensor, ""]

    def total(self) -> Float[Tensor, ""]:
        """Return the weighted sum."""
        mirror = MOMENT_WEIGHT * self.moment + POINT_WEIGHT * self.point + SYMMETRY_WEIGHT * self.symmetry
        return self.occupancy + COLOR_WEIGHT * self.color + mirror


def training_losses(network: ShapePriorNetwork, batch: Batch) -> Losses:
    """Return the losses of a batch."""
    features = network.encode(batch.picture.float() / 255)
    logits, knots, scale = network.rays(network.decode(features), features.picture, batch.pixels)
    color_error = (color_at(knots[batch.ray], batch.depth) - batch.color.float() / 255).abs().mean(-1)
    spread = scale[batch.ray, 0]
    moment, point, symmetric = network.mirror(features.code)
    known = (batch.plane[:, :3].abs().amax(1) > 0).float()
    share = 1 / known.sum().clamp(min=1)
    normal, nearest = batch.plane[:, :3], batch.plane[:, :3] * batch.plane[:, 3:]
    truth = normal[:, :, None] * normal[:, None]
    return Losses(
        occupancy=functional.binary_cross_entropy_with_logits(logits, batch.occupancy.float() / 255),
        color=(color_error / spread + spread.log()).mean(),
        moment=share * (known[:, None, None] * (moment - truth).square()).sum(),
        point=share * (known[:, None] * (point - nearest).square()).sum(),
        symmetry=functional.binary_cross_entropy_with_logits(symmetric, batch.symmetric),
    )


def color_at(knots: Float[Tensor, "m k 3"], depth: Float[Tensor, " m"]) -> Float[Tensor, "m 3"]:
    """Return the colors at depths from 0 to 1, linear between the knots."""
    place = depth.clamp(0, 1) * (KNOTS - 1)
    low = place.floor().clamp(max=KNOTS - 2)
    share = (place - low)[:, None]
    index = low.long()[:, None, None].expand(-1, 1, 3)
    return (knots.gather(1, index) * (1 - share[:, None]) + knots.gather(1, index + 1) * share[:, None])[:, 0]


@torch.no_grad()
def validation_figures(network: ShapePriorNetwork, held_out: list[Batch]) -> dict[str, float]:
    """Return figures on held-out batches.

    Returns:
        Occupancy loss; intersection over union of matter, mean over samples and per family; mean absolute error of
        hidden colors; mean angle between mirror planes in degrees. Without batches, nothing.

    Raises:
        FitDiverged: the network's output is not finite.
    """
    families: list[str] = []
    losses, overlaps, color, angles = [], [], [], []
    for batch in held_out:
        features = network.encode(batch.picture.float() / 255)
        logits, knots, _ = network.rays(network.decode(features), features.picture, batch.pixels)
        truth = batch.occupancy.float() / 255
        losses.append(functional.binary_cross_entropy_with_logits(logits, truth).item())
        owner = batch.pixels // batch.picture[0, 0].numel()
        overlaps += _overlaps(logits > 0, truth > 0.5, owner, len(batch.picture))
        families += batch.families
        color.append((color_at(knots[batch.ray], batch.depth) - batch.color.float() / 255).abs().mean().item())
        moment, _, _ = network.mirror(features.code)
        if broken := not_finite({"occupancy": logits, "colors": knots, "mirror plane": moment}):
            raise FitDiverged(f"the {broken[0]} that the network gives for a held-out sample is not finite; {LOWER_LR}")
        normal = torch.linalg.eigh(moment.double())[1][:, :, -1]
        known = batch.plane[:, :3].abs().amax(1) > 0
        cosine = (normal * batch.plane[:, :3]).sum(1)[known].abs().clamp(max=1)
        angles += cosine.acos().rad2deg().tolist()
    found = {"bce": losses, "iou": overlaps, "color": color, "plane_deg": angles}
    figures = {name: mean(values) for name, values in found.items() if values}
    for family in sorted(set(families)):
        mine = [overlap for overlap, name in zip(overlaps, families, strict=True) if name == family]
        figures[f"iou_{family}"] = mean(mine)
    return figures


def _overlaps(found: Tensor, truth: Tensor, owner: Tensor, count: int) -> list[float]:
    none = torch.zeros(count, device=found.device)
    both = none.index_add(0, owner, (found & truth).float().sum(1))
    either = none.index_add(0, owner, (found | truth).float().sum(1))
    return [float(value) for value in (both / either.clamp(min=1)).tolist()]
