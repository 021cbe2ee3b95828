"""The `motion` artifact: a fitted deformation in safetensors, with what is needed to build it again."""

import json
from collections.abc import Mapping
from pathlib import Path

import torch
from pydantic import TypeAdapter
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from dg4d_lib.deformation.framewise import Framewise
from dg4d_lib.deformation.hexplane import HexPlane
from dg4d_lib.deformation.interface import Deformation
from dg4d_lib.deformation.mlp import Mlp
from dg4d_lib.errors import BadInput
from dg4d_lib.fitting.motion import bounds_of
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.settings import DeformationSettings, FramewiseSettings, HexPlaneSettings, MlpSettings


def new_deformation(
    settings: DeformationSettings, gaussians: Gaussians, frames: int, generator: torch.Generator | None
) -> HexPlane | Mlp | Framewise:
    """A deformation of this kind, the identity at the start."""
    match settings:
        case HexPlaneSettings():
            return HexPlane(settings, bounds_of(gaussians), generator)
        case MlpSettings():
            return Mlp(settings, bounds_of(gaussians), generator)
        case FramewiseSettings():
            return Framewise(frames, len(gaussians))


def write_motion(path: Path, deformation: nn.Module, settings: DeformationSettings, frames: int, count: int) -> None:
    """Write a deformation of `count` Gaussians over `frames` frames."""
    tensors = {name: value.detach().contiguous() for name, value in sorted(deformation.state_dict().items())}
    about = {"settings": settings.model_dump(mode="json"), "frames": frames, "gaussians": count}
    path.write_bytes(save(tensors, {"motion": json.dumps(about, sort_keys=True)}))


def read_motion(path: Path) -> tuple[Deformation, int]:
    """The deformation, and the number of frames of the video it was fitted to.

    Raises:
        BadInput: the file is no motion.
    """
    try:
        with safe_open(path, "pt") as file:
            about = json.loads((file.metadata() or {})["motion"])
            tensors: Mapping[str, Tensor] = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no dict)
    except (SafetensorError, KeyError) as error:
        raise BadInput(f"{path.name} is no motion ({error}); give the `motion` output of fit_motion") from error
    settings: DeformationSettings = TypeAdapter(DeformationSettings).validate_python(about["settings"])
    deformation: HexPlane | Mlp | Framewise
    match settings:
        case HexPlaneSettings():
            deformation = HexPlane(settings, tensors["bounds"])
        case MlpSettings():
            deformation = Mlp(settings, tensors["bounds"])
        case FramewiseSettings():
            deformation = Framewise(about["frames"], about["gaussians"])
    deformation.load_state_dict(dict(tensors))
    deformation.requires_grad_(False)
    return deformation, about["frames"]
