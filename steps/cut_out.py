"""Step that cuts the subject out of the first frame of a source at low resolution, for inspection and correction."""

import json
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.input_settings import SubjectSettings
from dg4d_lib.video.framing import downscale
from dg4d_lib.video.subject import prepare_subject
from steps.artifacts.media import write_png
from steps.runtime.job import Job, StepReport
from steps.sources.masks import scaled_box
from steps.sources.networks import open_network
from steps.sources.reader import Source, read_source

LONGEST = 768  # pixels of the longer side; `prepare_subject` estimates at up to twice `subject.size`
FEWEST_FRAMES = 2  # least number of frames that the video reader keeps


def run(job: Job) -> StepReport:
    """Write the first frame, its matte in the same pixels, and facts about the source.

    A subject that cannot be found gives an empty matte and a sentence: the user may draw the matte.

    Raises:
        BadInput: the file cannot be read, or the box lies outside of it.
    """
    settings: SubjectSettings = job.settings.subject
    with TemporaryDirectory() as scratch:
        source = read_source(job.inputs["source"], Path(scratch), FEWEST_FRAMES, settings.max_decode_gb)
    boxed = settings.model_copy(update={"box": scaled_box(settings.box, source)})
    alpha, notes, problem = _matte(source, boxed)
    picture, small_alpha = downscale(source.frames[:1], LONGEST)[0], alpha
    if alpha.shape != picture.shape[:2]:
        spread = alpha[None, ..., None].expand(-1, -1, -1, 4)
        small_alpha = downscale(spread, LONGEST)[0, ..., 3]
    write_png(job.outputs["picture"], picture)
    write_png(job.outputs["matte"], small_alpha[..., None])
    facts = {
        "width": source.size[0],
        "height": source.size[1],
        "kind": source.kind,
        "frames": source.count,
        "has_alpha": source.has_alpha,
        "notes": list(notes),
        "problem": problem,
    }
    job.outputs["facts"].write_text(json.dumps(facts), encoding="utf-8")
    return StepReport(notes=notes)


def _matte(source: Source, settings: SubjectSettings) -> tuple[Float[Tensor, "h w"], tuple[str, ...], str]:
    """Return the alpha of the first frame, notes about it, and the reason if there is none."""
    frames = source.frames[:1]
    network = open_network(settings.matting)
    try:
        prepared = prepare_subject(frames, source.has_alpha, settings, None, network.segmenter)
    except BadInput as error:
        return torch.zeros(frames.shape[1:3]), (), str(error)
    if prepared.estimate is not None:
        return prepared.estimate.frames[0, ..., 3], prepared.notes, ""
    alpha = frames[0, ..., 3]
    if settings.box:
        x, y, width, height = settings.box
        inside = torch.zeros_like(alpha)
        inside[y : y + height, x : x + width] = alpha[y : y + height, x : x + width]
        alpha = inside
    return alpha, prepared.notes, ""
