"""Result of a conversion: package and step runs."""

from collections.abc import Iterable

from steps.contract import ArtifactRef, Frozen, ProvenanceRecord, StepResult


class StepRun(Frozen):
    """One finished run of a step.

    Attributes:
        label: name of the step, and the number of the part if its frames were divided.
        cached: whether the result existed before.
        wall_s: seconds from the start of the task run to its end.
        waited_s: seconds of these spent waiting for a CPU or GPU slot.
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

    @property
    def results(self) -> list[StepResult]:
        """Results of the steps."""
        return [run.result for run in self.steps]

    @property
    def records(self) -> list[ProvenanceRecord]:
        """Provenance records of the steps."""
        return [run.result.provenance for run in self.steps]

    @property
    def licenses(self) -> dict[str, str]:
        """Licenses that apply to the asset, by weights; empty if no weights were used."""
        return {name: terms for record in self.records for name, terms in record.licenses.items()}

    def used_weights(self, *steps: str) -> bool:
        """Return True if one of these steps used pretrained weights."""
        return any(record.weights for record in self.records if record.step in steps)


def notes_of(results: Iterable[StepResult]) -> tuple[str, ...]:
    """Return the notes about the asset, each once, without notes about a single run."""
    return tuple(dict.fromkeys(note for result in results for note in result.provenance.notes))
