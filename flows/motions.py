"""Flow that generates and ranks candidate motions of a picture, for `dg4d motions`."""

import json
from pathlib import Path
from typing import Any

from prefect import flow

from flows import home
from flows.engine.step_tasks import steps_of_flow
from flows.inputs.conversion_job import ConversionJob
from flows.pipeline import conversion_of
from flows.step_errors import StepBadInput
from flows.tasks import drive_video, prepare_subject
from steps.artifacts.archives import unpack as unpack_zip
from steps.contract import ArtifactRef


@flow(name="motions", flow_run_name="{job.item}", persist_result=False)
def motions(job: ConversionJob) -> dict[str, ArtifactRef]:
    """Prepare the subject and rank the candidates of `drive_video`; return its outputs by name.

    Raises:
        StepError: a step did not finish.
    """
    with steps_of_flow():
        conversion = conversion_of(job)
        subject = prepare_subject(job.source, conversion)
        if subject.footage is not None:
            raise StepBadInput("prepare_subject", "this is a video and has its motion already; give a picture")
        return drive_video(subject, conversion).outputs


def unpack(outputs: dict[str, ArtifactRef], folder: Path) -> dict[str, Any]:
    """Write contact sheet, ranking and a film per candidate into a folder; return the ranking."""
    store = home.store()
    folder.mkdir(parents=True, exist_ok=True)
    store.get(outputs["candidates"], folder / "motions.png")
    store.get(outputs["ranking"], folder / "motions.json")
    unpack_zip(store.path(outputs["films"]), folder, "the zip of films")
    ranking: dict[str, Any] = json.loads((folder / "motions.json").read_text(encoding="utf-8"))
    return ranking
