"""Shapes that meshes take from the shape network."""

import torch

from dg4d_lib.guidance.interface import SubjectShapes
from dg4d_lib.settings import LearnedPriorSettings, MeshSettings
from dg4d_lib.video.driving import DrivingVideo
from steps.fitting.priors import subject_hint, subject_shapes
from steps.runtime.job import Job


def guessed_shapes(job: Job, video: DrivingVideo | None) -> SubjectShapes | None:
    """Return what the shape network says of every frame; None if one mesh over time comes from the Gaussians."""
    settings: MeshSettings = job.settings.mesh
    if settings.source == "gaussians" or video is None or "subject" not in job.inputs:
        return None
    prior = LearnedPriorSettings()
    hint = subject_hint(prior, None, job.inputs.get("depth_field"), job.settings.turn_deg)
    return subject_shapes(prior, list(torch.cat([video.frames, video.alpha], -1)), hint)
