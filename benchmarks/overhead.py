"""Overhead of the orchestration: the product's command against its steps called in sequence.

Run with `python -m benchmarks.overhead PICTURE` (`--turns 2`, `--set KNOB=VALUE`, `--json FILE` keeps the rows). In
every turn the same picture is converted three times in separate processes and stores: `first`, `dg4d make` without a
running server; `next`, `dg4d make` with that server; `steps`, a program that imports and calls the steps without
Prefect, cache, pages or subprocesses, and must give the same digests. Wall time is reported, so run nothing else.
"""

import argparse
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
from flows.inputs.conversion_job import ConversionRequest
from flows.inputs.package_record import RECORD
from flows.packages.publish import load_verified
from flows.serving.server import Server
from steps.contract import StepFailure, StepRequest
from steps.profiles import profile
from steps.runtime.installed_code import catalog, request_version
from steps.runtime.perform import perform
from steps.runtime.process_setup import prepare_process
from steps.store.artifact_store import ArtifactStore

WAYS = ("steps", "first", "next")


@dataclass(frozen=True)
class Row:
    """Way of converting the picture; medians over the turns.

    Attributes:
        way: one of `WAYS`.
        wall_s: from the start of the process to its end.
        orchestration: fraction of that time beyond `steps`.
    """

    way: str
    wall_s: float
    orchestration: float


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--turns", type=int, default=2)
    parser.add_argument("--set", action="append", default=[], metavar="KNOB=VALUE", help="as `dg4d make --set`")
    parser.add_argument(
        "--again", nargs=2, type=Path, help=argparse.SUPPRESS
    )  # internal: record and store, runs only the steps
    options = parser.parse_args()
    if options.again:
        repeat_steps(options.picture, *options.again)
        return
    taken: dict[str, list[float]] = {way: [] for way in WAYS}
    for seed in range(options.turns):
        for way, seconds in run_turn(options.picture.resolve(), options.set, seed).items():
            taken[way].append(seconds)
    plain = median(taken["steps"])
    rows = [Row(way, median(of), 1 - plain / median(of)) for way, of in taken.items()]
    show(rows, new_console())
    if options.json:
        write_rows(options.json, rows)


def run_turn(picture: Path, knobs: list[str], seed: int) -> dict[str, float]:
    """Return the seconds of each way with this seed."""
    changes = [word for knob in knobs for word in ("--set", knob)]
    with tempfile.TemporaryDirectory(prefix="dg4d-overhead-") as folder:
        homes = {way: str(Path(folder) / way) for way in WAYS}
        server = Server(Path(homes["first"]) / "server", Path(homes["first"]) / "prefect")

        def command(way: str, **more: str) -> float:
            out = str(Path(folder) / f"{way}-out")
            make = [sys.executable, "-m", "flows.cli", "make", str(picture), "--seed", str(seed), "-o", out, *changes]
            seconds = time_command(make, DG4D_HOME=homes[way], **more)
            load_verified(Path(out))
            return seconds

        try:
            seconds = {"first": command("first")}
            seconds["next"] = command(
                "next", PREFECT_API_URL=server.wait(), PREFECT_API_AUTH_STRING=server.auth_string()
            )
            again = [str(Path(folder) / "first-out" / RECORD), homes["steps"]]
            seconds["steps"] = time_command(
                [sys.executable, "-m", "benchmarks.overhead", str(picture), "--again", *again]
            )
        finally:
            server.stop()
    return seconds


def time_command(command: list[str], **environment: str) -> float:
    """Return the seconds that a program takes with this environment.

    Raises:
        CalledProcessError: it failed.
    """
    start = time.perf_counter()
    subprocess.run(command, env={**os.environ, **environment}, stdout=subprocess.DEVNULL, check=True)
    return time.perf_counter() - start


def repeat_steps(picture: Path, record: Path, folder: Path) -> None:
    """Repeat the steps of a finished conversion in this process.

    Raises:
        ValueError: one of them gave something else.
    """
    prepare_process()
    store = ArtifactStore(folder)
    conversion = ConversionRequest(item=picture.stem, picture=picture, profile="preview", settings=profile("preview"))
    source = conversion.to_job(store).source
    known = {source.digest: source}
    for done in json.loads(record.read_text(encoding="utf-8"))["steps"]:
        request = StepRequest(
            step=done["step"],
            version=request_version(catalog()[done["step"]]),
            inputs={name: known[digest] for name, digest in done["inputs"].items()},
            settings=done["settings"],
            seed=done["seed"],
        )
        outcome, _ = perform(request, store)
        if isinstance(outcome, StepFailure) or {n: ref.digest for n, ref in outcome.outputs.items()} != done["outputs"]:
            raise ValueError(f"{request.step} gave another result than in the flow: {outcome}")
        known |= {ref.digest: ref for ref in outcome.outputs.values()}


def show(rows: list[Row], console: Console) -> None:
    """Print the rows as a table."""
    table = Table("way", "wall s", "orchestration", title=f"One conversion ({machine()})")
    for row in rows:
        table.add_row(row.way, f"{row.wall_s:.1f}", "" if row.way == "steps" else f"{row.orchestration:.1%} of it")
    console.print(table)


if __name__ == "__main__":
    main()
