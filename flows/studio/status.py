"""Status of a conversion for the studio page, from Prefect's runs, tasks and artifacts alone."""

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError

from flows.engine.events import StepEvent
from flows.engine.schedule import Schedule, format_left, keep_durations, load_durations
from flows.inputs.conversion_job import ConversionJob
from flows.inputs.package_record import record_of
from flows.stages import planned_steps
from flows.studio.server_api import Row, ServerApi
from flows.studio.submission import asset_tag
from flows.ui.pages import LIVE
from steps.contract import Frozen

FIGURES = re.compile(r": (\d+)/(\d+)((?:, .+)?)$")  # at the end of the description of a progress artifact
PICTURE = re.compile(r"\((/dg4d/artifacts/[0-9a-f]{64}/\d+/picture\.png)\)")
LOOK = re.compile(r"\((/dg4d/viewer/[0-9a-f]{64}/\d+/first_look\.html)\)")
WRAPPING = re.compile(r"^Flow run encountered an exception: (?:\w+: )?")
WORDS = {
    "SCHEDULED": "waiting",
    "PENDING": "waiting",
    "PAUSED": "waiting",
    "RUNNING": "running",
    "COMPLETED": "done",
    "FAILED": "failed",
    "CRASHED": "crashed",
    "CANCELLING": "cancelling",
    "CANCELLED": "cancelled",
}
TITLES = {
    "prepare_subject": "Cut out the subject",
    "prepare_views": "Read the other sides",
    "prepare_asset": "Read the model",
    "drive_video": "Make the driving video",
    "fit_gaussians": "Fit the shape",
    "fit_motion": "Fit the motion",
    "animate_asset": "Fit the motion",
    "plan_mesh": "Plan the mesh",
    "extract_mesh": "Extract the mesh",
    "join_meshes": "Join the meshes",
    "refine_texture": "Refine the texture",
    "pack_asset": "Write the files",
    "check_asset": "Check the quality",
}
USUAL = ("prepare_subject", "drive_video", "fit_gaussians", "fit_motion", "plan_mesh", "extract_mesh", "pack_asset",
         "check_asset")  # fmt: skip


class StepStatus(Frozen):
    """State of one step.

    Attributes:
        fraction: finished part of a running step, from 0 to 1.
        figures: numbers that a running step reports, such as losses.
        seconds: duration of a finished step.
    """

    name: str
    title: str
    state: str = "waiting"
    fraction: float = 0.0
    figures: dict[str, float] = Field({})
    seconds: float | None = None


class RunStatus(Frozen):
    """State of one conversion.

    Attributes:
        left: estimate of the time left, in words; empty while it is unknown.
        picture: address of the newest picture of the asset; empty if there is none.
        first_look: address of the page with its static splats; empty before there are any.
        asset: address of the page of the asset; empty before it is finished.
        items: name and state of the items of a batch.
    """

    id: str
    name: str
    profile: str
    state: str
    message: str
    steps: tuple[StepStatus, ...] = ()
    left: str = ""
    picture: str = ""
    first_look: str = ""
    asset: str = ""
    is_batch: bool = False
    items: tuple[tuple[str, str], ...] = ()

    @property
    def has_ended(self) -> bool:
        """True if the run is in a final state."""
        return self.state in {"done", "failed", "cancelled"}


def summary(run: Row) -> RunStatus:
    """Return the status of a run without its steps."""
    state = WORDS.get(run["state_type"] or "SCHEDULED", "waiting")
    asset = ""
    if state == "done" and "inputs" not in run["parameters"]:
        asset = f"/dg4d/studio/assets/{asset_tag(name_of(run))}"
        record = record_of(Path(run["parameters"]["out"]))
        if record is not None:
            asset += f"?v={str(record.get('order', '')).removeprefix('sha256:')[:16]}"
    return RunStatus(
        id=run["id"],
        name=name_of(run),
        profile=str((run["parameters"].get("options") or {}).get("profile", "")),
        state=state,
        message=message_of(run),
        asset=asset,
        is_batch="inputs" in run["parameters"],
    )


async def full(run: Row, api: ServerApi, now: float) -> RunStatus:
    """Return the status of a run with its steps, newest picture and time left.

    Args:
        run: flow run that the page started.
        api: of the server.
        now: seconds since the epoch.
    """
    short = summary(run)
    children = await api.children(run["id"])
    if short.is_batch:
        latest = {str(child["name"]): WORDS.get(child["state_type"], "waiting") for child in children}
        return short.model_copy(update={"items": tuple(latest.items())})
    names = [child["id"] for child in children]
    tasks = await api.tasks(names) if names else []
    artifacts = await api.artifacts(names) if names else []
    planned = _planned(children, run["parameters"])
    schedule = Schedule(planned, load_durations(short.profile))
    steps = steps_of(planned, tasks, artifacts, schedule)
    if short.state == "done":  # Prefect records the ends of tasks a moment after that of their flow
        keep_durations(short.profile, schedule.durations())
        steps = tuple(step.model_copy(update={"state": "done", "fraction": 1.0}) for step in steps)
    running = short.state == "running"
    return short.model_copy(
        update={
            "steps": steps,
            "left": format_left(schedule.seconds_left(now)) if running else "",
            "picture": newest_picture(artifacts),
            "first_look": newest_splats_page(artifacts),
        }
    )


