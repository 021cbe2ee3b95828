"""Input of a step's code, and its report."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

Progress = Callable[[int, int, dict[str, float]], None]
Draw = Callable[[], bytes]  # returns a PNG


def ignore(_: Draw) -> None:
    """Discard a picture."""


@dataclass(frozen=True)
class Job:
    """One run of one step.

    Attributes:
        inputs: files by port, without optional inputs that were not given.
        outputs: paths to write by port; optional outputs may be left out.
        settings: instance of the step's settings class.
        seed: seed of all random generators of the step.
        progress: callback (done, total, values to show); calls are cheap.
        pictures: folder for pictures that explain a failure.
        show: callback for an intermediate picture, PNG; it renders one every few seconds, or none.
    """

    inputs: Mapping[str, Path]
    outputs: Mapping[str, Path]
    settings: Any
    seed: int
    progress: Progress
    pictures: Path
    show: Callable[[Draw], None] = ignore


@dataclass(frozen=True)
class StepReport:
    """Part of the provenance record that the step's code contributes.

    Attributes:
        backend: rasterizer or library that computed, for example "cpu (numba)".
        weights: digests of weights files, by name.
        licenses: licenses that apply to the asset, by name of the weights.
        notes: sentences for the user's report.
        run_notes: notes about this run alone, for example that batches were halved when memory ran out.
    """

    backend: str = "cpu"
    weights: dict[str, str] = field(default_factory=dict)
    licenses: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    run_notes: tuple[str, ...] = ()
