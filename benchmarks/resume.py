"""Resumption after kills at random times: digests of the next run against those of an undisturbed one.

Run with `python -m benchmarks.resume PICTURE` (`--kills 20`, `--seed 0`, `--json FILE` keeps the rows). Every trial has
a store of its own: a small real conversion gets SIGKILL at a random time within the duration of an undisturbed one,
then the same command runs to its end. The exit status is 1 unless all trials end with the same digests.
"""

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.measure import new_console, write_rows
from flows.packages.publish import load_verified

SMALL = {
    "subject.size": "64",
    "driving.frames": "4",
    "static.iterations": "40",
    "static.views": "1",
    "static.start.points": "400",
    "static.reference_size": "48",
    "static.resolution_schedule": '[{"until": 1.0, "size": 48}]',
    "motion.iterations": "30",
    "motion.reference_size": "48",
    "motion.resolution_schedule": '[{"until": 1.0, "size": 48}]',
    "mesh.grid": "32",
    "mesh.edge_length": "0.06",
    "mesh.texture_size": "128",
    "mesh.render_size": "96",
    "pack.preview_size": "64",
    "pack.preview_turns": "1",
    "pack.sheet_size": "48",
    "pack.sheet_frames": "2",
}


@dataclass(frozen=True)
class Row:
    """Trial: time of the kill, step in progress, and result of the next command."""

    killed_at_s: float
    during: str
    status: int
    kept: int
    seconds: float
    same: bool


class Place:
    """Home and server of all trials, and a store for each."""

    def __init__(self, folder: Path, picture: Path) -> None:
        self.folder, self.picture = folder, picture.resolve()

    def start(self, trial: str) -> "subprocess.Popen[str]":
        """Start the conversion."""
        knobs = [word for key, value in SMALL.items() for word in ("--set", f"{key}={value}")]
        return subprocess.Popen(
            [sys.executable, "-m", "flows.cli", "make", str(self.picture), *knobs, "-o", str(self.folder / trial)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**self.environment, "DG4D_STORE": str(self.folder / f"store-{trial}")},
        )

    def digests(self, trial: str) -> dict[str, object]:
        """Return the digests that must not depend on the number of attempts."""
        record = load_verified(self.folder / trial)
        return {key: record[key] for key in ("order", "package", "files", "steps")}

    @property
    def environment(self) -> dict[str, str]:
        """Return the environment of a command."""
        return {**os.environ, "DG4D_HOME": str(self.folder / "home")}

    def close(self) -> None:
        """Stop the server."""
        subprocess.run([sys.executable, "-m", "flows.cli", "down"], env=self.environment, check=False)


def run_trials(place: Place, kills: int, seed: int) -> list[Row]:
    """Run an undisturbed conversion, then the trials."""
    rng = random.Random(seed)
    duration_s = 0.0
    for trial in ("warm", "undisturbed"):  # the first run compiles kernels
        start = time.monotonic()
        said, _ = (command := place.start(trial)).communicate()
        duration_s = time.monotonic() - start
        if command.returncode != 0:
            raise SystemExit(said)
    wanted = place.digests("undisturbed")
    rows = []
    for number in range(kills):
        trial, delay_s = f"trial-{number}", rng.uniform(0, duration_s)
        command = place.start(trial)
        time.sleep(delay_s)
        command.send_signal(signal.SIGKILL)
        said, _ = command.communicate()
        started = [line.split(":")[0] for line in said.splitlines() if ": started" in line]
        start = time.monotonic()
        said, _ = (again := place.start(trial)).communicate()
        rows.append(
            Row(
                killed_at_s=round(delay_s, 2),
                during="the end" if command.returncode == 0 else started[-1] if started else "the start",
                status=again.returncode,
                kept=said.count(": cached"),
                seconds=round(time.monotonic() - start, 2),
                same=again.returncode == 0 and place.digests(trial) == wanted,
            )
        )
    return rows


def print_rows(rows: list[Row], console: Console) -> None:
    """Return the rows as a table."""
    same = sum(row.same for row in rows)
    table = Table(title=f"{same} of {len(rows)} ended with the digests of an undisturbed run")
    for name in ("killed at", "during", "next run: steps kept", "took", "status", "same digests"):
        table.add_column(name)
    for row in rows:
        table.add_row(
            f"{row.killed_at_s:.1f} s",
            row.during,
            str(row.kept),
            f"{row.seconds:.1f} s",
            str(row.status),
            str(row.same),
        )
    console.print(table)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.resume", description=__doc__)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="dg4d-resume-", ignore_cleanup_errors=True) as folder:
        place = Place(Path(folder), given.picture)
        try:
            rows = run_trials(place, given.kills, given.seed)
        finally:
            place.close()
    print_rows(rows, new_console())
    if given.json is not None:
        write_rows(given.json, rows)
    return 0 if all(row.same for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
