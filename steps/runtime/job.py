"""What a step's code gets and gives back."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

Progress = Callable[[int, int, dict[str, float]], None]


@dataclass(frozen=True)
class Job:
    """One run of one step.

    Attributes:
        inputs: the files that were given, by port; an optional input that was not given is absent.
        outputs: where to write each output; an optional output may stay unwritten.
        settings: an instance of the step's settings class.
        seed: of every random generator the step makes.
        progress: call with (done, total, values to show) as often as you like.
        pictures: a folder for pictures that explain a failure; they survive it.
    """

    inputs: Mapping[str, Path]
    outputs: Mapping[str, Path]
    settings: Any
    seed: int
    progress: Progress
    pictures: Path


@dataclass(frozen=True)
class StepReport:
    """What only the step can know, for the provenance record.

    Attributes:
        backend: what computed, for example "cpu (numba)".
        weights: digest of every weights file, by name; empty where none were used.
        licenses: license of everything whose license follows the asset, by name.
        notes: sentences the user should read in the report.
        run_notes: such sentences about this run alone, for example that memory ran out and batches were halved.
    """

    backend: str = "cpu"
    weights: dict[str, str] = field(default_factory=dict)
    licenses: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    run_notes: tuple[str, ...] = ()
