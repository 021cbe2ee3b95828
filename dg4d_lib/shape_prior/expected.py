"""Volume whose renderings are the expected color and alpha of a predicted shape."""

from dg4d_lib.shape_prior.absorption import optical_density, transmittance
from dg4d_lib.shape_prior.decided import decide
from dg4d_lib.shape_prior.field import ShapeField
from dg4d_lib.shape_prior.raymarch import ShapeVolume, make_volume

SEEN, UNSEEN = 0.3, 0.05  # transmittance from the input camera: above it the picture's color, below it the hidden one


def expected_volume(field: ShapeField, contrast: float) -> ShapeVolume:
    """Return density and color, so that absorption along a ray is the probability of meeting matter on it.

    Args:
        field: of one frame.
        contrast: of the probabilities, see `decide`; more than 1 is sharper than what is known.
    """
    density = optical_density(decide(field.logits, field.mask, contrast, field.generosity).sigmoid(), field.mask)
    seen = ((transmittance(density) - UNSEEN) / (SEEN - UNSEEN)).clamp(0, 1)[..., None]
    return make_volume(density, seen * field.front[:, :, None] + (1 - seen) * field.hidden)
