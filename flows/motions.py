"""The motions that a picture could make, judged and shown, so that a person can choose."""

import json
from pathlib import Path
from typing import Any

from prefect import flow

from flows import home
from flows.engine.executors import StepBadInput
from flows.engine.tasks import Steps
from steps.artifacts.archives import unpack as unpack_zip
from steps.contract import ArtifactRef
from steps.profiles import PipelineSettings, step_settings


@flow(name="motions", flow_run_name="{item}", persist_result=False)
def motions(
    source: ArtifactRef, settings: PipelineSettings, seed: int = 0, item: str = "asset"
) -> dict[str, ArtifactRef]:
    """Prepare the subject and hold the tournament of `drive_video`; its outputs by name.

    Raises:
        StepError: a step did not finish; says which and why.
    """
    with Steps(item, seed) as steps:
        prepared = steps.run("prepare_subject", {"source": source}, step_settings("prepare_subject", settings))
        if "footage" in prepared:
            raise StepBadInput("prepare_subject", "this is a video and has its motion already; give a picture")
        return steps.run("drive_video", {"subject": prepared["subject"]}, step_settings("drive_video", settings))


def unpack(made: dict[str, ArtifactRef], folder: Path) -> dict[str, Any]:
    """Put the sheet, the ranking and a film per candidate into a folder; the ranking."""
    store = home.store()
    folder.mkdir(parents=True, exist_ok=True)
    store.get(made["candidates"], folder / "motions.png")
    store.get(made["ranking"], folder / "motions.json")
    unpack_zip(store.path(made["films"]), folder, "the zip of films")
    ranking: dict[str, Any] = json.loads((folder / "motions.json").read_text(encoding="utf-8"))
    return ranking
