"""Speed-up of extracting a mesh per frame, by the number of slots of the machine.

Run with `python -m benchmarks.fan_out PICTURE` (`--slots 1 --slots 2`, `--frames 12`, `--json FILE` keeps the rows).
For every number of slots the product's command converts the picture in a home folder of its own, with
`mesh.mode=per_frame` and short fits. The time is that from the begin of the first part of `extract_mesh` to the end of
the last, in the package's own provenance. Let the machine do nothing else.
"""

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from rich.table import Table

from benchmarks.measure import machine, new_console, parser_of, write_rows
from flows.inputs.package_record import RECORD

SHORT = ("static.iterations=30", "motion.iterations=30", "mesh.mode=per_frame")


@dataclass(frozen=True)
class Row:
    """One conversion.

    Attributes:
        slots: steps that may compute at a time.
        parts: tasks among which the frames were divided.
        seconds: from the begin of the first part to the end of the last.
        speed_up: seconds of the first row over these.
    """

    slots: int
    parts: int
    seconds: float
    speed_up: float


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--slots", type=int, action="append", help="default: 1 and 2")
    parser.add_argument("--frames", type=int, default=12)
    options = parser.parse_args()
    rows: list[Row] = []
    for slots in options.slots or (1, 2):
        parts, seconds = convert(options.picture.resolve(), slots, options.frames)
        rows.append(Row(slots, parts, round(seconds, 2), round((rows[0].seconds if rows else seconds) / seconds, 2)))
    console = new_console()
    console.print(machine())
    console.print(table(rows))
    if options.json:
        write_rows(options.json, rows)


def convert(picture: Path, slots: int, frames: int) -> tuple[int, float]:
    """Convert a picture; return the number of parts of `extract_mesh` and the seconds they took together."""
    with tempfile.TemporaryDirectory(prefix="dg4d-fan-out-", ignore_cleanup_errors=True) as folder:
        environment = {**os.environ, "DG4D_HOME": f"{folder}/dg4d", "DG4D_CPUS": str(slots)}
        command = [sys.executable, "-m", "flows.cli"]
        knobs = [word for knob in (*SHORT, f"driving.frames={frames}") for word in ("--set", knob)]
        try:
            subprocess.run(
                [*command, "make", str(picture), "-o", f"{folder}/out", *knobs],
                env=environment,
                check=True,
                stdout=subprocess.DEVNULL,
            )
        finally:
            subprocess.run([*command, "down"], env=environment, check=True, stdout=subprocess.DEVNULL)
        record = json.loads((Path(folder) / "out" / RECORD).read_text(encoding="utf-8"))
    runs = [run for run in record["run"]["steps"] if run["step"].startswith("extract_mesh")]
    starts = [datetime.fromisoformat(run["started"]).timestamp() for run in runs]
    ends = [start + run["duration_s"] for start, run in zip(starts, runs, strict=True)]
    return len(runs), max(ends) - min(starts)


def table(rows: list[Row]) -> Table:
    """Return a row per number of slots."""
    shown = Table(title="extract_mesh, a mesh per frame")
    for heading in ("slots", "parts", "seconds", "speed-up"):
        shown.add_column(heading, justify="right")
    for row in rows:
        shown.add_row(str(row.slots), str(row.parts), f"{row.seconds:.1f}", f"{row.speed_up:.2f}")
    return shown


if __name__ == "__main__":
    main()
