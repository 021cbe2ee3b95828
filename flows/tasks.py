"""Tasks of the pipeline, one per step: typed, cached by the digest of their request, retried where that may help."""

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

from flows import step_calls
from flows.engine.step_tasks import finished_steps, step_task
from flows.stages import StepTask, Tasks
from flows.step_calls import DrivingVideo, Gaussians, Mesh, Motion, Package, Picture, Plan, Scores, Subject, Verdict
from steps.contract import StepResult

__all__ = ["DrivingVideo", "Gaussians", "Mesh", "Motion", "Package", "Picture", "Plan", "Scores", "Subject", "Verdict"]
# records of earlier versions name the classes here

P = ParamSpec("P")
R = TypeVar("R", bound=StepResult)

draw_picture = step_task(step_calls.draw_picture)
prepare_subject = step_task(step_calls.prepare_subject)
prepare_views = step_task(step_calls.prepare_views)
generate_views = step_task(step_calls.generate_views)
prepare_asset = step_task(step_calls.prepare_asset)
animate_asset = step_task(step_calls.animate_asset)
drive_video = step_task(step_calls.drive_video)
fit_gaussians = step_task(step_calls.fit_gaussians)
fit_motion = step_task(step_calls.fit_motion)
plan_mesh = step_task(step_calls.plan_mesh)
extract_mesh = step_task(step_calls.extract_mesh)
join_meshes = step_task(step_calls.join_meshes)
refine_texture = step_task(step_calls.refine_texture)
pack_asset = step_task(step_calls.pack_asset)
check_asset = step_task(step_calls.check_asset)
score_asset = step_task(step_calls.score_asset)


def _task_of(call: Callable[P, R]) -> StepTask[P, R]:
    return cast("StepTask[P, R]", globals()[call.__name__])


TASKS = Tasks(_task_of, finished_steps)
