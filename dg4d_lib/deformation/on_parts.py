"""Deformation field on top of rigid parts, so that the field stays smooth where a lid opens."""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from dg4d_lib.deformation.framewise import Framewise, interpolated
from dg4d_lib.deformation.hexplane import HexPlane
from dg4d_lib.deformation.interface import Displacement
from dg4d_lib.deformation.mlp import Mlp
from dg4d_lib.errors import BadInput
from dg4d_lib.geometry.quaternion import quat_multiply, quat_to_rotmat, rotate

AnyField = HexPlane | Mlp | Framewise


class OnParts(nn.Module):
    """Displacements of a field, added to those of the rigid part that a Gaussian belongs to.

    Motions of parts are interpolated between frames, rotations along the chord.

    Args:
        field: deformation of the Gaussians at rest; its displacements are not rotated with the parts.
        owners: part of every Gaussian.
        rest: rotations of the Gaussians at rest, wxyz, any norm.
        centers: of the parts at rest, world units.
        quats: rotations of the parts about their centers at every frame, wxyz, unit.
        places: centers of the parts at every frame.

    Raises:
        BadInput: there is no part of the number of an owner.
    """

    owners: Tensor
    rest: Tensor
    centers: Tensor
    quats: Tensor
    places: Tensor

    def __init__(
        self,
        field: AnyField,
        owners: Int[Tensor, " n"],
        rest: Float[Tensor, "n 4"],
        centers: Float[Tensor, "k 3"],
        quats: Float[Tensor, "t k 4"],
        places: Float[Tensor, "t k 3"],
    ) -> None:
        super().__init__()
        if len(owners) and not 0 <= int(owners.min()) <= int(owners.max()) < len(centers):
            raise BadInput(f"Gaussians belong to parts from 0 to {len(centers) - 1}; one belongs to another")
        self.field = field
        flips = torch.where((quats[1:] * quats[:-1]).sum(-1, keepdim=True) < 0, -1.0, 1.0).cumprod(0)
        near = torch.cat([quats[:1], flips * quats[1:]])  # a quaternion and its negative are one rotation
        tensors = {"owners": owners, "rest": rest, "centers": centers, "quats": near, "places": places}
        for name, value in tensors.items():
            self.register_buffer(name, value.detach().clone())

    def displace(self, means: Float[Tensor, "n 3"], times: Float[Tensor, " t"]) -> Displacement:
        """Return the displacements at times in [0, 1]; the means must be of the Gaussians that the parts own.

        Raises:
            BadInput: the number of Gaussians differs.
        """
        if len(means) != len(self.owners):
            raise BadInput(f"this deformation has {len(self.owners)} Gaussians on its parts; given {len(means)}")
        turns = functional.normalize(interpolated(self.quats, times), dim=-1)
        places = interpolated(self.places, times)
        arms = means - self.centers[self.owners]
        moved = rotate(quat_to_rotmat(turns)[:, self.owners], arms) + places[:, self.owners]
        turned = quat_multiply(turns[:, self.owners], self.rest.expand(len(times), -1, -1))
        added = self.field.displace(means, times)
        return Displacement(added.means + moved - means, added.log_scales, added.quats + turned - self.rest)

    def grid_parameters(self) -> list[nn.Parameter]:
        """Return the grid parameters of the field."""
        return self.field.grid_parameters()

    def length_parameters(self) -> list[nn.Parameter]:
        """Return the length parameters of the field."""
        return self.field.length_parameters()

    def regularization_loss(self) -> Float[Tensor, ""]:
        """Return the regularization loss of the field."""
        return self.field.regularization_loss()
