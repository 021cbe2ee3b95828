"""Adaptive density control (Kerbl et al. 2023, section 5; thresholds of DreamGaussianHD)."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.quaternion import quat_to_rotmat

SPLIT_INTO = 2  # Gaussians per split (3DGS)
SPLIT_SHRINK = 1.6  # divisor of the scales of split Gaussians (3DGS)


@dataclass
class Grad2dStats:
    """Running mean of screen-space gradient norms (grad2d, NDC) over the views in which a Gaussian is visible.

    Attributes:
        grad2d: sum of gradient norms.
        count: number of views in which each Gaussian was visible.
    """

    grad2d: Float[Tensor, " n"]
    count: Float[Tensor, " n"]

    @staticmethod
    def zeros(count: int, device: torch.device | None = None) -> "Grad2dStats":
        """Return statistics before the first view."""
        return Grad2dStats(torch.zeros(count, device=device), torch.zeros(count, device=device))

    def add(self, pixel_gradients: Float[Tensor, "b n 2"], visible: Bool[Tensor, "b n"], size: int) -> None:
        """Add the views of one rendering; size / 2 converts gradients from pixels to NDC."""
        self.grad2d += (pixel_gradients.norm(dim=-1) * (size / 2) * visible).sum(0)
        self.count += visible.sum(0)

    @property
    def mean(self) -> Float[Tensor, " n"]:
        """Mean norm per Gaussian; zero if it was never visible."""
        return self.grad2d / self.count.clamp(min=1)


@dataclass(frozen=True)
class DensifyResult:
    """Cloud after density control, and the origin of each of its Gaussians.

    Attributes:
        gaussians: the new cloud.
        source: index into the old cloud.
        is_new: true for cloned and split Gaussians, whose optimizer state starts at zero.
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
    """Clone small Gaussians and split large ones where the screen-space gradient is large.

    Args:
        gaussians: the cloud.
        grad2d: mean screen-space gradient norm, NDC.
        min_grad2d: threshold of densification.
        max_scale: world units; larger Gaussians are split in two, smaller ones cloned.
        room: number of Gaussians that may be added; those with the largest gradients come first.
        generator: draws the positions of split Gaussians.
    """
    selected = grad2d >= min_grad2d
    if int(selected.sum()) > room:
        strongest = torch.zeros_like(selected)
        strongest[grad2d.argsort(descending=True, stable=True)[: max(room, 0)]] = True
        selected &= strongest
    large = gaussians.scales.amax(-1) > max_scale
    indices = torch.arange(len(gaussians), device=grad2d.device)
    kept, cloned, split = indices[~(selected & large)], indices[selected & ~large], indices[selected & large]
    halves = split.repeat(SPLIT_INTO)
    source = torch.cat([kept, cloned, halves])
    is_new = torch.arange(len(source), device=grad2d.device) >= len(kept)
    means, log_scales = gaussians.means[source].clone(), gaussians.log_scales[source].clone()
    if len(halves):
        local = torch.randn(len(halves), 3, generator=generator).to(means) * gaussians.scales[halves]
        means[-len(halves) :] += (quat_to_rotmat(gaussians.quats[halves]) @ local[..., None])[..., 0]
        log_scales[-len(halves) :] -= math.log(SPLIT_SHRINK)
    grown = Gaussians(
        means, log_scales, gaussians.quats[source], gaussians.opacity_logits[source], gaussians.harmonics[source]
    )
    return DensifyResult(grown, source, is_new)


def prune(gaussians: Gaussians, min_opacity: float, max_scale: float) -> DensifyResult:
    """Remove Gaussians with a low opacity or a large scale."""
    source = ((gaussians.opacities >= min_opacity) & (gaussians.scales.amax(-1) <= max_scale)).nonzero()[:, 0]
    kept = gaussians.subset(source)
    return DensifyResult(kept, source, torch.zeros_like(source, dtype=torch.bool))


def reset_opacity(gaussians: Gaussians, ceiling: float = 0.01) -> Gaussians:
    """Clamp opacities to `ceiling`, so that Gaussians that do not regain opacity are pruned (3DGS)."""
    logit = torch.logit(torch.tensor(ceiling))
    return Gaussians(**{**vars(gaussians), "opacity_logits": gaussians.opacity_logits.clamp(max=float(logit))})
