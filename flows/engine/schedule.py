"""Schedule of a conversion: position of its steps, and an estimate of the time left."""

import json
import math
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from flows import home
from flows.engine.events import StepEvent
from flows.inputs.json_text import read_object
from steps.store.files import write_atomically

USUAL_S: Mapping[str, float] = {  # seconds of the profile `preview` on two cores; only their ratios count
    "draw_picture": 60.0,
    "prepare_subject": 1.0,
    "prepare_views": 3.0,
    "generate_views": 60.0,  # a diffusion model, as in draw_picture
    "prepare_asset": 5.0,
    "animate_asset": 100.0,
    "drive_video": 1.0,
    "fit_gaussians": 10.0,
    "fit_motion": 47.0,
    "plan_mesh": 6.0,
    "extract_mesh": 38.0,
    "join_meshes": 3.0,
    "refine_texture": 60.0,
    "pack_asset": 12.0,
    "check_asset": 3.0,
}
KNOWN_SHARE = 0.05  # share of the expected work from which the pace of this run is used
OWN_PACE = 0.1  # fraction of a step, from which on its own pace predicts its end
SHORT_MINUTES = 2  # up to here times are given in seconds


class Schedule:
    """Steps of one conversion with estimates of their times.

    Args:
        steps: names of the steps in their order.
        expected: seconds of the steps in an earlier conversion; missing ones have their usual ratio to the others.
    """

    def __init__(self, steps: Sequence[str], expected: Mapping[str, float] | None = None) -> None:
        self.steps = list(steps)
        known = {name: value for name, value in (expected or {}).items() if name in USUAL_S}
        pace = _pace((seconds, USUAL_S[name]) for name, seconds in known.items())
        self._expected = {name: known.get(name, pace * USUAL_S.get(name, 1.0)) for name in self.steps}
        self._is_measured = bool(known)
        self._began: dict[str, float] = {}
        self._fraction: dict[str, float] = {}
        self._ended: dict[str, tuple[float, bool]] = {}  # seconds, and true if the step was cached
        self._parts: dict[str, set[str]] = {}
        self._lock = threading.Lock()

    def note(self, event: StepEvent, now: float | None = None) -> None:
        """Take an event of the conversion into account.

        Args:
            event: event of a step.
            now: time of a monotonic clock in seconds.
        """
        name, _, part = event.step.partition(" ")
        if name not in self._expected:
            return
        now = time.monotonic() if now is None else now
        with self._lock:
            match event.kind:
                case "started":
                    self._began.setdefault(name, now)
                case "progress":
                    self._began.setdefault(name, now)
                    self._fraction[name] = event.done / max(event.total, 1) if not part else 0.0
                case "finished":
                    ended = self._parts.setdefault(name, set())
                    ended.add(part)
                    if len(ended) >= int(part.partition("/")[2] or 1):
                        seconds = now - self._began[name] - event.waited_s if name in self._began else event.seconds
                        self._ended[name] = max(seconds, 0.0), event.cached
                case _:
                    pass

    @property
    def finished(self) -> int:
        """Number of planned steps that have ended."""
        return len(self._ended)

    def number(self, label: str) -> int:
        """Return the position of a step from 1 on; 0 if it is not among the planned ones."""
        name = label.partition(" ")[0]
        return self.steps.index(name) + 1 if name in self.steps else 0

    def position(self, label: str) -> str:
        """Return a text such as "step 4 of 8"; empty for a step that was not planned."""
        return f"step {number} of {len(self.steps)}" if (number := self.number(label)) else ""

    def seconds_left(self, now: float | None = None) -> float | None:
        """Estimate the seconds until the last step ends; None while too little is known.

        Args:
            now: time of a monotonic clock in seconds.
        """
        now = time.monotonic() if now is None else now
        with self._lock:
            worked: list[tuple[float, float]] = []  # actual and expected seconds
            rest = []
            for name, expected in self._expected.items():
                if name in self._ended:
                    seconds, cached = self._ended[name]
                    worked += [] if cached else [(seconds, expected)]
                    continue
                fraction = min(self._fraction.get(name, 0.0), 1.0)
                elapsed = now - self._began[name] if name in self._began else 0.0
                if fraction >= OWN_PACE:
                    worked.append((elapsed, fraction * expected))
                rest.append((expected, fraction, elapsed))
            least = KNOWN_SHARE * sum(self._expected.values())
            if self._is_measured:
                worked.append((least, least))  # as fast as in the earlier conversion until more is known
            elif sum(expected for _, expected in worked) < least:
                return None
            pace = _pace(worked)
            return sum((_left(expected * pace, fraction, elapsed) for expected, fraction, elapsed in rest), 0.0)

    def durations(self) -> dict[str, float]:
        """Return the seconds of the steps that were computed."""
        with self._lock:
            return {name: round(seconds, 3) for name, (seconds, cached) in self._ended.items() if not cached}


def load_durations(profile: str) -> dict[str, float]:
    """Return the seconds of the steps in the latest conversion of a profile on this machine; empty if unknown."""
    known = read_object(durations_file()).get(profile)
    if not isinstance(known, dict):
        return {}
    return {name: float(value) for name, value in known.items() if _is_duration(value)}


def keep_durations(profile: str, seconds: Mapping[str, float]) -> None:
    """Remember the seconds of computed steps for the estimates of later conversions."""
    if not seconds:
        return
    path = durations_file()
    known = read_object(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, json.dumps({**known, profile: {**load_durations(profile), **seconds}}, indent=1) + "\n")


def durations_file() -> Path:
    """Return the file of durations of earlier conversions."""
    return home.records().parent / "durations.json"


def format_left(seconds: float | None) -> str:
    """Return a text such as "about 40 s left" or "about 3 min left"; empty if it is unknown or over."""
    if not seconds:
        return ""
    if seconds < 60 * SHORT_MINUTES:
        return f"about {max(5 * math.ceil(seconds / 5), 5)} s left"
    return f"about {math.ceil(seconds / 60)} min left"


def _left(expected: float, fraction: float, elapsed: float) -> float:
    """Return the seconds that a step still needs."""
    if fraction >= OWN_PACE:
        return elapsed * (1 - fraction) / fraction
    return max(expected - elapsed, 0.1 * expected)


def _pace(worked: Iterable[tuple[float, float]]) -> float:
    """Return the median of actual / expected seconds, weighted by the expected ones; 1 if there are none.

    A mean would let one short step that took long multiply all others.
    """
    ratios = sorted((actual / expected, expected) for actual, expected in worked if expected > 0)
    half = sum(expected for _, expected in ratios) / 2
    for ratio, expected in ratios:
        half -= expected
        if half <= 0:
            return ratio
    return 1.0


def _is_duration(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and value >= 0
