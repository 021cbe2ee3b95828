"""What the subject looks like over time: the user's footage, or the best of several motions that are made up."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from shutil import copyfile
from tempfile import TemporaryDirectory

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.assets.rendering.preview import write_mp4
from dg4d_lib.assets.rendering.sheet import draw_video_sheet
from dg4d_lib.diffusion.components import default_device
from dg4d_lib.diffusion.video_model import VideoModel
from dg4d_lib.errors import BadInput
from dg4d_lib.images import resize
from dg4d_lib.settings import DrivingSettings, SvdSettings, WarpSettings
from dg4d_lib.video.candidate_ranking import MIN_GOOD_TOTAL, WEIGHTS, Candidate, rank_candidates, score_video
from dg4d_lib.video.driving import DrivingVideo
from dg4d_lib.video.svd import StableVideo
from dg4d_lib.video.warp import Warp, candidate_settings
from steps.artifacts.media import read_frames, read_png, write_frames, write_png, write_zip
from steps.runtime.job import Job, StepReport
from steps.runtime.weights import open_weights

TILE, COLUMNS = 160, 7  # pixels and moments of the sheets
FILM = 256  # pixels of their films
WHITE = torch.ones(3)


@dataclass(frozen=True)
class _Motion:
    """A video that was made, under the number by which a user picks it."""

    number: int
    name: str
    video: DrivingVideo
    notes: tuple[str, ...]


def run(job: Job) -> StepReport:
    """Hand the footage through, or make motions and take the one that was picked, else the best.

    Raises:
        BadInput: the footage has fewer than two frames, or another size than the subject; a pick beyond the candidates.
        BackendUnavailable: weights of the video model, or what loads them, are not here.
    """
    subject = read_png(job.inputs["subject"])
    if "footage" in job.inputs:
        return _follow(job, subject)
    driving: DrivingSettings = job.settings.driving
    numbers = [driving.pick] if driving.pick else list(range(1, driving.candidates + 1))
    match driving:
        case WarpSettings():
            motions, facts = list(_warps(driving, job.settings.turn_deg, subject, numbers)), StepReport()
            origin = "a warp of the picture ({}), without a learned model"
        case SvdSettings():
            motions, facts = _stable_videos(driving, subject, numbers, job.seed)
            origin = "Stable Video Diffusion ({})"
    taken, verdict = _tournament(job, subject, motions) if len(motions) > 1 else (motions[0], ())
    write_frames(job.outputs["driving_video"], taken.video)
    write_png(job.outputs["picture"], draw_video_sheet([taken.video], [taken.name], TILE, COLUMNS))
    made_up = f"The motion is made up by {origin.format(taken.name)}."
    return replace(facts, notes=(made_up, *verdict, *taken.notes, *facts.notes))


def _follow(job: Job, subject: Float[Tensor, "h w 4"]) -> StepReport:
    """The footage as it is, and what its score gives cause to say."""
    with TemporaryDirectory() as scratch:
        footage = read_frames(job.inputs["footage"], Path(scratch))
    if len(footage) < 2:
        raise BadInput(f"the footage has {len(footage)} frame(s); a driving video needs at least two")
    if footage.frames.shape[1:3] != subject.shape[:2]:
        sizes = [f"{shape[1]} x {shape[0]}" for shape in (footage.frames.shape[1:3], subject.shape[:2])]
        raise BadInput(f"the footage is {sizes[0]} pixels and the subject {sizes[1]}; prepare both together")
    copyfile(job.inputs["footage"], job.outputs["driving_video"])
    write_png(job.outputs["picture"], draw_video_sheet([footage], ["footage"], TILE, COLUMNS))
    found = score_video(footage, subject)
    why = "; ".join(found.remarks) or f"its score is low in {found.weakest}"
    note = f"The footage may be hard to follow (score {found.total:.2f} of 1): {why}."
    return StepReport(
        backend="none: the footage is used as it is", notes=(note,) if found.total < MIN_GOOD_TOTAL else ()
    )


def _warps(
    settings: WarpSettings, turn_deg: float, subject: Float[Tensor, "h w 4"], numbers: list[int]
) -> Iterator[_Motion]:
    for number in numbers:
        mine = candidate_settings(settings, number)
        warp = Warp(mine, turn_deg)
        video = warp.generate(subject, torch.Generator())
        yield _Motion(number, mine.motion, video, warp.notes)


def _stable_videos(
    settings: SvdSettings, subject: Float[Tensor, "h w 4"], numbers: list[int], seed: int
) -> tuple[list[_Motion], StepReport]:
    """Candidate k of a seed is candidate 1 of the seed plus k - 1."""
    opened = open_weights(settings.model.weights)
    device = default_device()
    maker = StableVideo(settings, VideoModel.load(opened.folder, settings.model, device))
    seeds = [seed + number - 1 for number in numbers]
    videos = maker.generate_all(subject, [torch.Generator().manual_seed(each) for each in seeds])
    motions = [_Motion(*made, ()) for made in zip(numbers, (f"seed {each}" for each in seeds), videos, strict=True)]
    return motions, StepReport(
        f"{device.type} (diffusers)", opened.digests, opened.licenses, maker.notes, maker.model.notes()
    )


def _tournament(job: Job, subject: Float[Tensor, "h w 4"], motions: list[_Motion]) -> tuple[_Motion, tuple[str, ...]]:
    """The best motion, and a sentence; writes the sheet, the ranking and the films."""
    judged = []
    for done, motion in enumerate(motions, 1):
        judged.append(Candidate(motion.number, motion.name, motion.video, score_video(motion.video, subject)))
        job.progress(done, len(motions), {"total": judged[-1].score.total})
    order = rank_candidates(judged)
    names = [f"{each.number} {each.name}: {each.score.total:.2f}" for each in order]
    write_png(job.outputs["candidates"], draw_video_sheet([each.video for each in order], names, TILE, COLUMNS))
    table = {"weights": WEIGHTS, "taken": order[0].number, "candidates": [each.row() for each in order]}
    job.outputs["ranking"].write_text(json.dumps(table, indent=2), encoding="utf-8")
    _write_films(job.outputs["films"], judged)
    taken = next(motion for motion in motions if motion.number == order[0].number)
    note = (
        f"Motion {taken.number} is the best of {len(motions)} by its score; `dg4d motions` shows all, --pick K takes K."
    )
    return taken, (note,)


def _write_films(path: Path, candidates: list[Candidate]) -> None:
    entries = []
    scratch = path.with_suffix(".mp4")
    for each in candidates:
        small = resize(each.video.over(WHITE), (FILM, FILM)).clamp(0, 1)
        write_mp4(scratch, small, each.video.fps)
        entries.append((f"{each.number}.mp4", scratch.read_bytes()))
    scratch.unlink()
    write_zip(path, entries)
