"""A picture becomes an animated 3D asset."""

from typing import Any

from prefect import flow
from prefect.runtime import flow_run
from prefect.task_runners import ThreadPoolTaskRunner

from dg4d_lib.settings import GeometricPriorSettings
from flows import home
from flows.engine.merging import frames_in
from flows.engine.tasks import Made, Steps
from flows.ui.asset_page import show_asset
from steps.contract import ArtifactRef
from steps.profiles import (
    CheckAssetSettings,
    DriveVideoSettings,
    ExtractMeshSettings,
    FitGaussiansSettings,
    FitMotionSettings,
    JoinMeshesSettings,
    PackAssetSettings,
    PipelineSettings,
    RefineTextureSettings,
)

# a part uses every core most of the time; two fill the gaps
RUNNER: Any = ThreadPoolTaskRunner(max_workers=2)


@flow(
    name="image_to_4d",
    flow_run_name="{item}",
    task_runner=RUNNER,
    persist_result=False,
)
def image_to_4d(
    source: ArtifactRef,
    settings: PipelineSettings,
    seed: int = 0,
    item: str = "asset",
    bank: ArtifactRef | None = None,
) -> Made:
    """Prepare the subject, set it in motion, fit Gaussians and their motion, extract a mesh, refine and pack it.

    Raises:
        StepError: a step did not finish; says which and why.
    """
    with Steps(item, seed) as steps:
        prepared = steps.run("prepare_subject", {"source": source}, settings.subject)
        return finish(steps, prepared, settings, bank)


def finish(
    steps: Steps, prepared: dict[str, ArtifactRef], settings: PipelineSettings, bank: ArtifactRef | None
) -> Made:
    """From the cut-out subject, and its footage if there is any, to the package."""
    subject, footage = prepared["subject"], prepared.get("footage")
    driving = steps.run("drive_video", {"subject": subject, "footage": footage}, drive(settings))["driving_video"]
    gaussians = steps.run("fit_gaussians", {"subject": subject, "bank": bank}, _fit(settings))["gaussians"]
    fitted = steps.run(
        "fit_motion", {"gaussians": gaussians, "driving_video": driving, "bank": bank}, _fit_motion(settings)
    )
    gaussians, motion = fitted.get("gaussians", gaussians), fitted["motion"]
    mesh = extract(steps, gaussians, motion, frames_in(driving, home.store()), settings)
    refined = steps.run(
        "refine_texture", {**mesh, "driving_video": driving}, RefineTextureSettings(refiner=settings.refiner)
    )
    surface = {name: refined.get(name) for name in ("tracked", "meshes")}
    packed = steps.run(
        "pack_asset",
        {"subject": subject, "driving_video": driving, "gaussians": gaussians, "motion": motion, **surface},
        PackAssetSettings(rasterizer=settings.rasterizer, pack=settings.pack, notes=steps.notes()),
    )
    steps.run(
        "check_asset",
        {"package": packed["package"], "driving_video": driving, "subject": subject},
        CheckAssetSettings(rasterizer=settings.rasterizer, gates=settings.gates),
    )
    show_asset(steps.item, steps.finished, packed["package"], home.store())
    return Made(
        package=packed["package"],
        steps=steps.finished,
        flow_run=str(flow_run.id or ""),
        wall_s=round(steps.wall_s, 3),
    )


def extract(
    steps: Steps, gaussians: ArtifactRef, motion: ArtifactRef, frames: int, settings: PipelineSettings
) -> dict[str, ArtifactRef | None]:
    """Extract one mesh that moves; or a mesh per frame, in parts of a few frames, where one is asked for or needed."""
    inputs: dict[str, ArtifactRef | None] = {"gaussians": gaussians, "motion": motion}
    whole = ExtractMeshSettings(rasterizer=settings.rasterizer, mesh=settings.mesh)
    if settings.mesh.mode != "per_frame":
        tracked = steps.run("extract_mesh", inputs, whole).get("tracked")
        if tracked is not None:
            return {"tracked": tracked}
    count = settings.mesh.frames_per_task
    mesh = settings.mesh.model_copy(update={"mode": "per_frame"})
    parts = [
        whole.model_copy(update={"mesh": mesh, "first_frame": first, "end_frame": min(first + count, frames)})
        for first in range(0, frames, count)
    ]
    done = [outputs["meshes"] for outputs in steps.run_parts("extract_mesh", inputs, parts)]
    if len(done) == 1:
        return {"meshes": done[0]}
    joined = steps.run("join_meshes", {f"meshes_{i:03d}": part for i, part in enumerate(done)}, JoinMeshesSettings())
    return {"meshes": joined["meshes"]}


def drive(settings: PipelineSettings) -> DriveVideoSettings:
    """What `drive_video` is asked for."""
    turn_deg = settings.prior.turn_deg if isinstance(settings.prior, GeometricPriorSettings) else 0.0
    return DriveVideoSettings(driving=settings.driving, turn_deg=turn_deg)


def _fit(settings: PipelineSettings) -> FitGaussiansSettings:
    return FitGaussiansSettings(rasterizer=settings.rasterizer, prior=settings.prior, static=settings.static)


def _fit_motion(settings: PipelineSettings) -> FitMotionSettings:
    return FitMotionSettings(
        rasterizer=settings.rasterizer, prior=settings.prior, deformation=settings.deformation, motion=settings.motion
    )
