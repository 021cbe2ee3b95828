"""Step that draws a picture from a prompt with a text-to-image pipeline."""

import torch

from dg4d_lib.diffusion.components import default_device
from dg4d_lib.diffusion.text_to_image import draw_picture
from dg4d_lib.errors import BadInput
from dg4d_lib.input_settings import TextSettings
from steps.artifacts.media import write_png
from steps.runtime.job import Job, StepReport
from steps.runtime.weights import open_weights


def run(job: Job) -> StepReport:
    """Draw the prompt in `text`.

    Raises:
        BadInput: no pipeline is set, or it is no text-to-image pipeline.
        BackendUnavailable: its weights or libraries are not installed.
    """
    settings: TextSettings = job.settings.text
    if not settings.weights:
        raise BadInput("no text-to-image pipeline was named: --set text.weights=FOLDER, or an id of the hub")
    prompt = job.inputs["text"].read_text(encoding="utf-8")
    opened = open_weights(settings.weights)
    device, generator = default_device(), torch.Generator().manual_seed(job.seed)
    picture = draw_picture(
        opened.folder, prompt, settings, generator, device, lambda done, total: job.progress(done, total, {})
    )
    write_png(job.outputs["picture"], picture)
    note = f"The picture was drawn by a model ({settings.weights}) from the words: {prompt}{settings.suffix}"
    return StepReport(f"{device.type} (diffusers)", opened.digests, opened.licenses, notes=(note,))
