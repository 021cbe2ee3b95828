"""Step that generates views of other sides of the subject, and weights them by their agreement."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.diffusion.components import default_device
from dg4d_lib.diffusion.view_generation import ViewDirection, ViewGenerator, directions_of
from dg4d_lib.errors import BadInput
from dg4d_lib.images import over_white
from dg4d_lib.input_settings import ImageEditViewsSettings, NoViewsSettings, SubjectSettings
from dg4d_lib.video.subject import Segmenter, prepare_subject
from dg4d_lib.visual_hull.adjusting import adjust_exposure
from dg4d_lib.visual_hull.agreement import hull_alpha, smaller
from dg4d_lib.visual_hull.judging import Judgment, better_direction, judge_views, place_views
from dg4d_lib.visual_hull.known import CARVES, KnownView, known_view
from steps.artifacts.media import read_png, write_png
from steps.runtime.job import Job, StepReport
from steps.runtime.weights import license_note, offload_notes, open_weights
from steps.sources.bank_writer import write_bank
from steps.sources.networks import open_network

INPUT = "the input"
FADED = 0.85  # share of white over a view of weight 0 in the picture


def run(job: Job) -> StepReport:
    """Write the bank of generated views with their weights, and a picture of them.

    Raises:
        BadInput: no model is set, the subject cannot be found in any generated picture, or no view agrees with the
            input.
        BackendUnavailable: weights or libraries of the models are not installed.
    """
    if isinstance(job.settings.views, NoViewsSettings):
        raise BadInput("views.kind=none generates no views; use --set views.kind=image_edit, or leave this step out")
    settings: ImageEditViewsSettings = job.settings.views
    subject = read_png(job.inputs["subject"])
    device, directions = default_device(), directions_of(settings)
    opened = [open_weights(name) for name in (settings.weights, settings.lora_weights) if name]
    lora = opened[1].folder if settings.lora_weights else None
    generator = ViewGenerator.load(opened[0].folder, lora, settings, device)
    pictures = generator.generate(
        over_white(subject), directions, job.seed, lambda done, total: job.progress(done, total, {})
    )
    offload = generator.offload
    del generator  # frees memory for the cut-outs
    network = open_network(job.settings.matting)
    views, notes = cut_views(pictures, directions, subject.shape[0], job.settings.matting, network.segmenter)
    front = known_view(subject, name=INPUT)
    kept, judgments, more = weighted_views(front, views, settings.min_weight)
    write_png(job.outputs["picture"], picture_of(front, kept))
    write_png(job.pictures / "views.png", picture_of(front, kept))
    write_bank(job.outputs["known_views"], [kept], job.pictures)
    made = f"{len(kept)} views of other sides were generated ({settings.weights}); they are guesses."
    weights, licenses = dict(network.digests), dict(network.licenses)
    for one in opened:
        weights.update(one.digests)
        licenses.update(one.licenses)
    named = [license_note(name) for name in (settings.weights, settings.lora_weights) if name]
    return StepReport(
        f"{device.type} (diffusers)",
        weights,
        licenses,
        notes=(made, *notes, *more, *judgment_notes(views, judgments), *named),
        run_notes=offload_notes(offload),
    )


def cut_views(
    pictures: Sequence[Float[Tensor, "h w 3"]],
    directions: Sequence[ViewDirection],
    size: int,
    matting: str,
    segmenter: Segmenter,
) -> tuple[list[KnownView], tuple[str, ...]]:
    """Cut the subject out of generated pictures, centered; pictures without a subject are left out with a note.

    Raises:
        BadInput: no picture shows a subject.
    """
    settings = SubjectSettings(size=size, framing="center", matting=matting)
    views: list[KnownView] = []
    failed: list[str] = []
    for picture, direction in zip(pictures, directions, strict=True):
        name = f"generated view at azimuth {direction.azimuth_deg}, elevation {direction.elevation_deg}"
        opaque = torch.cat([picture, torch.ones_like(picture[..., :1])], -1)[None]
        try:
            cutout = prepare_subject(opaque, False, settings, segmenter=segmenter).frames[0]
        except BadInput as error:
            failed.append(f"{name} shows no subject: {error}")
            continue
        views.append(known_view(cutout, direction.azimuth_deg, direction.elevation_deg, name))
    if not views:
        raise BadInput(
            f"no generated picture shows the subject ({failed[0]}); change the seed or views.weights, or use "
            "views.kind=none"
        )
    return views, tuple(failed)


def weighted_views(
    front: KnownView, views: Sequence[KnownView], min_weight: float
) -> tuple[list[KnownView], list[Judgment], tuple[str, ...]]:
    """Place, judge and weight views; return those that are kept, the judgments of all, and notes.

    Raises:
        BadInput: no view agrees with the input.
    """
    placed, mirrored = better_direction(front, place_views(front, views))
    judgments = judge_views(front, placed)
    kept = [
        replace(view, weight=round(one.weight, 3))
        for view, one in zip(placed, judgments, strict=True)
        if one.weight >= max(min_weight, 1e-3)
    ]
    if not kept:
        raise BadInput(
            f"none of the {len(views)} generated views agrees with the input and the others; change the seed or "
            "views.weights, lower views.min_weight, or use views.kind=none"
        )
    notes = (
        ("The generated views have azimuths of the opposite sign; their azimuths were negated.",) if mirrored else ()
    )
    adjusted = adjust_exposure([front, *kept])
    return adjusted[1:], judgments, notes


def judgment_notes(views: Sequence[KnownView], judgments: Sequence[Judgment]) -> tuple[str, ...]:
    """Return a note that names the views of low weight and the reasons."""
    low = [
        f"{view.name} ({one.weight:.2f}: {'outline' if one.outline < one.color else 'colors'})"
        for view, one in zip(views, judgments, strict=True)
        if one.weight < CARVES
    ]
    return (f"generated views that contradict the others have a low weight: {'; '.join(low)}",) if low else ()


def picture_of(front: KnownView, views: Sequence[KnownView]) -> Float[Tensor, "h w 3"]:
    """Compose input and views in a row, faded by their weights, and below each the outline of the hull."""
    small = [smaller(view) for view in (front, *views)]
    shown = [over_white(view.cutout) * (1 - FADED * (1 - view.weight)) + FADED * (1 - view.weight) for view in small]
    carving = [view for view in small if view.weight >= CARVES]
    blank = [replace(view, cutout=torch.ones_like(view.cutout)) for view in small]
    try:
        alpha = hull_alpha([*carving, *blank])[len(carving) :]
    except BadInput:
        alpha = torch.zeros(len(small), *small[0].cutout.shape[:2], 1)
    return torch.cat([torch.cat(shown, 1), (1 - 0.6 * torch.cat([*alpha], 1)).expand(-1, -1, 3)])
