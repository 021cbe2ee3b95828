"""Factory of deformation models: from settings, from a state dict, or for fewer Gaussians."""

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from dg4d_lib.deformation.framewise import Framewise
from dg4d_lib.deformation.hexplane import HexPlane
from dg4d_lib.deformation.mlp import Mlp
from dg4d_lib.deformation.on_parts import AnyField, OnParts
from dg4d_lib.settings import DeformationSettings, FramewiseSettings, HexPlaneSettings, MlpSettings

AnyDeformation = HexPlane | Mlp | Framewise | OnParts
FIELD = "field."  # before the names of the tensors of a field on parts


def new_deformation(
    settings: DeformationSettings,
    bounds: Float[Tensor, "2 3"],
    frames: int,
    count: int,
    generator: torch.Generator | None = None,
) -> AnyField:
    """Create a deformation; the identity, unless its settings start it elsewhere.

    Args:
        settings: kind and sizes.
        bounds: lower and upper corner of the box that the model covers, unless the settings have a box of their own.
        frames: number of frames of the video.
        count: number of Gaussians.
        generator: initializes planes, layers and scattered displacements.
    """
    match settings:
        case HexPlaneSettings():
            cube = torch.tensor([[-settings.half_side] * 3, [settings.half_side] * 3])
            return HexPlane(settings, cube if settings.half_side else bounds, generator, last_time(settings, frames))
        case MlpSettings():
            return Mlp(settings, bounds, generator, last_time(settings, frames))
        case FramewiseSettings():
            radius = float((bounds[1] - bounds[0]).max()) / 2 if settings.start == "scattered" else 0.0
            return Framewise(frames, count, radius, generator)


def deformation_tensors(deformation: AnyDeformation) -> dict[str, Tensor]:
    """Return the tensors of a deformation by name, sorted, contiguous and on the CPU."""
    return {name: value.detach().cpu().contiguous() for name, value in sorted(deformation.state_dict().items())}


def from_state_dict(
    settings: DeformationSettings, tensors: Mapping[str, Tensor], frames: int, count: int
) -> AnyDeformation:
    """Create a frozen deformation from the result of `deformation_tensors`.

    Raises:
        RuntimeError: a tensor is missing, unexpected or of another shape.
        TypeError: likewise, of the parts.
    """
    deformation = new_deformation(settings, torch.zeros(2, 3), frames, count)  # the tensors hold the real bounds
    own = {name.removeprefix(FIELD): value for name, value in tensors.items() if name.startswith(FIELD)}
    deformation.load_state_dict(own or dict(tensors))
    deformation.requires_grad_(False)
    if not own:
        return deformation
    return OnParts(deformation, **{name: value for name, value in tensors.items() if not name.startswith(FIELD)})


def deformation_of_subset(deformation: AnyDeformation, kept: Bool[Tensor, " n"]) -> AnyDeformation:
    """Return the deformation of some of the Gaussians of a deformation."""
    if not isinstance(deformation, OnParts):
        return _field_of_subset(deformation, kept)
    owners, rest, field = deformation.owners[kept], deformation.rest[kept], _field_of_subset(deformation.field, kept)
    return OnParts(field, owners, rest, deformation.centers, deformation.quats, deformation.places)


def _field_of_subset(field: AnyField, kept: Bool[Tensor, " n"]) -> AnyField:
    if not isinstance(field, Framewise):
        return field  # a function of the place
    fewer = Framewise(len(field.table), int(kept.sum()))
    fewer.table = nn.Parameter(field.table.detach()[:, kept], field.table.requires_grad)
    return fewer


def last_time(settings: DeformationSettings, frames: int) -> float:
    """Return the time of the last frame on the deformation's time axis, which ends at 1."""
    open_ended = not isinstance(settings, FramewiseSettings) and not settings.endpoint
    return (frames - 1) / frames if open_ended else 1.0
