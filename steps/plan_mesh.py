"""Step that selects a tracked mesh or a mesh per frame by trial meshes, before the extraction."""

from functools import partial
from typing import Literal

import torch

from dg4d_lib.deformation.on_parts import OnParts
from dg4d_lib.fitting.guided_mesh import rank_guided_references
from dg4d_lib.mesh.extraction.density import density_field
from dg4d_lib.mesh.extraction.extract import select_level
from dg4d_lib.mesh.folds import genus
from dg4d_lib.mesh.tracking.reference_frame import select_reference_frame
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.settings import MeshSettings
from dg4d_lib.shape_prior import packaged
from steps.artifacts.media import read_frames
from steps.artifacts.mesh_plan import MeshPlan, write_plan
from steps.artifacts.motions import read_motion, read_states
from steps.fitting.guesses import guessed_shapes
from steps.runtime.job import Job, StepReport

FINER, FINEST = 1.5, 512  # factor of `mesh.grid` that a mesh per frame tries, and the largest grid
FINER_GAIN = 0.005  # intersection over union of outlines by which the finer grid must be better
LIMITS = {"gaussians": "min_followed", "video": "min_guided"}


def run(job: Job) -> StepReport:
    """Choose one tracked mesh or a mesh per frame, the reference frame, and the level of the isosurface.

    The outlines of the surface at that level agree best with those of the Gaussians in the reference frame.

    Raises:
        FitDiverged: there are no Gaussians.
    """
    settings: MeshSettings = job.settings.mesh
    rasterize = get_rasterizer(job.settings.rasterizer)
    states, displacement = read_states(job.inputs["gaussians"], job.inputs["motion"])
    mode, frame, followed, notes, grid = settings.mode, 0, 1.0, [], None
    if mode == "auto" and isinstance(read_motion(job.inputs["motion"]).deformation, OnParts):
        mode = "per_frame"
        notes.append("a part opens about a hinge and reveals a surface that frame 0 hides; a mesh per frame is used")
    others: tuple[int, ...] = ()
    guide: Literal["gaussians", "video"] = "gaussians"
    weights: dict[str, str] = {}
    if mode != "per_frame":
        trial = select_reference_frame(states, displacement, rasterize, settings)
        frame, followed = trial.frame, trial.iou
        torn = followed < settings.min_followed or trial.stretch > settings.max_stretch
        if torn and "driving_video" in job.inputs:
            video = read_frames(job.inputs["driving_video"], job.pictures)
            generator = torch.Generator().manual_seed(job.seed)
            rank = partial(rank_guided_references, states, video, rasterize, settings, frame, generator)
            if settings.source == "prior" and "subject" in job.inputs:
                hints = job.inputs.get("pose"), job.inputs.get("depth_field")
                shapes = guessed_shapes(video, *hints, job.settings.turn_deg)
                ranked = rank(lambda candidate: genus(shapes.surface(candidate).faces.numpy()))
                weights = packaged.digests()
            else:
                ranked = rank()
            if mode == "tracked" or ranked[0][1] >= settings.min_guided or followed < settings.min_followed:
                (frame, followed), guide = ranked[0], "video"
                others = tuple(other for other, _ in ranked[1:])
    if mode == "auto":
        least = settings.min_followed if guide == "gaussians" else settings.min_guided
        mode = "tracked" if followed >= least else "per_frame"
        if mode == "per_frame":
            notes.append(
                f"one mesh does not follow this motion (trial mesh: {followed:.1%} IoU, mesh.{LIMITS[guide]} requires "
                f"{least:.0%}); a mesh per frame is used"
            )
            frame, guide, others = 0, "gaussians", ()
    job.progress(1, 2, {})
    rest = states.at(frame)
    level, agreement = select_level(density_field(rest, settings), rest, rasterize, settings.density_threshold)
    if settings.mode == "auto" and mode == "per_frame":
        finer = settings.model_copy(update={"grid": min(round(FINER * settings.grid), FINEST)})
        found = select_level(density_field(rest, finer), rest, rasterize, level)
        if found[1] > agreement + FINER_GAIN:
            (level, agreement), grid = found, finer.grid
            notes.append(
                f"thin parts need a finer grid: {grid} instead of {settings.grid} samples per axis (mesh.grid)"
            )
    guessed = settings.source == "prior" and {"driving_video", "subject"} <= job.inputs.keys()
    if mode == "per_frame" or not guessed:  # else the mesh is the shape network's surface
        notes.append(f"outlines of the isosurface at density {level:.3g} agree with the Gaussians' to {agreement:.1%}")
    plan = MeshPlan(
        mode=mode,
        reference_frame=frame,
        other_candidates=others,
        followed=followed,
        level=level,
        grid=grid,
        guide=guide,
    )
    write_plan(job.outputs["plan"], plan)
    job.progress(2, 2, {})
    return StepReport(f"{job.settings.rasterizer} rasterizer", weights, notes=tuple(notes))
