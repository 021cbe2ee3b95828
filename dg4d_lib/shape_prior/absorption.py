"""Absorption along the rays of the input camera by matter that is only probable."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

INDEPENDENCE = 0.15  # share of the cells of a ray that err independently; on synthetic shapes 0.1 to 0.2 score the same
OPAQUE = 1.75  # optical depth of the subject seen from the input camera, at least
LARGEST = 0.995  # probability


def optical_density(
    probability: Float[Tensor, "128 128 64"], mask: Bool[Tensor, "128 128"]
) -> Float[Tensor, "128 128 64"]:
    """Return the optical depth of every cell: absorption along a ray is the probability of meeting matter on it.

    If cells erred independently, the transmittance of a ray would be the product of 1 - p; errors of neighbors are
    alike, so each cell counts for less. Rays of the input camera through the subject are opaque.

    Args:
        probability: of matter, per cell.
        mask: pixels of the subject.
    """
    density = -INDEPENDENCE * torch.log1p(-probability.clamp(max=LARGEST)) * mask[..., None]
    depth = density.sum(-1, keepdim=True)
    return density * (OPAQUE / depth.clamp(min=1e-6)).clamp(min=1)


def transmittance(density: Float[Tensor, "128 128 64"]) -> Float[Tensor, "128 128 64"]:
    """Return the share of light that reaches the near side of every cell from the input camera."""
    return (density - density.cumsum(-1)).exp()
