"""Flows that turn a picture, a video or words into an animated 3D asset."""

import time
from pathlib import Path
from typing import Annotated, TypeAlias

from prefect import flow, runtime
from pydantic import WithJsonSchema

from flows import home
from flows.engine.publishing import keep_version, publish
from flows.engine.step_tasks import finished_steps, steps_of_flow
from flows.inputs.conversion_job import ConversionJob
from flows.packages.flow_result import FlowResult
from flows.stages import conversion_of, convert
from flows.step_errors import StepBadInput
from flows.tasks import TASKS, drive_video, prepare_subject
from flows.ui.asset_page import show_asset
from steps.contract import ArtifactRef

# Prefect would build the whole schema, 70 kB, once per flow (0.05 s each); no form shows it, for none is deployed
Job: TypeAlias = Annotated[ConversionJob, WithJsonSchema({"type": "object"})]


@flow(name="image_to_4d", flow_run_name="{job.item}", persist_result=False)
def image_to_4d(job: Job, folder: Path | None = None, mesh_parts: int = 0) -> FlowResult:
    """Turn a picture into an animated 3D asset; a video keeps its motion.

    Args:
        job: source, settings and name of the asset.
        folder: output folder of the package; None: the package stays in the store.
        mesh_parts: number of tasks that extract a mesh per frame; 0: one per slot of this machine.

    Raises:
        StepError: a step did not finish.
    """
    return _convert_in_flow(job, folder, mesh_parts)


@flow(name="video_to_4d", flow_run_name="{job.item}", persist_result=False)
def video_to_4d(job: Job, folder: Path | None = None, mesh_parts: int = 0) -> FlowResult:
    """Turn a video into an animated 3D asset that moves as the video does.

    Raises:
        StepError: a step did not finish.
    """
    return _convert_in_flow(job, folder, mesh_parts, must_move=True)


@flow(name="text_to_4d", flow_run_name="{job.item}", persist_result=False)
def text_to_4d(job: Job, folder: Path | None = None, mesh_parts: int = 0) -> FlowResult:
    """Generate a picture from a prompt and turn it into an animated 3D asset.

    Raises:
        StepError: a step did not finish.
    """
    return _convert_in_flow(job, folder, mesh_parts)


@flow(name="motions", flow_run_name="{job.item}", persist_result=False)
def motions(job: Job) -> dict[str, ArtifactRef]:
    """Generate and rank candidate motions of a picture; return the outputs of `drive_video`.

    Raises:
        StepError: a step did not finish.
    """
    with steps_of_flow():
        conversion = conversion_of(job)
        subject = prepare_subject(job.source, conversion, job.mask, job.depth, job.layers)
        if subject.footage is not None:
            raise StepBadInput("prepare_subject", "this is a video and has its motion already; give a picture")
        return drive_video(subject, conversion).outputs


def _convert_in_flow(job: ConversionJob, folder: Path | None, mesh_parts: int, must_move: bool = False) -> FlowResult:
    """Convert a job in the current flow run, show the asset in the UI, and publish it if there is a folder."""
    with steps_of_flow():
        conversion = conversion_of(job, mesh_parts)
        package, verdict = convert(job, conversion, TASKS, must_move)
        result = FlowResult(
            package=package.package,
            steps=finished_steps(),
            flow_run=str(runtime.flow_run.id),
            wall_s=round((time.time_ns() - conversion.begun_ns) / 1e9, 3),
        )
        show_asset(job.item, result.steps, result.package, home.store())
        if folder is not None:
            keep_version(job, result)  # first: the package in the folder makes the next run of this job end at once
            publish(package, verdict, job, result, folder)
        return result
