"""Stages of a conversion: order of the steps and their data flow, for tasks of any engine."""

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, ParamSpec, Protocol, TypeVar

from flows import home, step_calls
from flows.engine import resources
from flows.engine.frames import count_frames, divide_frames
from flows.engine.requests import Conversion
from flows.inputs.conversion_job import ConversionJob
from flows.inputs.sources import ALWAYS_MOVING
from flows.packages.flow_result import StepRun, notes_of
from flows.step_calls import Asset, DrivingVideo, Gaussians, KnownViews, Mesh, Motion, Package, Plan, Subject, Verdict
from flows.step_errors import StepBadInput
from steps.artifacts.mesh_plan import read_plan
from steps.contract import ArtifactRef, StepResult

P = ParamSpec("P")
R = TypeVar("R", bound=StepResult)
R_co = TypeVar("R_co", bound=StepResult, covariant=True)


class StepFuture(Protocol[R_co]):
    """Result of a submitted task."""

    def result(self) -> R_co:
        """Wait for the task; return its result or raise its error."""


class StepTask(Protocol[P, R_co]):
    """Task of one step."""

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R_co:
        """Run the task in this thread."""

    def submit(self, *args: P.args, **kwargs: P.kwargs) -> StepFuture[R_co]:
        """Run the task in another thread."""


class Bind(Protocol):
    """Function that wraps the call of a step in a task of an engine."""

    def __call__(self, call: Callable[P, R]) -> StepTask[P, R]:
        """Return the task."""


class Tasks:
    """Tasks of one engine.

    Args:
        bind: wraps the call of a step in a task.
        finished: returns the step runs of the current conversion so far, in the order of the catalog.
    """

    def __init__(self, bind: Bind, finished: Callable[[], list[StepRun]]) -> None:
        self.finished = finished
        self.draw_picture = bind(step_calls.draw_picture)
        self.prepare_subject = bind(step_calls.prepare_subject)
        self.prepare_views = bind(step_calls.prepare_views)
        self.generate_views = bind(step_calls.generate_views)
        self.prepare_asset = bind(step_calls.prepare_asset)
        self.animate_asset = bind(step_calls.animate_asset)
        self.drive_video = bind(step_calls.drive_video)
        self.fit_gaussians = bind(step_calls.fit_gaussians)
        self.fit_motion = bind(step_calls.fit_motion)
        self.plan_mesh = bind(step_calls.plan_mesh)
        self.extract_mesh = bind(step_calls.extract_mesh)
        self.join_meshes = bind(step_calls.join_meshes)
        self.refine_texture = bind(step_calls.refine_texture)
        self.pack_asset = bind(step_calls.pack_asset)
        self.check_asset = bind(step_calls.check_asset)


class Converted(NamedTuple):
    """Package of a conversion and the verdict of the quality gates."""

    package: Package
    verdict: Verdict


def conversion_of(job: ConversionJob, mesh_parts: int = 0) -> Conversion:
    """Return the parameters that all steps of a job share."""
    return Conversion(item=job.item, settings=job.settings, seed=job.seed, mesh_parts=mesh_parts)


def planned_steps(job: ConversionJob) -> list[str]:
    """Return the names of the steps that a job certainly runs, in the order in which they usually end."""
    first = ["draw_picture"] if job.generates_picture else []
    refined = ["refine_texture"] if job.settings.refiner.kind != "identity" else []
    fits = ["drive_video", "fit_gaussians", "fit_motion", "plan_mesh", "extract_mesh"]
    if job.asset is not None:  # splats go on to `plan_mesh` and `extract_mesh`
        own = ["prepare_asset"] if job.asset == job.source else ["prepare_subject", "prepare_asset"]
        return [*own, "drive_video", "animate_asset", *refined, "pack_asset", "check_asset"]
    generates_views = job.settings.views.kind != "none"
    sides = ["prepare_views"] if job.views is not None else ["generate_views"] if generates_views else []
    return [*first, "prepare_subject", *sides, *fits, *refined, "pack_asset", "check_asset"]


def convert(job: ConversionJob, conversion: Conversion, tasks: Tasks, must_move: bool = False) -> Converted:
    """Turn the source of a job into a package.

    Args:
        job: source and settings.
        conversion: parameters that all steps share.
        tasks: tasks of the engine.
        must_move: refuse a source that is a single picture.

    Raises:
        StepError: a step did not finish.
    """
    if job.asset is not None and job.asset == job.source:  # no picture: the model's own render is set in motion
        model = tasks.prepare_asset(job.asset, conversion)
        return animate(model, job.source, job, conversion, tasks, model)
    source = tasks.draw_picture(job.source, conversion).picture if job.generates_picture else job.source
    subject = tasks.prepare_subject(source, conversion, job.mask, job.depth, job.layers)
    if must_move and subject.footage is None:
        raise StepBadInput("prepare_subject", _is_no_video(job.source_name))
    return animate(subject, source, job, conversion, tasks)


