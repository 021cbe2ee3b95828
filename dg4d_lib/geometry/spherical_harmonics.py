"""Colors as spherical harmonics (Kerbl et al. 2023), degree 0 only: one constant color per Gaussian."""

from jaxtyping import Float
from torch import Tensor

C0 = 0.28209479177387814  # constant basis function, 1 / (2 sqrt(pi))


def sh_to_rgb(sh: Float[Tensor, "n k 3"]) -> Float[Tensor, "n 3"]:
    """Convert the degree-0 coefficient to RGB: C0 * coefficient + 0.5, clamped to [0, 1]."""
    return (C0 * sh[:, 0] + 0.5).clamp(0, 1)


def rgb_to_sh(rgb: Float[Tensor, "n 3"]) -> Float[Tensor, "n 1 3"]:
    """Convert RGB to degree-0 coefficients; inverse of `sh_to_rgb` inside [0, 1]."""
    return ((rgb - 0.5) / C0)[:, None]
