"""A video becomes an animated 3D asset that moves as it does."""

from prefect import flow

from flows.engine.executors import StepBadInput
from flows.engine.tasks import Made, Steps
from flows.image_to_4d import RUNNER, finish
from steps.contract import ArtifactRef
from steps.profiles import PipelineSettings, step_settings


@flow(
    name="video_to_4d",
    flow_run_name="{item}",
    task_runner=RUNNER,
    persist_result=False,
)
def video_to_4d(
    source: ArtifactRef,
    settings: PipelineSettings,
    seed: int = 0,
    item: str = "asset",
    bank: ArtifactRef | None = None,
) -> Made:
    """As `image_to_4d`, but the subject is the first frame of the video and the motion is the video's.

    Raises:
        StepError: a step did not finish; says which and why.
    """
    with Steps(item, seed) as steps:
        prepared = steps.run("prepare_subject", {"source": source}, step_settings("prepare_subject", settings))
        if "footage" not in prepared:
            raise StepBadInput(
                "prepare_subject", "this is a single picture, not a video: a video has two frames or more"
            )
        return finish(steps, prepared, settings, bank)
