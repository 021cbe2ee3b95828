"""Cloud of 3D Gaussians (Kerbl et al. 2023)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dg4d_lib.devices import to_device_async
from dg4d_lib.geometry.quaternion import quat_to_rotmat
from dg4d_lib.geometry.spherical_harmonics import sh_to_rgb


@dataclass(frozen=True)
class Gaussians:
    """Raw parameters as fields, activated quantities as properties.

    `means`, `log_scales` and `quats` may have a leading batch axis, one state of the cloud per frame or view; opacity
    and color have none, because the deformation does not change them (paper section 3.2).

    Attributes:
        means: world units.
        log_scales: natural logarithm of the standard deviations along the Gaussian's own axes.
        quats: wxyz, any norm from 1e-10 to 1e18.
        opacity_logits: logit of the opacity at the center.
        harmonics: spherical-harmonics coefficients of the color, degree 0 first.
    """

    means: Float[Tensor, "*b n 3"]
    log_scales: Float[Tensor, "*b n 3"]
    quats: Float[Tensor, "*b n 4"]
    opacity_logits: Float[Tensor, " n"]
    harmonics: Float[Tensor, "n k 3"]

    def __len__(self) -> int:
        return self.opacity_logits.shape[0]

    @property
    def scales(self) -> Float[Tensor, "*b n 3"]:
        """Standard deviations, world units."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Float[Tensor, " n"]:
        """Opacity at the center, in (0, 1)."""
        return self.opacity_logits.sigmoid()

    @property
    def colors(self) -> Float[Tensor, "n 3"]:
        """Colors in [0, 1]."""
        return sh_to_rgb(self.harmonics)

    @property
    def covariances(self) -> Float[Tensor, "*b n 3 3"]:
        """R S S^T R^T, world units squared."""
        half = quat_to_rotmat(self.quats) * self.scales[..., None, :]
        return half @ half.mT

    def detach(self) -> "Gaussians":
        """Return the cloud detached from the autograd graph."""
        return Gaussians(**{name: value.detach() for name, value in vars(self).items()})

    def to(self, target: torch.dtype | torch.device) -> "Gaussians":
        """Return the cloud in another precision or on another device."""
        return Gaussians(**{name: value.to(target) for name, value in vars(self).items()})

    def states(self, rows: Sequence[int] | Int[Tensor, " m"]) -> "Gaussians":
        """Return these states of a batch in this order; the cloud itself if they are all states in their order."""
        selected = torch.as_tensor(rows, dtype=torch.long)
        if selected.tolist() == list(range(len(self.means))):
            return self
        selected = to_device_async(selected, self.means.device)
        return replace(
            self, means=self.means[selected], log_scales=self.log_scales[selected], quats=self.quats[selected]
        )

    def subset(self, rows: slice | Int[Tensor, " m"] | Bool[Tensor, " n"]) -> "Gaussians":
        """Return some Gaussians of a cloud of one state."""
        return Gaussians(**{name: value[rows] for name, value in vars(self).items()})

    def at(self, frame: int) -> "Gaussians":
        """Return one state of a batch."""
        return Gaussians(
            self.means[frame], self.log_scales[frame], self.quats[frame], self.opacity_logits, self.harmonics
        )
