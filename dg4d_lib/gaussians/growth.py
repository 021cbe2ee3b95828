"""Density control: where the picture asks for more Gaussians there will be more, where nothing is seen fewer.

Functions on values (Kerbl et al. 2023, section 5; thresholds of DreamGaussianHD).
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.quaternion import rotation_matrix

SPLIT_INTO = 2
SPLIT_SHRINK = 1.6


@dataclass
class ScreenGradients:
    """How much the loss pulls at the projected centers, in NDC units, averaged over the views that saw them.

    Attributes:
        total: sum of the gradients' norms.
        views: how many views saw each Gaussian.
    """

    total: Float[Tensor, " n"]
    views: Float[Tensor, " n"]

    @staticmethod
    def none(count: int, device: torch.device | None = None) -> "ScreenGradients":
        """Nothing seen yet."""
        return ScreenGradients(torch.zeros(count, device=device), torch.zeros(count, device=device))

    def add(self, pixel_gradients: Float[Tensor, "b n 2"], visible: Bool[Tensor, "b n"], size: int) -> None:
        """Gather the views of one rendering; gradients per pixel become per NDC by half the size."""
        self.total += (pixel_gradients.norm(dim=-1) * (size / 2) * visible).sum(0)
        self.views += visible.sum(0)

    @property
    def mean(self) -> Float[Tensor, " n"]:
        """Zero where no view saw the Gaussian."""
        return self.total / self.views.clamp(min=1)


@dataclass(frozen=True)
class DensifyResult:
    """A changed cloud, and where each of its Gaussians comes from.

    Attributes:
        gaussians: the cloud.
        source: index into the old cloud.
        fresh: whether it is new, so that the optimizer starts it without momentum.
    """

    gaussians: Gaussians
    source: Int[Tensor, " m"]
    fresh: Bool[Tensor, " m"]


def densify(
    gaussians: Gaussians,
    pull: Float[Tensor, " n"],
    min_pull: float,
    max_scale: float,
    room: int,
    generator: torch.Generator,
) -> DensifyResult:
    """Clone small Gaussians and split large ones where the pull is strong.

    Args:
        gaussians: the cloud.
        pull: mean screen gradient, NDC.
        min_pull: below it nothing grows.
        max_scale: world units; larger Gaussians are split in two, smaller ones cloned.
        room: how many may be added; the strongest pulls go first.
        generator: where the halves of a split land.
    """
    wanted = pull >= min_pull
    if int(wanted.sum()) > room:
        strongest = torch.zeros_like(wanted)
        strongest[pull.argsort(descending=True, stable=True)[: max(room, 0)]] = True
        wanted &= strongest
    large = gaussians.scales.amax(-1) > max_scale
    everything = torch.arange(len(gaussians), device=pull.device)
    kept, cloned, split = everything[~(wanted & large)], everything[wanted & ~large], everything[wanted & large]
    halves = split.repeat(SPLIT_INTO)
    source = torch.cat([kept, cloned, halves])
    fresh = torch.arange(len(source), device=pull.device) >= len(kept)
    means, log_scales = gaussians.means[source].clone(), gaussians.log_scales[source].clone()
    if len(halves):
        local = torch.randn(len(halves), 3, generator=generator).to(means) * gaussians.scales[halves]
        means[-len(halves) :] += (rotation_matrix(gaussians.quats[halves]) @ local[..., None])[..., 0]
        log_scales[-len(halves) :] -= math.log(SPLIT_SHRINK)
    grown = Gaussians(
        means, log_scales, gaussians.quats[source], gaussians.opacity_logits[source], gaussians.harmonics[source]
    )
    return DensifyResult(grown, source, fresh)


def prune(gaussians: Gaussians, min_opacity: float, max_scale: float) -> DensifyResult:
    """Remove what is almost invisible or too large."""
    source = ((gaussians.opacities >= min_opacity) & (gaussians.scales.amax(-1) <= max_scale)).nonzero()[:, 0]
    kept = Gaussians(**{name: value[source] for name, value in vars(gaussians).items()})
    return DensifyResult(kept, source, torch.zeros_like(source, dtype=torch.bool))


def reset_opacity(gaussians: Gaussians, ceiling: float = 0.01) -> Gaussians:
    """No opacity above `ceiling`: what is needed comes back, what is not can be pruned."""
    logit = torch.logit(torch.tensor(ceiling))
    return Gaussians(**{**vars(gaussians), "opacity_logits": gaussians.opacity_logits.clamp(max=float(logit))})
