"""Step that provides the driving video: the user's footage, or the best of several generated candidates."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from shutil import copyfile
from tempfile import TemporaryDirectory
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.assets.rendering.preview import write_mp4
from dg4d_lib.assets.rendering.sheet import draw_video_sheet
from dg4d_lib.diffusion.components import default_device
from dg4d_lib.diffusion.video_model import VideoModel
from dg4d_lib.errors import BadInput
from dg4d_lib.images import resize
from dg4d_lib.inflation.hints import DepthHint
from dg4d_lib.input_settings import DiffusersVideoSettings, DrivingSettings, SvdSettings, WarpSettings
from dg4d_lib.video.candidate_ranking import MIN_GOOD_TOTAL, WEIGHTS, Candidate, rank_candidates, score_video
from dg4d_lib.video.driving import DrivingVideo
from dg4d_lib.video.image_to_video import ImageToVideo
from dg4d_lib.video.svd import StableVideo
from dg4d_lib.video.warp import Warp, candidate_settings
from steps.artifacts.depth_fields import read_depth_field
from steps.artifacts.media import read_frames, read_png, write_frames, write_png, write_zip
from steps.runtime.job import Job, StepReport
from steps.runtime.weights import license_note, offload_notes, open_weights

TILE, COLUMNS = 160, 7  # pixels of a tile, and frames, in the contact sheets
FILM = 256  # pixels of a side of the films
WHITE = torch.ones(3)


class _Motion(NamedTuple):
    """A generated video, and the number by which a user picks it."""

    number: int
    name: str
    video: DrivingVideo
    notes: tuple[str, ...] = ()


def run(job: Job) -> StepReport:
    """Copy the footage, or generate motions and use the picked one, else the best.

    Raises:
        BadInput: the footage has fewer than two frames or another size than the subject, or no candidate has the
            picked number.
        BackendUnavailable: weights or libraries of the video model are not installed.
    """
    subject = read_png(job.inputs["subject"])
    if "footage" in job.inputs:
        return _use_footage(job, subject)
    driving: DrivingSettings = job.settings.driving
    numbers = [driving.pick] if driving.pick else list(range(1, driving.candidates + 1))
    match driving:
        case WarpSettings():
            motions, report = _warps(driving, _hint(job), subject, numbers), StepReport()
            origin = "a warp of the picture ({}), without a learned model"
        case SvdSettings():
            motions, report = _stable_videos(driving, subject, numbers, job.seed)
            origin = "Stable Video Diffusion ({})"
        case DiffusersVideoSettings():
            motions, report = _pipeline_videos(job, driving, subject, numbers)
            origin = f"the video model {driving.weights} ({{}})"
    best, ranking_notes = _rank_candidates(job, subject, motions) if len(motions) > 1 else (motions[0], ())
    write_frames(job.outputs["driving_video"], best.video)
    write_png(job.outputs["picture"], draw_video_sheet([best.video], [best.name], TILE, COLUMNS))
    note = f"The motion is made up by {origin.format(best.name)}."
    return replace(report, notes=(note, *ranking_notes, *best.notes, *report.notes))


def _use_footage(job: Job, subject: Float[Tensor, "h w 4"]) -> StepReport:
    """Copy the footage and warn if its score is low."""
    with TemporaryDirectory() as scratch:
        footage = read_frames(job.inputs["footage"], Path(scratch))
    if len(footage) < 2:
        raise BadInput(f"the footage has {len(footage)} frame(s); a driving video needs at least two")
    if footage.frames.shape[1:3] != subject.shape[:2]:
        sizes = [f"{shape[1]} x {shape[0]}" for shape in (footage.frames.shape[1:3], subject.shape[:2])]
        raise BadInput(f"the footage is {sizes[0]} pixels and the subject {sizes[1]}; prepare both together")
    copyfile(job.inputs["footage"], job.outputs["driving_video"])
    write_png(job.outputs["picture"], draw_video_sheet([footage], ["footage"], TILE, COLUMNS))
    result = score_video(footage, subject)
    reason = "; ".join(result.remarks) or f"its score is low in {result.weakest}"
    note = f"The footage may be hard to follow (score {result.total:.2f} of 1): {reason}."
    return StepReport(
        backend="none: the footage is used as it is", notes=(note,) if result.total < MIN_GOOD_TOTAL else ()
    )


def _hint(job: Job) -> DepthHint:
    """Return the user's hints at the depth of the subject."""
    field = job.inputs.get("depth_field")
    return DepthHint(job.settings.turn_deg or None, read_depth_field(field) if field else None)


