"""Color as spherical harmonics (Kerbl et al. 2023); this product uses degree 0, a constant color."""

from jaxtyping import Float
from torch import Tensor

C0 = 0.28209479177387814  # the constant basis function, 1 / (2 sqrt(pi))


def color_of_harmonics(harmonics: Float[Tensor, "n k 3"]) -> Float[Tensor, "n 3"]:
    """Colors in [0, 1] of the constant basis: C0 * coefficient + 0.5, clamped."""
    return (C0 * harmonics[:, 0] + 0.5).clamp(0, 1)


def harmonics_of_color(color: Float[Tensor, "n 3"]) -> Float[Tensor, "n 1 3"]:
    """Degree-0 coefficients that give these colors; the inverse of `color_of_harmonics` inside [0, 1]."""
    return ((color - 0.5) / C0)[:, None]
