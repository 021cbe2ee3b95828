"""Volume whose renderings are the expected color and alpha of a predicted shape."""

import torch

from dg4d_lib.shape_prior.field import ShapeField
from dg4d_lib.shape_prior.raymarch import ShapeVolume, make_volume

INDEPENDENCE = 0.15  # share of the cells of a ray that err independently; on made-up shapes 0.1 to 0.2 score the same
OPAQUE = 1.75  # optical depth of the subject seen from the input camera, at least
SEEN, UNSEEN = 0.3, 0.05  # transmittance from the input camera: above it the picture's color, below it the hidden one
LARGEST = 0.995  # probability


def expected_volume(field: ShapeField, contrast: float) -> ShapeVolume:
    """Return density and color, so that absorption along a ray is the probability of meeting matter on it.

    If cells erred independently, the transmittance of a ray would be the product of 1 - p; errors of neighbors are
    alike, so each cell counts for less. Rays of the input camera through the subject are opaque.

    Args:
        field: of one frame.
        contrast: factor on the logits; more is sharper than what is known.
    """
    probability = (contrast * field.logits).sigmoid().clamp(max=LARGEST)
    density = -INDEPENDENCE * torch.log1p(-probability) * field.mask[..., None]
    depth = density.sum(-1, keepdim=True)
    density = density * (OPAQUE / depth.clamp(min=1e-6)).clamp(min=1)
    transmittance = (density - density.cumsum(-1)).exp()
    seen = ((transmittance - UNSEEN) / (SEEN - UNSEEN)).clamp(0, 1)[..., None]
    return make_volume(density, seen * field.front[:, :, None] + (1 - seen) * field.hidden)
