"""Throughput of one, two and three machines that share a store, and the cost of a killed machine.

Run with `python -m benchmarks.fleet` (`--items 60 --seconds 6 --workers 1 2 3 --json FILE`). Machines are workers with
separate homes and identities, in processes of this machine; steps are the stand-ins of the tests, one of which sleeps,
so that the result does not depend on the number of cores. The store is `$DG4D_TEST_S3` (with the usual AWS_*
variables), else a folder. In the last pass one of the workers is killed with all its processes after a third of the
items and does not return: its runs continue elsewhere when the server has missed their heartbeats.

An item is lost without a package; a step is done twice if two machines finish it for one item.
"""

import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from rich.table import Table

from benchmarks.measure import machine, new_console, parser_of, write_rows
from flows.inputs.package_record import RECORD
from flows.serving.server import Server
from flows.serving.workers import environment

FAKES = Path(__file__).parents[1] / "tests" / "flows"
POOL = "fleet"
START_S = 120.0
LOOK_S = 0.5
BEFORE_SLEEP = ("drive_video", "fit_gaussians")  # side by side; the next step of the stand-ins sleeps


@dataclass(frozen=True)
class Row:
    """Pass over the catalog, from scratch.

    Attributes:
        workers: number of machines.
        killed: number of machines killed during the pass.
        items: of the catalog.
        wall_s: from the start of the command to its end.
        per_hour: items per hour.
        lost: items without a package.
        twice: steps that were finished twice for one item.
        shares: items finished by each machine.
    """

    workers: int
    killed: int
    items: int
    wall_s: float
    per_hour: float
    lost: int
    twice: int
    shares: list[int]


class Machine:
    """Worker with its own home and identity.

    Args:
        name: of the machine.
        folder: of its home and files.
        variables: of the environment, shared with other machines.
    """

    def __init__(self, name: str, folder: Path, variables: dict[str, str]) -> None:
        self.name, self.log = name, folder / "finished"
        folder.mkdir(parents=True)
        self.environment = {
            **variables,
            "DG4D_HOME": str(folder / "home"),
            "DG4D_HOST_ID": name,
            "PREFECT_HOME": str(folder / "prefect"),
            "FAKE_LOG": str(self.log),
        }
        self._output = (folder / "worker.log").open("wb")
        self._worker = subprocess.Popen(
            [sys.executable, "-m", "prefect", "worker", "start", "--pool", POOL, "--limit", "1", "--name", name],
            env=self.environment,
            cwd=folder,
            stdout=self._output,
            stderr=self._output,
        )

    @property
    def steps(self) -> list[str]:
        """Return the finished steps, as STEP:ITEM."""
        return self.log.read_text(encoding="utf-8").split() if self.log.exists() else []

    def sleeps(self) -> bool:
        """Return whether it is in the middle of an item, at `fit_motion`, which sleeps."""
        before = self.steps
        time.sleep(LOOK_S)
        if not before or before != self.steps:
            return False
        step, _, item = before[-1].partition(":")
        return step in BEFORE_SLEEP and all(f"{each}:{item}" in before for each in BEFORE_SLEEP)

    def kill(self) -> None:
        """Kill the worker and all its processes at once, as a power failure does."""
        for pid in [self._worker.pid, *descendants(self._worker.pid)]:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self._worker.wait()

    def stop(self) -> None:
        """Stop the worker, unless it was killed."""
        self._worker.terminate()
        try:
            self._worker.wait(30)
        except subprocess.TimeoutExpired:
            self.kill()
        self._output.close()


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--items", type=int, default=60)
    parser.add_argument("--seconds", type=float, default=6.0, help="that an item sleeps")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--kill", choices=("also", "never", "only"), default="also", help="the last pass")
    options = parser.parse_args()
    passes = [(count, False) for count in options.workers if options.kill != "only"]
    passes += [(max(options.workers), True)] if options.kill != "never" else []
    rows = []
    with (
        tempfile.TemporaryDirectory(prefix="dg4d-fleet-", ignore_cleanup_errors=True) as name,
        run_server(Path(name)) as variables,
    ):
        for number, (count, kill) in enumerate(passes):
            rows.append(measure_pass(Path(name) / f"{number}", variables, options.items, options.seconds, count, kill))
            new_console().print(rows[-1])
    console = new_console()
    console.print(machine())
    console.print(table(rows))
    if options.json:
        write_rows(options.json, rows)


