"""Time per stage of one conversion, before and after, in one run.

Run with `python -m benchmarks.preview examples/newt.png` (`--before CHECKOUT`, `--turns 1`, `--set KNOB=VALUE`, `--json
FILE` keeps the rows). `after` is `dg4d make` of this code. `before` is that of another checkout of the project, or
without `--before` this code with the settings of the fits that do not save time (`WITHOUT`). Each first makes a small
asset, which compiles the kernels; then every turn converts the picture in a new home folder, from the command without a
running server to the package. Wall time is reported, so run nothing else; on a busy machine the CPU seconds say more.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from rich.console import Console
from rich.table import Table

from benchmarks.measure import machine, new_console, parser_of, write_rows
from flows.inputs.package_record import RECORD

HERE = Path(__file__).resolve().parents[1]
FIRST_LOOK = "Preview of the static splats"  # begins the line that names the page of the static splats
TO_FIRST_LOOK, TO_PACKAGE = "command to first look", "command to package"
WITHOUT = (
    "static.viewpoints=0",
    "static.reference_schedule=[]",
    "motion.viewpoints=0",
    "motion.reference_schedule=[]",
    "motion.guided_frames=0",
)
SMALL = ("static.iterations=3", "motion.iterations=3", "driving.frames=3")


@dataclass(frozen=True)
class Side:
    """One of the two programs that are compared.

    Attributes:
        name: `before` or `after`.
        checkout: folder of its code.
        changes: settings, as `dg4d make --set`.
    """

    name: str
    checkout: Path
    changes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Row:
    """Stage of both sides: medians over the turns, seconds; 0 where a side does not have it.

    Attributes:
        stage: name of a step, or of a time since the start of the command.
        before_s: wall time.
        after_s: wall time.
        before_cpu_s: CPU time of the process of the step; 0 for times from the command on.
        after_cpu_s: likewise.
    """

    stage: str
    before_s: float
    after_s: float
    before_cpu_s: float
    after_cpu_s: float


def main() -> None:
    """Convert a picture with both sides in turn, and print the stages."""
    parser = parser_of(__doc__)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--before", type=Path, metavar="CHECKOUT", help="another checkout of the project")
    parser.add_argument("--turns", type=int, default=1)
    parser.add_argument("--set", action="append", default=[], metavar="KNOB=VALUE", help="as `dg4d make --set`")
    options = parser.parse_args()
    before = Side("before", options.before.resolve()) if options.before else Side("before", HERE, WITHOUT)
    rows = compare(options.picture.resolve(), (before, Side("after", HERE)), options.turns, tuple(options.set))
    show(rows, new_console())
    if options.json:
        write_rows(options.json, rows)


def compare(picture: Path, sides: tuple[Side, Side], turns: int, changes: tuple[str, ...]) -> list[Row]:
    """Return the stages of both sides, in the order in which they ran."""
    taken: dict[str, list[dict[str, tuple[float, float]]]] = {}
    for side in sides:
        convert(picture, side, (*changes, *SMALL))
    for turn in range(turns):
        for side in sides if turn % 2 == 0 else sides[::-1]:
            taken.setdefault(side.name, []).append(convert(picture, side, changes))
    first, second = (taken[side.name] for side in sides)
    stages = dict.fromkeys([*first[0], *second[0]])
    medians = [[_median(runs, stage) for runs in (first, second)] for stage in stages]
    return [
        Row(stage, before[0], after[0], before[1], after[1])
        for stage, (before, after) in zip(stages, medians, strict=True)
    ]


def convert(picture: Path, side: Side, changes: tuple[str, ...]) -> dict[str, tuple[float, float]]:
    """Convert a picture; return wall and CPU seconds by stage.

    Raises:
        CalledProcessError: the command failed.
    """
    with tempfile.TemporaryDirectory(prefix="dg4d-preview-") as folder:
        out = Path(folder) / "out"
        knobs = [word for knob in (*side.changes, *changes) for word in ("--set", knob)]
        command = [sys.executable, "-m", "flows.cli", "make", str(picture), "-o", str(out), *knobs]
        place = {**os.environ, "DG4D_HOME": str(Path(folder) / "home"), "PYTHONPATH": str(side.checkout)}
        start = time.perf_counter()
        looked = 0.0
        try:
            with subprocess.Popen(command, env=place, cwd=side.checkout, stdout=subprocess.PIPE, text=True) as running:
                assert running.stdout is not None  # a pipe
                for line in running.stdout:
                    looked = time.perf_counter() - start if FIRST_LOOK in line else looked
            whole = time.perf_counter() - start
            if running.returncode:
                raise subprocess.CalledProcessError(running.returncode, command)
        finally:
            subprocess.run(
                [sys.executable, "-m", "flows.cli", "down"],
                env=place,
                cwd=side.checkout,
                stdout=subprocess.DEVNULL,
                check=False,
            )
        steps = json.loads((out / RECORD).read_text(encoding="utf-8"))["run"]["steps"]
    found: dict[str, tuple[float, float]] = {}
    for ran in steps:
        name = ran["step"].partition(" ")[0]  # "extract_mesh 1/2" is one part
        wall, cpu = found.get(name, (0.0, 0.0))
        found[name] = wall + ran["duration_s"], cpu + ran["cpu_s"]
    return {**found, TO_FIRST_LOOK: (looked, 0.0), TO_PACKAGE: (whole, 0.0)}


def _median(runs: list[dict[str, tuple[float, float]]], stage: str) -> tuple[float, float]:
    walls, cpus = zip(*(run.get(stage, (0.0, 0.0)) for run in runs), strict=True)
    return median(walls), median(cpus)


def show(rows: list[Row], console: Console) -> None:
    """Print the rows as a table."""
    table = Table(
        "stage", "before, s", "after, s", "before, CPU s", "after, CPU s", title=f"One conversion ({machine()})"
    )
    for row in rows:
        cells = (row.before_s, row.after_s, row.before_cpu_s, row.after_cpu_s)
        table.add_row(row.stage, *(f"{value:.1f}" if value else "" for value in cells))
    console.print(table)


if __name__ == "__main__":
    main()
