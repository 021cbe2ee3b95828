"""What the subject looks like over time: the user's footage, or a generated motion."""

from pathlib import Path
from shutil import copyfile
from tempfile import TemporaryDirectory

import torch

from dg4d_lib.errors import BadInput
from dg4d_lib.video.warp import Warp
from steps.job import Facts, Job
from steps.media import read_frames, read_png, write_frames
from steps.profiles import DriveVideoSettings


def run(job: Job) -> Facts:
    """Hand the footage through, or let the weights-free generator move the subject.

    Raises:
        BadInput: the footage has fewer than two frames, or another size than the subject.
    """
    settings: DriveVideoSettings = job.settings
    subject = read_png(job.inputs["subject"])
    if "footage" in job.inputs:
        with TemporaryDirectory() as scratch:
            footage = read_frames(job.inputs["footage"], Path(scratch))
        if len(footage) < 2:
            raise BadInput(f"the footage has {len(footage)} frame(s); a driving video needs at least two")
        if footage.frames.shape[1:3] != subject.shape[:2]:
            sizes = [f"{shape[1]} x {shape[0]}" for shape in (footage.frames.shape[1:3], subject.shape[:2])]
            raise BadInput(f"the footage is {sizes[0]} pixels and the subject {sizes[1]}; prepare both together")
        copyfile(job.inputs["footage"], job.outputs["driving_video"])
        return Facts(backend="none: the footage is used as it is")
    generator = Warp(settings.driving, settings.turn_deg)
    video = generator.generate(subject, torch.Generator().manual_seed(job.seed))
    write_frames(job.outputs["driving_video"], video)
    note = f"The motion is made up by a warp of the picture ({settings.driving.motion}), without a learned model."
    return Facts(notes=(note, *generator.notes))
