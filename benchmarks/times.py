"""Time table of the paper: iterations and seconds of every stage, from the records of finished packages.

Run with `python -m benchmarks.times PACKAGE ...` (`--json FILE` keeps the rows). Packages with the same profile,
machine and iterations are averaged. Seconds are those in which a step was computed, now or for an earlier package; the
parts of a mesh extraction per frame, which run two at a time, are added up. The figures of the paper are listed below.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from rich.table import Table

from benchmarks.measure import new_console, parser_of, write_rows
from flows.inputs.package_record import RECORD
from flows.packages.publish import load_verified

STAGES = {
    "prepare_subject": "subject",
    "drive_video": "video",
    "fit_gaussians": "static",
    "fit_motion": "dynamic",
    "plan_mesh": "mesh",
    "extract_mesh": "mesh",
    "join_meshes": "mesh",
    "refine_texture": "refinement",
    "pack_asset": "package",
}
ITERATIONS = {
    "fit_gaussians": ("static", "iterations"),
    "fit_motion": ("motion", "iterations"),
    "refine_texture": ("refiner", "texture", "iterations"),
}  # setting of the iterations of a step


@dataclass(frozen=True)
class Row:
    """Profile on one machine, means over packages; seconds and iterations by stage."""

    profile: str
    machine: str
    packages: int
    seconds: dict[str, float]
    iterations: dict[str, int]

    @property
    def total(self) -> float:
        return sum(self.seconds.values())


PAPER = (
    Row(
        profile="paper: image to 4D",
        machine="NVIDIA A100, 80 GB",
        packages=0,
        seconds={"video": 60.0, "static": 120.0, "dynamic": 270.0, "refinement": 210.0},
        iterations={"static": 500, "dynamic": 200, "refinement": 50},
    ),
)  # Ren et al. 2024, section 4, "Implementation Details"; the video: "typically in about one minute", section 1
PAPER_TOTALS = (
    "The paper's table 1: 6.5 minutes and 0.7k iterations for the Gaussians, without the driving video; 10 minutes and "
    "0.75k iterations with the refined texture. Its table of video-to-4D: 15 minutes for 32 frames, 4 views and 500 "
    "iterations; 5 minutes for 16 frames and one view."
)


def read_package_times(folder: Path) -> Row:
    """Read the records of one package."""
    record = load_verified(folder)
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    seconds: dict[str, float] = {}
    machines = []
    for ran in record["run"]["steps"]:
        stage = STAGES.get(ran["step"].partition(" ")[0])  # "extract_mesh 1/4" is one part
        if stage is not None:
            seconds[stage] = seconds.get(stage, 0.0) + ran["duration_s"]
            machines.append(hardware_line(ran.get("machine", {})))
    return Row(
        profile=report["profile"],
        machine="; ".join(dict.fromkeys(machines)),
        packages=1,
        seconds=seconds,
        iterations=iterations_in(record["steps"]),
    )


def hardware_line(machine: dict[str, str]) -> str:
    """Return the hardware in a line: the GPU, or the processor without one."""
    if not machine:
        return "not recorded"
    return machine.get("gpu") or f"{machine.get('processor', 'processor')}, {machine.get('cores', '?')} cores"


def iterations_in(steps: Sequence[dict[str, Any]]) -> dict[str, int]:
    """Return the iterations of each stage; stages without any are left out."""
    found = {}
    for step in steps:
        if step["step"] in ITERATIONS:
            value: Any = step["settings"]
            for name in ITERATIONS[step["step"]]:
                value = value.get(name, {})
            if value:
                found[STAGES[step["step"]]] = int(value)
    return found


def average_rows(rows: Sequence[Row]) -> list[Row]:
    """Return one row per profile, machine and iterations, in order of appearance."""
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.profile, row.machine, json.dumps(row.iterations, sort_keys=True)), []).append(row)
    return [
        Row(
            profile=group[0].profile,
            machine=group[0].machine,
            packages=len(group),
            seconds={stage: fmean(row.seconds.get(stage, 0.0) for row in group) for stage in group[0].seconds},
            iterations=group[0].iterations,
        )
        for group in groups.values()
    ]


def table(rows: Sequence[Row]) -> Table:
    """Return the rows as a table: seconds, and iterations in brackets."""
    stages = [stage for stage in STAGES.values() if any(stage in row.seconds for row in rows)]
    result = Table("profile", "packages", *stages, "total", "machine", title="seconds (iterations)")
    for row in rows:
        cells = [
            f"{row.seconds[stage]:.1f}" + (f" ({row.iterations[stage]})" if stage in row.iterations else "")
            if stage in row.seconds
            else "-"
            for stage in stages
        ]
        result.add_row(row.profile, str(row.packages or "-"), *cells, f"{row.total:.0f}", row.machine)
    return result


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument(
        "packages", type=Path, nargs="+", metavar="PACKAGE", help=f"folders with {RECORD}, as `dg4d make` writes them"
    )
    options = parser.parse_args()
    rows = average_rows([read_package_times(folder) for folder in options.packages])
    console = new_console()
    console.print(table([*rows, *PAPER]))
    console.print(PAPER_TOTALS)
    if options.json:
        write_rows(options.json, rows)


if __name__ == "__main__":
    main()
