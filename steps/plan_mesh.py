"""Step that chooses a tracked mesh or a mesh per frame, by trial meshes, before meshes are extracted."""

from typing import Literal

import torch

from dg4d_lib.fitting.guided_mesh import select_guided_reference
from dg4d_lib.mesh.extraction.density import density_field
from dg4d_lib.mesh.extraction.extract import select_level
from dg4d_lib.mesh.tracking.reference_frame import select_reference_frame
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.settings import MeshSettings
from steps.artifacts.media import read_frames
from steps.artifacts.mesh_plan import MeshPlan, write_plan
from steps.artifacts.motions import read_states
from steps.runtime.job import Job, StepReport


def run(job: Job) -> StepReport:
    """Choose one tracked mesh or a mesh per frame, the reference frame, and the level of the isosurface.

    The outlines of the surface at that level agree best with those of the Gaussians in the reference frame.

    Raises:
        FitDiverged: there are no Gaussians.
    """
    settings: MeshSettings = job.settings.mesh
    rasterize = get_rasterizer(job.settings.rasterizer)
    states, displacement = read_states(job.inputs["gaussians"], job.inputs["motion"])
    mode, frame, followed, notes = settings.mode, 0, 1.0, []
    guide: Literal["gaussians", "video"] = "gaussians"
    if mode != "per_frame":
        frame, followed = select_reference_frame(states, displacement, rasterize, settings)
        if followed < settings.min_followed and "driving_video" in job.inputs:
            video, generator = (
                read_frames(job.inputs["driving_video"], job.pictures),
                torch.Generator().manual_seed(job.seed),
            )
            guided = select_guided_reference(states, video, rasterize, settings, frame, generator)
            if guided[1] > followed:
                (frame, followed), guide = guided, "video"
    if mode == "auto":
        mode = "tracked" if followed >= settings.min_followed else "per_frame"
        if mode == "per_frame":
            frame, guide = 0, "gaussians"
            notes.append(
                f"one mesh does not follow this motion ({followed:.1%} IoU on trial, mesh.min_followed asks for "
                f"{settings.min_followed:.0%}): every frame gets its own"
            )
    job.progress(1, 2, {})
    rest = states.at(frame)
    level, agreement = select_level(density_field(rest, settings), rest, rasterize, settings.density_threshold)
    notes.append(f"surface at density {level:.3g}; its outlines agree with the Gaussians' to {agreement:.1%} (IoU)")
    plan = MeshPlan(mode=mode, reference_frame=frame, followed=followed, level=level, guide=guide)
    write_plan(job.outputs["plan"], plan)
    job.progress(2, 2, {})
    return StepReport(backend=f"{job.settings.rasterizer} rasterizer", notes=tuple(notes))
