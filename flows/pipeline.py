"""Flows that turn a picture, a video or words into an animated 3D asset."""

import time
from pathlib import Path

from prefect import flow, runtime, unmapped
from prefect.transactions import transaction

from flows import home
from flows.engine import resources
from flows.engine.frames import count_frames, divide_frames
from flows.engine.publishing import keep_version, publish
from flows.engine.step_tasks import Conversion, finished_steps, steps_of_flow
from flows.inputs.conversion_job import ConversionJob
from flows.packages.flow_result import FlowResult, notes_of
from flows.step_errors import StepBadInput
from flows.tasks import (
    Asset,
    DrivingVideo,
    Gaussians,
    Mesh,
    Motion,
    Subject,
    animate_asset,
    check_asset,
    draw_picture,
    drive_video,
    extract_mesh,
    fit_gaussians,
    fit_motion,
    join_meshes,
    pack_asset,
    plan_mesh,
    prepare_asset,
    prepare_subject,
    refine_texture,
)
from flows.ui.asset_page import show_asset
from steps.artifacts.mesh_plan import read_plan
from steps.contract import ArtifactRef


@flow(name="image_to_4d", flow_run_name="{job.item}", persist_result=False)
def image_to_4d(job: ConversionJob, folder: Path | None = None, mesh_parts: int = 0) -> FlowResult:
    """Turn a picture into an animated 3D asset; a video keeps its motion.

    Args:
        job: source, settings and name of the asset.
        folder: output folder of the package; None: the package stays in the store.
        mesh_parts: number of tasks that extract a mesh per frame; 0: one per slot of this machine.

    Raises:
        StepError: a step did not finish.
    """
    with steps_of_flow():
        conversion = conversion_of(job, mesh_parts)
        if job.asset is not None and job.asset == job.source:  # no picture: the model's own render is set in motion
            model = prepare_asset(job.asset, conversion)
            return animate(model, job, conversion, folder, model)
        subject = prepare_subject(job.source, conversion)
        return animate(subject, job, conversion, folder)


@flow(name="video_to_4d", flow_run_name="{job.item}", persist_result=False)
def video_to_4d(job: ConversionJob, folder: Path | None = None, mesh_parts: int = 0) -> FlowResult:
    """Turn a video into an animated 3D asset that moves as the video does.

    Raises:
        StepError: a step did not finish.
    """
    with steps_of_flow():
        conversion = conversion_of(job, mesh_parts)
        subject = prepare_subject(job.source, conversion)
        if subject.footage is None:
            raise StepBadInput(
                "prepare_subject", "this is a single picture, not a video: a video has two frames or more"
            )
        return animate(subject, job, conversion, folder)


@flow(name="text_to_4d", flow_run_name="{job.item}", persist_result=False)
def text_to_4d(job: ConversionJob, folder: Path | None = None, mesh_parts: int = 0) -> FlowResult:
    """Draw a picture from words and turn it into an animated 3D asset.

    Raises:
        StepError: a step did not finish.
    """
    with steps_of_flow():
        conversion = conversion_of(job, mesh_parts)
        picture = draw_picture(job.source, conversion)
        subject = prepare_subject(picture.picture, conversion)
        return animate(subject, job, conversion, folder)


@flow(name="motions", flow_run_name="{job.item}", persist_result=False)
def motions(job: ConversionJob) -> dict[str, ArtifactRef]:
    """Generate and rank candidate motions of a picture; return the outputs of `drive_video`.

    Raises:
        StepError: a step did not finish.
    """
    with steps_of_flow():
        conversion = conversion_of(job)
        subject = prepare_subject(job.source, conversion)
        if subject.footage is not None:
            raise StepBadInput("prepare_subject", "this is a video and has its motion already; give a picture")
        return drive_video(subject, conversion).outputs


def conversion_of(job: ConversionJob, mesh_parts: int = 0) -> Conversion:
    """Return the parameters that all steps of a job share."""
    return Conversion(item=job.item, settings=job.settings, seed=job.seed, mesh_parts=mesh_parts)


def animate(
    subject: Subject, job: ConversionJob, conversion: Conversion, folder: Path | None, asset: Asset | None = None
) -> FlowResult:
    """Turn a subject into a package: driving video, static Gaussians, motion, mesh, texture, files, verdict.

    Args:
        subject: cut-out.
        job: what to make.
        conversion: parameters of all steps.
        folder: output folder of the package; None: the package stays in the store.
        asset: the user's model, if it has been prepared already.
    """
    filming = drive_video.submit(subject, conversion)
    gaussians: Gaussians | Asset
    if job.asset is not None:
        gaussians = asset or prepare_asset(job.asset, conversion, subject)
        driving_video = filming.result()
        motion = animate_asset(gaussians, driving_video, conversion)
    else:
        gaussians = fit_gaussians(subject, conversion, job.bank)  # in this thread, parallel to the driving video
        driving_video = filming.result()
        motion = fit_motion(subject, gaussians, driving_video, conversion, job.bank)
    own = motion.outputs.get("tracked")  # the mesh of the user's model
    mesh = (
        Mesh.model_validate(motion.model_dump())
        if own
        else mesh_over_time(gaussians, motion, driving_video, conversion)
    )
    if job.settings.refiner.kind != "identity":
        mesh = refine_texture(mesh, driving_video, conversion)
    notes = notes_of(done.result for done in finished_steps())
    package = pack_asset(subject, driving_video, gaussians, motion, mesh, notes, conversion)
    verdict = check_asset(package, driving_video, subject, conversion)
    result = FlowResult(
        package=package.package,
        steps=finished_steps(),
        flow_run=str(runtime.flow_run.id),
        wall_s=round((time.time_ns() - conversion.begun_ns) / 1e9, 3),
    )
    show_asset(job.item, result.steps, result.package, home.store())
    if folder is not None:
        with transaction():  # a failed version restores the earlier content of the folder
            publish(package, verdict, job, result, folder)
            keep_version(job, result)
    return result


def mesh_over_time(
    gaussians: Gaussians | Asset, motion: Motion, driving_video: DrivingVideo, conversion: Conversion
) -> Mesh:
    """Extract one mesh that follows the motion, or a mesh per frame with the frames divided among the slots."""
    plan = plan_mesh(gaussians, motion, conversion)
    if read_plan(home.store().path(plan.plan)).mode == "tracked":
        return extract_mesh(gaussians, motion, plan, conversion)
    frames = count_frames(driving_video.frames, home.store())
    parts = divide_frames(frames, conversion.mesh_parts or resources.cpus())
    every = map(unmapped, (gaussians, motion, plan, conversion))
    meshes = extract_mesh.map(*every, parts).result()
    return meshes[0] if len(meshes) == 1 else join_meshes(meshes, conversion)
