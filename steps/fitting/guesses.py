"""Shapes and mirror planes that the shape network predicts, for meshes."""

from pathlib import Path

import torch

from dg4d_lib.guidance.interface import SubjectShapes
from dg4d_lib.settings import LearnedPriorSettings
from dg4d_lib.shape_prior import packaged
from dg4d_lib.shape_prior.field import ShapeFields
from dg4d_lib.shape_prior.mirror import MirrorPlane
from dg4d_lib.video.driving import DrivingVideo
from steps.fitting.priors import subject_hint, subject_shapes


def guessed_shapes(video: DrivingVideo, pose: Path | None, depth: Path | None, turn_deg: float) -> SubjectShapes:
    """Return the shape network's guess for every frame.

    Args:
        video: of the camera at azimuth and elevation 0.
        pose: turn that the footage shows, if there is footage.
        depth: `depth_field` of the user, if there is one.
        turn_deg: turn of the subject that the user gave, degrees; 0: none.
    """
    prior = LearnedPriorSettings()
    hint = subject_hint(prior, pose, depth, turn_deg)
    return subject_shapes(prior, list(torch.cat([video.frames, video.alpha], -1)), hint)


def guessed_mirror(video: DrivingVideo, frame: int) -> MirrorPlane:
    """Return the mirror plane that the shape network sees in a frame."""
    cutout = torch.cat([video.frames[frame], video.alpha[frame]], -1)
    return ShapeFields(packaged.packaged_network(), [cutout]).mirror_plane(0)
