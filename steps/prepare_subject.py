"""Step that turns a picture or video into cut-outs of the subject in one square frame."""

from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.images import over_white, resize
from dg4d_lib.inflation.ground import ground_turn
from dg4d_lib.inflation.hints import DepthField
from dg4d_lib.input_settings import SubjectSettings
from dg4d_lib.metrics.cutout import evaluate_cutout
from dg4d_lib.video.driving import DrivingVideo
from dg4d_lib.video.framing import crop_whole_frame, reframe
from dg4d_lib.video.subject import PreparedSubject, prepare_subject
from steps.artifacts.depth_fields import write_depth_field
from steps.artifacts.gates import gates_as_json, write_gates
from steps.artifacts.media import write_frames, write_png
from steps.artifacts.pose import Pose, write_pose
from steps.runtime.job import Job, StepReport
from steps.sources.depth import read_depth, read_layers
from steps.sources.masks import read_mask, scaled_box
from steps.sources.networks import LoadedNetwork, open_network
from steps.sources.reader import Source, read_source

TILE = 256  # pixels


def run(job: Job) -> StepReport:
    """Decode `source`, cut out and frame the subject; write `footage` and `pose` if the source is a video.

    A depth picture or layers of the first frame become a `depth_field` in the same frame.

    Raises:
        BadInput: the file cannot be used; says why and what to do.
    """
    settings: SubjectSettings = job.settings.subject
    with TemporaryDirectory() as scratch:
        limits = Path(scratch), settings.max_frames, settings.max_decode_gb
        source = read_source(job.inputs["source"], *limits)
        mask = read_mask(job.inputs["mask"], source, *limits) if "mask" in job.inputs else None
    job.progress(1, 3, {})
    network = open_network(settings.matting)
    boxed = settings.model_copy(update={"box": scaled_box(settings.box, source)})
    prepared = prepare_subject(source.frames, source.has_alpha, boxed, mask, network.segmenter)
    cutouts, notes = prepared.frames, prepared.notes
    hinted = read_hint(job, source, prepared)
    if prepared.estimate is not None:
        found = prepared.estimate
        gates = gates_as_json(evaluate_cutout(found.frames[..., 3], found.agreement, job.settings.cutout))
        write_gates(job.outputs["cutout_gates"], gates)
    job.progress(2, 3, {})
    write_png(job.outputs["subject"], cutouts[0])
    if source.kind == "video":
        footage = DrivingVideo(cutouts[..., :3].contiguous(), cutouts[..., 3:].contiguous(), source.fps)
        write_frames(job.outputs["footage"], footage)
        turn_deg = ground_turn(footage.alpha, settings.ground_turn)
        write_pose(job.outputs["pose"], Pose(turn_deg=None if turn_deg is None else round(turn_deg, 3)))
        notes = (*notes, turn_note(turn_deg)) if turn_deg is not None and not settings.turn_deg else notes
    tiles = picture_of(source.frames[0], cutouts[0])
    if hinted:
        field, note = hinted
        write_depth_field(job.outputs["depth_field"], field)
        notes, tiles = (*notes, note), torch.cat([tiles, picture_of_depth(field)], 1)
    write_png(job.outputs["picture"], tiles)
    job.progress(3, 3, {})
    used = network if prepared.estimate is not None and prepared.estimate.used_network else LoadedNetwork()
    return StepReport(weights=used.digests, licenses=used.licenses, notes=(*source.notes, *notes))


def read_hint(job: Job, source: Source, prepared: PreparedSubject) -> tuple[DepthField, str] | None:
    """Return the depth field that the user gave, and a sentence about it; None if nothing is given."""
    settings: SubjectSettings = job.settings.subject
    for port, read in (("depth", read_depth), ("layers", read_layers)):
        if port in job.inputs:
            with TemporaryDirectory() as scratch:
                return read(job.inputs[port], source, prepared, settings, Path(scratch))
    return None


def turn_note(turn_deg: float) -> str:
    """Return the sentence about an estimated yaw, in degrees; below half a degree it counts as 0."""
    estimate = "estimated yaw of the subject, from where it touches the ground"
    degrees = round(abs(turn_deg))
    if not degrees:
        return f"{estimate}: 0 degrees"
    return (
        f"{estimate}: {degrees} degree{'s' * (degrees > 1)}, {'right' if turn_deg > 0 else 'left'} end nearer; used by "
        "prior.kind=geometric and learned if no other views are given (subject.turn_deg overrides it, "
        "subject.ground_turn=0 disables it)"
    )


def picture_of_depth(field: DepthField) -> Float[Tensor, "t t 3"]:
    """Render a depth field in gray, near parts bright; white where the depth is unknown."""
    middle = field.middle[field.known]
    gray = 0.1 + 0.7 * (field.middle - middle.min()) / (middle.max() - middle.min()).clamp(min=1e-6)
    shown = torch.where(field.known, gray, 1.0)[..., None].expand(-1, -1, 3)
    return resize(shown[None], (TILE, TILE))[0].clamp(0, 1)


def picture_of(source: Float[Tensor, "h w 4"], cutout: Float[Tensor, "s s 4"]) -> Float[Tensor, "t w3 3"]:
    """Compose the source, its matte and the cut-out side by side, over white."""
    tiles = [reframe(each[None], crop_whole_frame(*each.shape[:2]), TILE)[0] for each in (source, cutout)]
    given, cut = map(over_white, tiles)
    return torch.cat([given, tiles[1][..., 3:].expand(TILE, TILE, 3), cut], 1)
