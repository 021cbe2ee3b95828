"""A picture becomes an animated 3D asset."""

from typing import Any

from prefect import flow
from prefect.runtime import flow_run
from prefect.task_runners import ThreadPoolTaskRunner

from flows import home
from flows.engine.merging import frames_in
from flows.engine.tasks import Made, Steps
from flows.ui.asset_page import show_asset
from steps.artifacts.mesh_plan import read_plan
from steps.contract import ArtifactRef
from steps.profiles import PipelineSettings, step_settings

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
        prepared = steps.run("prepare_subject", {"source": source}, step_settings("prepare_subject", settings))
        return finish(steps, prepared, settings, bank)


def finish(
    steps: Steps, prepared: dict[str, ArtifactRef], settings: PipelineSettings, bank: ArtifactRef | None
) -> Made:
    """From the cut-out subject, and its footage if there is any, to the package."""
    subject, footage = prepared["subject"], prepared.get("footage")
    driving = steps.run(
        "drive_video", {"subject": subject, "footage": footage}, step_settings("drive_video", settings)
    )["driving_video"]
    gaussians = steps.run(
        "fit_gaussians", {"subject": subject, "bank": bank}, step_settings("fit_gaussians", settings)
    )["gaussians"]
    fitted = steps.run(
        "fit_motion",
        {"gaussians": gaussians, "driving_video": driving, "bank": bank},
        step_settings("fit_motion", settings),
    )
    gaussians, motion = fitted.get("gaussians", gaussians), fitted["motion"]
    mesh = extract(steps, gaussians, motion, frames_in(driving, home.store()), settings)
    if settings.refiner.kind != "identity":
        mesh = steps.run(
            "refine_texture", {**mesh, "driving_video": driving}, step_settings("refine_texture", settings)
        )
    packed = steps.run(
        "pack_asset",
        {"subject": subject, "driving_video": driving, "gaussians": gaussians, "motion": motion, **mesh},
        step_settings("pack_asset", settings, notes=steps.notes()),
    )
    steps.run(
        "check_asset",
        {"package": packed["package"], "driving_video": driving, "subject": subject},
        step_settings("check_asset", settings),
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
) -> dict[str, ArtifactRef]:
    """Extract what the plan says: one mesh that moves, or a mesh per frame, in parts of a few frames."""
    cloud: dict[str, ArtifactRef | None] = {"gaussians": gaussians, "motion": motion}
    plan = steps.run("plan_mesh", cloud, step_settings("plan_mesh", settings))["plan"]
    inputs = {**cloud, "plan": plan}
    if read_plan(home.store().path(plan)).mode == "tracked":
        return {"tracked": steps.run("extract_mesh", inputs, step_settings("extract_mesh", settings))["tracked"]}
    count = settings.mesh.frames_per_task
    parts = [
        step_settings("extract_mesh", settings, first_frame=first, end_frame=min(first + count, frames))
        for first in range(0, frames, count)
    ]
    done = [outputs["meshes"] for outputs in steps.run_parts("extract_mesh", inputs, parts)]
    if len(done) == 1:
        return {"meshes": done[0]}
    joined = steps.run(
        "join_meshes", {f"meshes_{i:03d}": part for i, part in enumerate(done)}, step_settings("join_meshes", settings)
    )
    return {"meshes": joined["meshes"]}
