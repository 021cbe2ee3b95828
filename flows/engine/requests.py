"""Requests of steps, made from the arguments of their calls."""

import time
from collections.abc import Iterable, Mapping
from typing import Any

from pydantic import Field

from dg4d_lib.settings import Settings
from flows.packages.flow_result import StepRun
from steps.contract import LARGEST_SEED, ArtifactRef, Frozen, StepRequest, StepResult
from steps.profiles import PipelineSettings, step_settings
from steps.runtime.installed_code import catalog, request_version
from steps.runtime.weights import identities, weights_in


class Conversion(Frozen):
    """Values that all steps of one conversion share.

    Attributes:
        item: name of the asset.
        settings: settings of the whole pipeline; a step reads its sections.
        seed: seed of every step.
        begun_ns: start of the conversion, nanoseconds since the epoch; earlier conversions go first on a machine.
        mesh_parts: number of tasks that extract a mesh per frame; 0: one per slot of this machine.
    """

    item: str
    settings: PipelineSettings
    seed: int = Field(0, ge=0, le=LARGEST_SEED)
    begun_ns: int = Field(default_factory=time.time_ns)
    mesh_parts: int = 0


class Part(Frozen):
    """Frames that one task of a divided step works on: from `first_frame` up to, not including, `end_frame`."""

    number: int
    of: int
    first_frame: int
    end_frame: int

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"


def request_for(step: str, arguments: Mapping[str, Any]) -> StepRequest:
    """Return the request of a step, made from the arguments of its task.

    Artifacts go to the input ports of their name: an `ArtifactRef` by the name of the argument, the outputs of an
    earlier step by their own names; the results in a list go to a port that takes many, numbered. A `Part` and
    every other value become settings of the step, unless its whole settings are among the arguments.
    """
    spec = catalog()[step]
    inputs: dict[str, ArtifactRef] = {}
    values: dict[str, Any] = {}
    settings: Settings | None = None
    conversion: Conversion = arguments["conversion"]
    for name, value in arguments.items():
        match value:
            case Conversion() | None:
                pass
            case ArtifactRef():
                inputs[name] = value
            case StepResult():
                inputs |= {port: ref for port, ref in value.outputs.items() if spec.input_port(port)}
            case [StepResult(), *_]:
                inputs |= {
                    f"{port}_{number:03d}": ref
                    for number, result in enumerate(value)
                    for port, ref in result.outputs.items()
                    if port in spec.inputs
                }
            case Settings():
                settings = value
            case Part():
                values |= {"first_frame": value.first_frame, "end_frame": value.end_frame}
            case _:
                values[name] = value
    settings = settings or step_settings(step, conversion.settings, **values)
    tree = settings.model_dump(mode="json")
    return StepRequest(
        step=step,
        version=request_version(spec),
        inputs=inputs,
        settings=tree,
        seed=conversion.seed,
        weights=identities(weights_in(tree)),
    )


def label_of(step: str, arguments: Mapping[str, Any]) -> str:
    """Return the name of a step, with the part of its frames where they were divided: `extract_mesh 1/3`."""
    part = arguments.get("part")
    return f"{step} {part}" if part else step


def in_order(finished: Iterable[StepRun]) -> list[StepRun]:
    """Sort step runs in the order of the catalog, parts by their numbers."""
    order = {name: position for position, name in enumerate(catalog())}

    def position(done: StepRun) -> tuple[int, int]:
        step, _, part = done.label.partition(" ")
        return order[step], int(part.partition("/")[0] or 0)

    return sorted(finished, key=position)
