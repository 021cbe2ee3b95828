"""Words become an animated 3D asset."""

from prefect import flow

from flows.engine.tasks import Made, Steps
from flows.image_to_4d import RUNNER, finish
from steps.contract import ArtifactRef
from steps.profiles import PipelineSettings, step_settings


@flow(
    name="text_to_4d",
    flow_run_name="{item}",
    task_runner=RUNNER,
    persist_result=False,
)
def text_to_4d(
    source: ArtifactRef,
    settings: PipelineSettings,
    seed: int = 0,
    item: str = "asset",
    bank: ArtifactRef | None = None,
) -> Made:
    """Draw a picture of the words in `source`, then as `image_to_4d`.

    Raises:
        StepError: a step did not finish; says which and why.
    """
    with Steps(item, seed) as steps:
        picture = steps.run("draw_picture", {"text": source}, step_settings("draw_picture", settings))["picture"]
        prepared = steps.run("prepare_subject", {"source": picture}, step_settings("prepare_subject", settings))
        return finish(steps, prepared, settings, bank)