def _is_no_video(name: str) -> str:
    """Return the error message for a single picture, by its file name, in place of a video."""
    if Path(name).suffix.lower() in ALWAYS_MOVING:
        return "this video holds a single picture, and a video has two frames or more; give a longer one"
    return (
        "--video: this is a single picture, and a video has two frames or more; for a generated motion run "
        f"`dg4d make {shlex.quote(name)}`"
    )


def animate(
    subject: Subject,
    source: ArtifactRef,
    job: ConversionJob,
    conversion: Conversion,
    tasks: Tasks,
    model: Asset | None = None,
) -> Converted:
    """Turn a subject into a package: driving video, static Gaussians, motion, mesh, texture, files, verdict.

    Args:
        subject: cut-out.
        source: file that it was cut out of.
        job: source and settings.
        conversion: parameters that all steps share.
        tasks: tasks of the engine.
        model: the user's model, if it has been prepared already.
    """
    video_task = tasks.drive_video.submit(subject, conversion)
    gaussians: Gaussians | Asset
    known = None
    if job.asset is not None:
        gaussians = model or tasks.prepare_asset(job.asset, conversion, subject)
        driving_video = video_task.result()
        motion = tasks.animate_asset(gaussians, driving_video, conversion)
    else:
        known = known_views(subject, source, job, conversion, tasks)
        gaussians = tasks.fit_gaussians(subject, conversion, job.bank, known)  # here, parallel to the driving video
        driving_video = video_task.result()
        motion = tasks.fit_motion(subject, gaussians, driving_video, conversion, job.bank, known)
    if "tracked" in motion.outputs:  # the mesh of the user's model
        mesh = Mesh.model_validate(motion.model_dump())
    else:
        fitted = job.asset is None
        guessed = subject if fitted and known is None and job.settings.prior.kind == "learned" else None
        mesh = mesh_over_time(gaussians, motion, driving_video, conversion, tasks, fitted, guessed)
    if job.settings.refiner.kind != "identity":
        mesh = tasks.refine_texture(subject, mesh, driving_video, conversion)
    notes = notes_of(done.result for done in tasks.finished())
    package = tasks.pack_asset(subject, driving_video, gaussians, motion, mesh, notes, conversion)
    return Converted(package, tasks.check_asset(package, driving_video, subject, conversion))


def known_views(
    subject: Subject, source: ArtifactRef, job: ConversionJob, conversion: Conversion, tasks: Tasks
) -> KnownViews | None:
    """Return views of other sides: the user's, else those that a model generates, else none."""
    if job.views is not None:
        return tasks.prepare_views(job.views, source, subject, conversion, job.mask)
    return tasks.generate_views(subject, conversion) if job.settings.views.kind != "none" else None


def mesh_over_time(
    gaussians: Gaussians | Asset,
    motion: Motion,
    driving_video: DrivingVideo,
    conversion: Conversion,
    tasks: Tasks,
    fitted: bool,
    guessed: Subject | None,
) -> Mesh:
    """Extract one mesh that follows the motion, or a mesh per frame with the frames divided among the slots.

    Args:
        gaussians: static cloud.
        motion: its motion.
        driving_video: frames that the motion was fitted to.
        conversion: parameters that all steps share.
        tasks: tasks of the engine.
        fitted: the cloud was fitted to the video, so that a mesh may follow the video and takes its colors; not
            splats of the user's.
        guessed: subject whose shape the learned prior has guessed from its picture alone.
    """
    guide = driving_video if fitted else None
    planned = tasks.plan_mesh(gaussians, motion, conversion, guide, subject=guessed)
    plan: Plan | Mesh = planned
    if read_plan(home.store().path(planned.plan)).mode == "tracked":
        plan = tasks.extract_mesh(gaussians, motion, planned, conversion, guide, subject=guessed)
        if "plan" not in plan.outputs:
            return plan
    frames = count_frames(driving_video.frames, home.store())
    parts = divide_frames(frames, conversion.mesh_parts or resources.cpus())
    extracted = [tasks.extract_mesh.submit(gaussians, motion, plan, conversion, guide, part) for part in parts]
    meshes = [future.result() for future in extracted]
    return meshes[0] if len(meshes) == 1 else tasks.join_meshes(meshes, conversion)
