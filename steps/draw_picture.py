"""Words become a picture, by a text-to-image pipeline that the user names."""

import torch

from dg4d_lib.diffusion.components import default_device
from dg4d_lib.diffusion.text_to_image import draw_picture
from dg4d_lib.errors import BadInput
from dg4d_lib.settings import TextSettings
from steps.artifacts.media import write_png
from steps.runtime.job import Job, StepReport
from steps.runtime.weights import open_weights


def run(job: Job) -> StepReport:
    """Draw the words in `text`.

    Raises:
        BadInput: no pipeline was named, or it cannot draw.
        BackendUnavailable: its weights, or the packages that run it, are not here.
    """
    settings: TextSettings = job.settings.text
    if not settings.weights:
        raise BadInput("no text-to-image pipeline was named: --set text.weights=FOLDER, or an id of the hub")
    words = job.inputs["text"].read_text(encoding="utf-8")
    opened = open_weights(settings.weights)
    device = default_device()
    picture = draw_picture(
        opened.folder,
        words,
        settings,
        torch.Generator().manual_seed(job.seed),
        device,
        lambda done, total: job.progress(done, total, {}),
    )
    write_png(job.outputs["picture"], picture)
    note = f"The picture was drawn by a model ({settings.weights}) from the words: {words}{settings.suffix}"
    return StepReport(
        backend=f"{device.type} (diffusers)", weights=opened.digests, licenses=opened.licenses, notes=(note,)
    )
