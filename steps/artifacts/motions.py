"""The `motion` artifact: a fitted deformation in safetensors, with what is needed to build it again."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from pydantic import TypeAdapter
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from dg4d_lib.deformation import factory
from dg4d_lib.deformation.factory import AnyDeformation, deformation_tensors, from_state_dict
from dg4d_lib.deformation.interface import Deformation
from dg4d_lib.errors import BadInput
from dg4d_lib.fitting.motion import bounds_of
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.settings import DeformationSettings


def new_deformation(
    settings: DeformationSettings, gaussians: Gaussians, frames: int, generator: torch.Generator | None
) -> AnyDeformation:
    """A deformation of this kind for these Gaussians, the identity at the start."""
    return factory.new_deformation(settings, bounds_of(gaussians), frames, len(gaussians), generator)


def write_motion(
    path: Path, deformation: AnyDeformation, settings: DeformationSettings, frames: int, count: int
) -> None:
    """Write a deformation of `count` Gaussians over `frames` frames."""
    about = {"settings": settings.model_dump(mode="json"), "frames": frames, "gaussians": count}
    path.write_bytes(save(deformation_tensors(deformation), {"motion": json.dumps(about, sort_keys=True)}))


@dataclass(frozen=True)
class Fit:
    """A fitted motion.

    Attributes:
        deformation: without gradients.
        settings: its kind and sizes.
        frames: of the video it was fitted to.
    """

    deformation: AnyDeformation
    settings: DeformationSettings
    frames: int


def read_motion(path: Path) -> tuple[Deformation, int]:
    """The deformation, and the number of frames of the video it was fitted to; raises as `read_fit` does."""
    fit = read_fit(path)
    return fit.deformation, fit.frames


def read_fit(path: Path) -> Fit:
    """Read what `write_motion` wrote.

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
    return Fit(from_state_dict(settings, tensors, about["frames"], about["gaussians"]), settings, about["frames"])
