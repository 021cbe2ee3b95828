"""Progress of a conversion for callers of the API."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal

from flows.engine.events import StepEvent, listening_in_context
from flows.engine.schedule import Schedule, format_left, keep_durations, load_durations
from flows.inputs.conversion_job import ConversionJob
from flows.stages import planned_steps


@dataclass(frozen=True)
class Progress:
    """Event of one step.

    Attributes:
        item: name of the asset.
        step: name of the step, with its part if its frames are divided.
        kind: `started`, `progress`, `note`, `remark`, `finished` or `failed`.
        number: position of the step from 1 on; 0 for a step that was not planned.
        of: number of planned steps.
        fraction: completed fraction of this step, 0 to 1.
        seconds_left: estimate for the whole conversion; None while too little is known.
        values: current metrics of the step, such as its loss.
        text: text of a note or a remark.
        cached: true if a finished step was taken from an earlier conversion.
    """

    item: str
    step: str
    kind: Literal["started", "progress", "note", "remark", "finished", "failed"]
    number: int
    of: int
    fraction: float = 0.0
    seconds_left: float | None = None
    values: dict[str, float] = field(default_factory=dict)
    text: str = ""
    cached: bool = False

    def __str__(self) -> str:
        """Return one line such as "step 4 of 8: fit_motion 40 %, about 25 s left"."""
        place = f"step {self.number} of {self.of}: " if self.number else ""
        state = self.text or (f"{self.fraction:.0%}".replace("%", " %") if self.kind == "progress" else self.kind)
        return ", ".join(filter(None, [f"{place}{self.step} {state}", format_left(self.seconds_left)]))


OnProgress = Callable[[Progress], None]


@contextmanager
def reporting(job: ConversionJob, on_progress: OnProgress | None) -> Iterator[None]:
    """Report the steps of a job while the block runs, and remember their durations if it succeeds.

    An exception of the callback ends the conversion: it is raised again in every step that reports later.
    """
    schedule = Schedule(planned_steps(job), load_durations(job.profile))
    raised: list[BaseException] = []

    def listen(event: StepEvent) -> None:
        schedule.note(event)
        if raised and event.kind != "failed":
            raise raised[0]
        if on_progress is not None and not raised:
            try:
                on_progress(_progress(event, schedule))
            except BaseException as error:
                raised.append(error)
                raise

    with listening_in_context(listen):
        yield
    keep_durations(job.profile, schedule.durations())


def _progress(event: StepEvent, schedule: Schedule) -> Progress:
    fraction = event.done / max(event.total, 1) if event.kind == "progress" else float(event.kind == "finished")
    return Progress(
        item=event.item,
        step=event.step,
        kind=event.kind,
        number=schedule.number(event.step),
        of=len(schedule.steps),
        fraction=fraction,
        seconds_left=schedule.seconds_left(),
        values=dict(event.values),
        text=event.text,
        cached=event.cached,
    )