def steps_of(
    planned: Sequence[str], tasks: Iterable[Row], artifacts: Iterable[Row], schedule: Schedule
) -> tuple[StepStatus, ...]:
    """Return the states of the planned steps, and note their events in the schedule.

    Args:
        planned: names of the steps in their order.
        tasks: task runs of all attempts.
        artifacts: of the same flow runs.
        schedule: of the conversion, with times in seconds since the epoch.
    """
    progress = _progress(artifacts)
    latest: dict[str, Row] = {}
    for row in sorted(tasks, key=lambda each: str(each["start_time"] or each["created"])):
        latest[str(row["name"]).partition(": ")[0].partition(" ")[0]] = row
    found = []
    for name in planned:
        task = latest.get(name, {})
        state = WORDS.get(task.get("state_type") or "SCHEDULED", "waiting")
        status = StepStatus(name=name, title=TITLES.get(name, name), state=state)
        if task.get("start_time"):
            began = _seconds(task["start_time"])
            schedule.note(StepEvent("", name, "started"), began)
            done, total, figures = progress.get(task["id"], (0, 1, {}))
            if state == "running":
                schedule.note(StepEvent("", name, "progress", done=done, total=total), began)
                status = status.model_copy(update={"fraction": done / max(total, 1), "figures": figures})
            if state == "done" and task["end_time"]:
                ended = _seconds(task["end_time"])
                cached = task["state_name"] == "Cached"
                schedule.note(StepEvent("", name, "finished", seconds=ended - began, cached=cached), ended)
                status = status.model_copy(update={"fraction": 1.0, "seconds": round(ended - began, 1)})
        found.append(status)
    return tuple(found)


def newest_picture(artifacts: Iterable[Row]) -> str:
    """Return the address of the newest picture: of a running fit, or of the last step that has one."""
    for artifact in sorted(artifacts, key=lambda row: str(row["updated"]), reverse=True):
        data = str(artifact["data"])
        if str(artifact["key"]).startswith(LIVE):
            return data
        if match := PICTURE.search(data):
            return match[1]
    return ""


def newest_splats_page(artifacts: Iterable[Row]) -> str:
    """Return the address of the newest page with static splats."""
    for artifact in sorted(artifacts, key=lambda row: str(row["updated"]), reverse=True):
        if match := LOOK.search(str(artifact["data"])):
            return match[1]
    return ""


def message_of(run: Row) -> str:
    """Return the reason of a failure as a sentence; empty for other states."""
    state = run["state"] or {}
    if state.get("type") == "SCHEDULED" and state.get("name") == "AwaitingRetry":
        return "The process was killed. The run resumes after the last finished step shortly."
    if state.get("type") == "CRASHED":
        return "The process was killed or its machine is unreachable. The run restarts automatically within a minute."
    if state.get("type") != "FAILED":
        return ""
    return WRAPPING.sub("", str(state.get("message") or "The run failed; see its page in Prefect."))


def name_of(run: Row) -> str:
    """Return the name of the asset or batch of a run."""
    parameters = run["parameters"]
    source = parameters.get("model") or parameters.get("picture") or parameters.get("video")
    return Path(source).stem if source else str(run["name"])


def _planned(children: Sequence[Row], parameters: Mapping[str, Any]) -> list[str]:
    """Return the steps that a conversion runs, by its job, or before there is one the usual ones."""
    for child in reversed(children):
        with suppress(ValidationError, KeyError, TypeError):
            return planned_steps(ConversionJob.model_validate(child["parameters"]["job"]))
    if "model" in parameters:
        return ["prepare_asset", "drive_video", "animate_asset", "pack_asset", "check_asset"]
    return list(USUAL)


def _progress(artifacts: Iterable[Row]) -> dict[str, tuple[int, int, dict[str, float]]]:
    """Return iterations done, iterations in all, and figures of the steps that report progress, by task run."""
    found = {}
    for artifact in artifacts:
        match = FIGURES.search(str(artifact["description"] or "")) if artifact["type"] == "progress" else None
        if match and artifact["task_run_id"] not in found:
            figures = {}
            for part in match[3].split(", ")[1:]:
                name, _, value = part.rpartition(" ")
                with suppress(ValueError):
                    figures[name] = float(value.replace(",", ""))
            found[artifact["task_run_id"]] = int(match[1]), int(match[2]), figures
    return found


def _seconds(time: str) -> float:
    return datetime.fromisoformat(time).timestamp()
