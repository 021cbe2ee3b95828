"""Result of a conversion: its package, and a record of every step run."""

from collections.abc import Iterable

from steps.contract import ArtifactRef, Frozen, StepResult


class StepRun(Frozen):
    """One finished run of a step.

    Attributes:
        label: name of the step, and the number of the part where its frames were divided.
        cached: whether the result existed before.
        wall_s: seconds from the start of the task run to its end.
        waited_s: seconds of these in which it waited for its turn on the machine.
        result: outputs and provenance.
    """

    label: str
    cached: bool
    wall_s: float
    waited_s: float = 0.0
    result: StepResult


class FlowResult(Frozen):
    """Result of a conversion flow.

    Attributes:
        package: a zip in the store.
        steps: in the order of the pipeline.
        flow_run: id of the flow run.
        wall_s: seconds from the first step to the last.
    """

    package: ArtifactRef
    steps: list[StepRun]
    flow_run: str = ""
    wall_s: float = 0.0


def notes_of(results: Iterable[StepResult]) -> tuple[str, ...]:
    """Return the notes about the asset, each sentence once; notes about one run are left out."""
    return tuple(dict.fromkeys(note for result in results for note in result.provenance.notes))