def measure_pass(folder: Path, variables: dict[str, str], items: int, seconds: float, workers: int, kill: bool) -> Row:
    """Process the catalog once, from scratch."""
    draw_items(folder / "in", items, seconds)
    store = f"{os.environ['DG4D_TEST_S3']}/{os.getpid()}-{folder.name}" if "DG4D_TEST_S3" in os.environ else ""
    shared = {**variables, "DG4D_STORE": store or str(folder / "store"), "DG4D_CODE_VERSION": f"fleet-{folder.name}"}
    machines = [Machine(f"machine-{i}", folder / f"machine-{i}", shared) for i in range(workers)]
    own = {**shared, "DG4D_HOME": str(folder / "home"), "DG4D_HOST_ID": "catalog", "FAKE_LOG": str(folder / "none")}
    begun, killed = time.monotonic(), 0
    command = subprocess.Popen(
        [
            *(sys.executable, "-m", "flows.cli", "batch", str(folder / "in"), "-o", str(folder / "out")),
            *("--where", f"deployment:{POOL}", "--workers", str(2 * workers)),
        ],
        env=own,
        stdout=(folder / "catalog.log").open("wb"),
        stderr=subprocess.STDOUT,
    )
    try:
        while command.poll() is None:
            time.sleep(LOOK_S)
            if kill > killed and sum(map(count_finished, machines)) >= items / 3 and machines[-1].sleeps():
                machines[-1].kill()
                killed = 1
        wall_s = time.monotonic() - begun
    finally:
        command.kill()
        for one in machines:
            one.stop()
    steps = Counter(step for one in machines for step in one.steps)
    made = sum((folder / "out" / f"{i:03d}" / RECORD).is_file() for i in range(items))
    return Row(
        workers=workers,
        killed=killed,
        items=items,
        wall_s=round(wall_s, 1),
        per_hour=round(3600 * items / wall_s),
        lost=items - made,
        twice=sum(count - 1 for count in steps.values()),
        shares=[count_finished(one) for one in machines],
    )


def count_finished(one: Machine) -> int:
    """Return the number of items that a machine finished."""
    return sum(step.startswith("check_asset:") for step in one.steps)


def draw_items(folder: Path, count: int, seconds: float) -> None:
    """Write the input files of the stand-in steps."""
    folder.mkdir(parents=True)
    for i in range(count):
        words = f"fit_motion=sleep:{seconds} named={i:03d} {folder}"
        (folder / f"{i:03d}.png").write_text(f"#?RADIANCE\n{words}", encoding="utf-8")


@contextmanager
def run_server(folder: Path) -> Iterator[dict[str, str]]:
    """Run the product's server with a work pool; yield the environment of its clients."""
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(("PREFECT_", "DG4D_"))}
    server = Server(folder / "server", folder / "prefect")
    with ExitStack() as running:
        os.environ["DG4D_HOME"] = str(folder)
        server.start()
        running.callback(server.stop)
        api_url = server.wait()
        variables = {
            **inherited,
            **environment(api_url),
            "PREFECT_API_AUTH_STRING": server.auth_string(),
            "PREFECT_LOGGING_HANDLERS_CONSOLE_LEVEL": "WARNING",
            "DG4D_CATALOG": "fake_steps:STEPS",
            "DG4D_EXECUTOR": "in_process",
            "DG4D_CPUS": "2",
            "PYTHONPATH": str(FAKES),
        }
        subprocess.run(
            [sys.executable, "-c", REGISTER], env={**variables, "PREFECT_HOME": str(folder / "p")}, check=True
        )
        yield variables


REGISTER = f"""
from flows.serving.pools import read_pools
from flows.serving.registering import register
register(read_pools(), [{POOL!r}])
"""


def descendants(pid: int) -> list[int]:
    """Return the child processes of a process, recursively."""
    found: list[int] = []
    for children in Path(f"/proc/{pid}/task").glob("*/children"):
        with suppress(OSError):  # the thread has ended
            for child in re.findall(r"\d+", children.read_text(encoding="ascii")):
                found += [int(child), *descendants(int(child))]
    return found


def table(rows: list[Row]) -> Table:
    """Return the rows as a table."""
    shown = Table("machines", "killed", "items", "wall s", "items/hour", "lost", "done twice", "items by machine")
    for row in rows:
        shown.add_row(
            str(row.workers), str(row.killed), str(row.items), f"{row.wall_s:.0f}", f"{row.per_hour:.0f}",
            str(row.lost), str(row.twice), " ".join(map(str, row.shares)),
        )  # fmt: skip
    return shown


if __name__ == "__main__":
    main()
