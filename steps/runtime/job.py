"""Input and report of a step's code."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

Progress = Callable[[int, int, dict[str, float]], None]


@dataclass(frozen=True)
class Job:
    """One run of one step.

    Attributes:
        inputs: files by port; an optional input that was not given is absent.
        outputs: paths to write by port; an optional output may stay unwritten.
        settings: instance of the step's settings class.
        seed: seed of every random generator of the step.
        progress: callback (done, total, values to show); calls are cheap.
        pictures: folder for pictures that explain a failure; they are kept.
    """

    inputs: Mapping[str, Path]
    outputs: Mapping[str, Path]
    settings: Any
    seed: int
    progress: Progress
    pictures: Path


@dataclass(frozen=True)
class StepReport:
    """Facts that only the step knows, for the provenance record.

    Attributes:
        backend: rasterizer or library that computed, for example "cpu (numba)".
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
