"""The `motion` artifact: a fitted deformation in safetensors, with its settings and number of frames."""

import json
from pathlib import Path
from typing import NamedTuple

import torch
from pydantic import TypeAdapter
from safetensors import SafetensorError
from safetensors.torch import save

from dg4d_lib.deformation import factory
from dg4d_lib.deformation.factory import AnyDeformation, deformation_tensors, from_state_dict
from dg4d_lib.deformation.interface import Displacement
from dg4d_lib.deformation.on_parts import AnyField
from dg4d_lib.errors import BadInput
from dg4d_lib.fitting.motion import bounds_of
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.ply import read_ply
from dg4d_lib.settings import DeformationSettings
from steps.artifacts.media import read_tensors


class FittedMotion(NamedTuple):
    """A fitted deformation.

    Attributes:
        deformation: deformation without gradients.
        frames: number of frames of the driving video.
        settings: its kind and sizes.
    """

    deformation: AnyDeformation
    frames: int
    settings: DeformationSettings


def new_deformation(
    settings: DeformationSettings, gaussians: Gaussians, frames: int, generator: torch.Generator | None
) -> AnyField:
    """Make a deformation for these Gaussians that starts as the identity."""
    return factory.new_deformation(settings, bounds_of(gaussians), frames, len(gaussians), generator)


def read_states(gaussians: Path, motion: Path) -> tuple[Gaussians, Displacement]:
    """Return Gaussians at every frame of a motion, and their displacement.

    Raises:
        BadInput: a file is broken.
    """
    reference, fitted = read_ply(gaussians), read_motion(motion)
    with torch.no_grad():
        displacement = fitted.deformation.displace(reference.means, torch.linspace(0, 1, fitted.frames))
    return displacement.apply(reference), displacement


def write_motion(
    path: Path, deformation: AnyDeformation, settings: DeformationSettings, frames: int, count: int
) -> None:
    """Write a deformation of `count` Gaussians over `frames` frames."""
    about = {"settings": settings.model_dump(mode="json"), "frames": frames, "gaussians": count}
    path.write_bytes(save(deformation_tensors(deformation), {"motion": json.dumps(about, sort_keys=True)}))


def read_motion(path: Path) -> FittedMotion:
    """Read a file of `write_motion`.

    Raises:
        BadInput: the file is not a motion.
    """
    try:
        about, tensors = read_tensors(path, "motion")
    except (SafetensorError, KeyError) as error:
        raise BadInput(f"{path.name} is not a motion ({error}); give the `motion` output of fit_motion") from error
    settings: DeformationSettings = TypeAdapter(DeformationSettings).validate_python(about["settings"])
    deformation = from_state_dict(settings, tensors, about["frames"], about["gaussians"])
    return FittedMotion(deformation, about["frames"], settings)
