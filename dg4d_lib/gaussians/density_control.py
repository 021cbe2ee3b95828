"""Adaptive density control (Kerbl et al. 2023, section 5; thresholds of DreamGaussianHD)."""

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
class Grad2dStats:
    """Gradients of the loss with respect to projected centers, in NDC, averaged over the views that saw them.

    Attributes:
        total: sum of the gradients' norms.
        views: number of views that saw each Gaussian.
    """

    total: Float[Tensor, " n"]
    views: Float[Tensor, " n"]

    @staticmethod
    def zeros(count: int, device: torch.device | None = None) -> "Grad2dStats":
        """Return gradients before the first view."""
        return Grad2dStats(torch.zeros(count, device=device), torch.zeros(count, device=device))

    def add(self, pixel_gradients: Float[Tensor, "b n 2"], visible: Bool[Tensor, "b n"], size: int) -> None:
        """Add the views of one rendering; half the size converts gradients per pixel to NDC."""
        self.total += (pixel_gradients.norm(dim=-1) * (size / 2) * visible).sum(0)
        self.views += visible.sum(0)

    @property
    def mean(self) -> Float[Tensor, " n"]:
        """Mean norm per Gaussian; zero where no view saw it."""
        return self.total / self.views.clamp(min=1)


@dataclass(frozen=True)
class DensifyResult:
    """A changed cloud, and the origin of each of its Gaussians.

    Attributes:
        gaussians: the cloud.
        source: index into the old cloud.
        is_new: true for Gaussians that the optimizer starts without momentum.
    """

    gaussians: Gaussians
    source: Int[Tensor, " m"]
    is_new: Bool[Tensor, " m"]


def densify(
    gaussians: Gaussians,
    grad2d: Float[Tensor, " n"],
    min_grad2d: float,
    max_scale: float,
    room: int,
    generator: torch.Generator,
) -> DensifyResult:
    """Clone small Gaussians and split large ones where the gradient is large.

    Args:
        gaussians: the cloud.
        grad2d: mean screen gradient, NDC.
        min_grad2d: threshold for growth.
        max_scale: world units; larger Gaussians are split in two, smaller ones cloned.
        room: number of Gaussians that may be added; the largest gradients go first.
        generator: of the positions of split halves.
    """
    wanted = grad2d >= min_grad2d
    if int(wanted.sum()) > room:
        strongest = torch.zeros_like(wanted)
        strongest[grad2d.argsort(descending=True, stable=True)[: max(room, 0)]] = True
        wanted &= strongest
    large = gaussians.scales.amax(-1) > max_scale
    everything = torch.arange(len(gaussians), device=grad2d.device)
    kept, cloned, split = everything[~(wanted & large)], everything[wanted & ~large], everything[wanted & large]
    halves = split.repeat(SPLIT_INTO)
    source = torch.cat([kept, cloned, halves])
    is_new = torch.arange(len(source), device=grad2d.device) >= len(kept)
    means, log_scales = gaussians.means[source].clone(), gaussians.log_scales[source].clone()
    if len(halves):
        local = torch.randn(len(halves), 3, generator=generator).to(means) * gaussians.scales[halves]
        means[-len(halves) :] += (rotation_matrix(gaussians.quats[halves]) @ local[..., None])[..., 0]
        log_scales[-len(halves) :] -= math.log(SPLIT_SHRINK)
    grown = Gaussians(
        means, log_scales, gaussians.quats[source], gaussians.opacity_logits[source], gaussians.harmonics[source]
    )
    return DensifyResult(grown, source, is_new)


def prune(gaussians: Gaussians, min_opacity: float, max_scale: float) -> DensifyResult:
    """Remove Gaussians that are almost transparent or too large."""
    source = ((gaussians.opacities >= min_opacity) & (gaussians.scales.amax(-1) <= max_scale)).nonzero()[:, 0]
    kept = Gaussians(**{name: value[source] for name, value in vars(gaussians).items()})
    return DensifyResult(kept, source, torch.zeros_like(source, dtype=torch.bool))


def reset_opacity(gaussians: Gaussians, ceiling: float = 0.01) -> Gaussians:
    """Clamp opacities to `ceiling`, so that unneeded Gaussians stay transparent and are pruned."""
    logit = torch.logit(torch.tensor(ceiling))
    return Gaussians(**{**vars(gaussians), "opacity_logits": gaussians.opacity_logits.clamp(max=float(logit))})