def _warps(
    settings: WarpSettings, hint: DepthHint, subject: Float[Tensor, "h w 4"], numbers: Sequence[int]
) -> list[_Motion]:
    """Generate warps of the picture."""
    motions = []
    for number in numbers:
        variant = candidate_settings(settings, number)
        warp = Warp(variant, hint)
        video = warp.generate(subject, torch.Generator())
        motions.append(_Motion(number, variant.motion, video, warp.notes))
    return motions


def _stable_videos(
    settings: SvdSettings, subject: Float[Tensor, "h w 4"], numbers: Sequence[int], seed: int
) -> tuple[list[_Motion], StepReport]:
    """Generate videos with Stable Video Diffusion; number k uses the seed plus k - 1."""
    opened = open_weights(settings.model.weights)
    device = default_device()
    generator = StableVideo(settings, VideoModel.load(opened.folder, settings.model, device))
    seeds = [seed + number - 1 for number in numbers]
    videos = generator.generate_all(subject, [torch.Generator().manual_seed(each) for each in seeds])
    names = [f"seed {each}" for each in seeds]
    motions = [_Motion(*generated) for generated in zip(numbers, names, videos, strict=True)]
    backend, run_notes = f"{device.type} (diffusers)", generator.model.notes()
    return motions, StepReport(backend, opened.digests, opened.licenses, generator.notes, run_notes)


def _pipeline_videos(
    job: Job, settings: DiffusersVideoSettings, subject: Float[Tensor, "h w 4"], numbers: Sequence[int]
) -> tuple[list[_Motion], StepReport]:
    """Generate videos with a pipeline of diffusers; number k uses the seed plus k - 1."""
    opened = open_weights(settings.weights)
    device = default_device()
    generator = ImageToVideo.load(opened.folder, settings, device)
    seeds = [job.seed + number - 1 for number in numbers]
    videos = generator.generate_all(
        subject,
        [torch.Generator().manual_seed(each) for each in seeds],
        lambda done, total: job.progress(done, total, {}),
    )
    motions = [
        _Motion(number, f"seed {each}", video) for number, each, video in zip(numbers, seeds, videos, strict=True)
    ]
    notes = (*generator.notes, license_note(settings.weights))
    backend = f"{device.type} (diffusers, {type(generator.pipeline).__name__})"
    return motions, StepReport(backend, opened.digests, opened.licenses, notes, offload_notes(generator.offload))


def _rank_candidates(
    job: Job, subject: Float[Tensor, "h w 4"], motions: Sequence[_Motion]
) -> tuple[_Motion, tuple[str, ...]]:
    """Return the best motion with a note; write the contact sheet, the ranking and the films."""
    scored = []
    for done, motion in enumerate(motions, 1):
        scored.append(Candidate(motion.number, motion.name, motion.video, score_video(motion.video, subject)))
        job.progress(done, len(motions), {"total": scored[-1].score.total})
    order = rank_candidates(scored)
    names = [f"{each.number} {each.name}: {each.score.total:.2f}" for each in order]
    write_png(job.outputs["candidates"], draw_video_sheet([each.video for each in order], names, TILE, COLUMNS))
    table = {"weights": WEIGHTS, "taken": order[0].number, "candidates": [each.row() for each in order]}
    job.outputs["ranking"].write_text(json.dumps(table, indent=2), encoding="utf-8")
    _write_films(job.outputs["films"], scored)
    best = next(motion for motion in motions if motion.number == order[0].number)
    note = (
        f"Motion {best.number} is the best of {len(motions)} by its score; `dg4d motions` shows all, --pick K takes K."
    )
    return best, (note,)


def _write_films(path: Path, candidates: Sequence[Candidate]) -> None:
    entries = []
    scratch = path.with_suffix(".mp4")
    for each in candidates:
        small = resize(each.video.over(WHITE), (FILM, FILM)).clamp(0, 1)
        write_mp4(scratch, small, each.video.fps)
        entries.append((f"{each.number}.mp4", scratch.read_bytes()))
    scratch.unlink()
    write_zip(path, entries)
