"""Words become an animated 3D asset."""

from prefect import flow

from flows.engine.tasks import Made, Steps
from flows.image_to_4d import RUNNER, finish
from steps.contract import ArtifactRef
from steps.profiles import PipelineSettings


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
        picture = steps.run("draw_picture", {"text": source}, settings.text)["picture"]
        prepared = steps.run("prepare_subject", {"source": picture}, settings.subject)
        return finish(steps, prepared, settings, bank)
