"""Interleaved timing of functions, so that other load of the machine affects all of them equally.

Compare CPU time (user and system, all threads of the process); wall time depends on other processes.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

from rich.console import Console

WIDTH = 150  # columns of tables written to a file
os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # busy-waiting threads of torch would count as CPU time
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the steps


@dataclass(frozen=True)
class Times:
    """Medians over the rounds, milliseconds per call."""

    cpu_ms: float
    wall_ms: float

    def per(self, parts: float) -> "Times":
        """Return the times of one of this many equal parts of a call."""
        return Times(self.cpu_ms / parts, self.wall_ms / parts)


def interleaved(functions: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, Times]:
    """Call every function once untimed, then all in turn `rounds` times; return the medians of each.

    The order turns round from one round to the next, so that none always follows the same one.
    """
    for function in functions.values():
        function()
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in functions}
    for turn in range(rounds):
        names = list(functions) if turn % 2 == 0 else list(functions)[::-1]
        for name in names:
            wall, cpu = time.perf_counter(), time.process_time()
            functions[name]()
            taken[name].append((time.process_time() - cpu, time.perf_counter() - wall))
    return {
        name: Times(median(cpu for cpu, _ in pairs) * 1e3, median(wall for _, wall in pairs) * 1e3)
        for name, pairs in taken.items()
    }


def machine() -> str:
    """Return a title for tables of times: processor, number of cores and load."""
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "processor")
    return f"{model}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"


def new_console() -> Console:
    """Return a console as wide as the terminal, or wide enough for all tables without one."""
    return Console(width=None if sys.stdout.isatty() else WIDTH)


def parser_of(about: str | None, quick: str = "") -> argparse.ArgumentParser:
    """Return the argument parser of a benchmark with `--json` and, optionally, `--quick`.

    Args:
        about: docstring of its module; the first line is shown.
        quick: description of `--quick`; empty: no such option.
    """
    parser = argparse.ArgumentParser(description=(about or "").partition("\n")[0])
    if quick:
        parser.add_argument("--quick", action="store_true", help=quick)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows to FILE")
    return parser


def write_rows(path: Path, rows: Iterable[Any]) -> None:
    """Write dataclasses of numbers as `{"rows": [...]}`."""
    path.write_text(json.dumps({"rows": [asdict(row) for row in rows]}, indent=1) + "\n", encoding="utf-8")
