"""Throughput of the engine in items per hour: a batch of tiny pictures through two cheap real steps.

Run with `python -m benchmarks.catalog` (`--items 1000 --workers 2 --database sqlite --json FILE`). A picture is cut out
and resized to 32 pixels (prepare_subject), a video of two frames is generated and packed into a zip (drive_video), and
the zip is published as a package with its record. Batch, tasks, cache keys, locks, store, server and database are those
of the product; steps run in the process of the batch.

The catalog is processed three times: `made` from scratch, `cached` into another folder from finished steps, `unchanged`
into the first folder again. An item is lost without a package or a completed run in the database, and duplicated with
more than one run. Memory is that of the batch process: its growth from 10 % of the items to the end.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw
from prefect import flow
from prefect.client.orchestration import get_client
from rich.table import Table

from benchmarks.measure import machine, new_console, parser_of, write_rows
from benchmarks.postgresql import Database, free_port
from flows import home
from flows.catalog import convert_all
from flows.catalog_request import ready
from flows.engine.step_tasks import finished_steps, flow_context, steps_of_flow
from flows.inputs.conversion_job import ConversionJob
from flows.inputs.manifest import Item, items_of
from flows.inputs.package_record import RECORD
from flows.packages import summary
from flows.packages.flow_result import StepRun
from flows.packages.publish import Files, publish
from flows.serving.auth import auth_string
from flows.serving.server import HOST, SETTINGS, answers
from flows.stages import conversion_of
from flows.tasks import drive_video, prepare_subject

DATABASES = ("sqlite", "postgresql")
STEPS = ("prepare_subject", "drive_video")
KNOBS = {"subject.size": 32, "driving.frames": 3}
SETTLE_S = 120.0  # the server writes events in batches
START_S = 600.0  # generous, for busy machines


@dataclass(frozen=True)
class Row:
    """Pass over the catalog; seconds, `cpu` of the batch process, `server_cpu` of server and database."""

    database: str
    what: str
    items: int
    wall: float
    cpu: float
    server_cpu: float
    per_second: float
    growth_mb: float
    lost: int
    duplicated: int


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--items", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--database", choices=DATABASES, action="append", help="default: both")
    parser.add_argument(
        "--one", choices=DATABASES, help=argparse.SUPPRESS
    )  # internal: run one database in this process
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        write_rows(options.json, passes(options.one, options.items, options.workers, options.folder))
        return
    rows = []
    for database in options.database or DATABASES:
        with tempfile.TemporaryDirectory(prefix="dg4d-catalog-", ignore_cleanup_errors=True) as name:
            rows += measure_database(database, options.items, options.workers, Path(name))
    console = new_console()
    console.print(machine())
    console.print(table(rows))
    if options.json:
        write_rows(options.json, rows)


def measure_database(database: str, items: int, workers: int, folder: Path) -> list[Row]:
    """Run all passes with one database, in a separate process with its own server."""
    folder.chmod(0o755)  # for the user of the database
    for i in range(items):
        draw(folder / "pictures" / f"{i:05d}.png", i)
    with ExitStack() as running:
        address = running.enter_context(postgresql(folder)) if database == "postgresql" else ""
        port = running.enter_context(server(folder, address))
        found = folder / "rows.json"
        subprocess.run(
            [
                *(sys.executable, "-m", "benchmarks.catalog", "--one", database, "--items", str(items)),
                *("--workers", str(workers), "--folder", str(folder), "--json", str(found)),
            ],
            env={**environment(folder), "PREFECT_API_URL": f"http://127.0.0.1:{port}/api"},
            check=True,
        )
        return [Row(**row) for row in json.loads(found.read_text(encoding="utf-8"))["rows"]]


def passes(database: str, count: int, workers: int, folder: Path) -> list[Row]:
    """Process the catalog from scratch, from finished steps, and unchanged; the environment names the server."""
    rows, runs = [], 0
    for what, out in (("made", "one"), ("cached", "two"), ("unchanged", "one")):
        items = items_of(folder / "pictures", folder / out, "preview", KNOBS, 0)
        wall, cpu, servers = time.monotonic(), time.process_time(), server_seconds(folder)
        growth = run(items, folder / out, workers, what)
        wall, cpu = time.monotonic() - wall, time.process_time() - cpu
        runs += count if what != "unchanged" else 0
        names = completed(runs)
        missing = [item.name for item in items if not (folder / out / item.name / "provenance.json").is_file()]
        wanted = 1 + (what != "made")
        rows.append(
            Row(
                database=database,
                what=what,
                items=count,
                wall=round(wall, 2),
                cpu=round(cpu, 2),
                server_cpu=round(server_seconds(folder) - servers, 2),
                per_second=round(count / wall, 2),
                growth_mb=round(growth, 1),
                lost=len({*missing, *(item.name for item in items if names[item.name] < wanted)}),
                duplicated=sum(names[item.name] > wanted for item in items),
            )
        )
    return rows


def run(items: list[Item], out: Path, workers: int, what: str) -> float:
    """Run one pass; return its result and the memory growth after 10 % of the items, MB."""
    sizes: list[float] = []

    def settled(row: summary.Row) -> None:
        if row.status not in {"done", "unchanged"}:
            raise RuntimeError(f"{row.item}: {row.message}")
        sizes.append(memory_mb())
        writer.write_sometimes(list(progress.rows.values()), progress.seconds)

    writer, progress = summary.Writer(out), summary.BatchProgress(len(items), settled)
    out.mkdir(exist_ok=True)

    @flow(name="catalog", flow_run_name=what, persist_result=False)
    def catalog() -> None:
        todo = (ready(item, out, strict=False) for item in items)
        convert_all(todo, out, workers, f"{what}: {len(items)} items", progress, work=run_steps)

    with flow_context():
        catalog()
    writer.write(list(progress.rows.values()), progress.seconds)
    return sizes[-1] - sizes[len(sizes) // 10]


def run_steps(job: ConversionJob, folder: Path) -> tuple[Any, bool]:
    """Resize, pack and publish; return true if every step was cached."""
    packed, cached = resize_and_pack(job)

    def finish(staging: Path, files: Files) -> Files:
        (staging / RECORD).write_text(json.dumps({"order": job.digest(), "files": files}), encoding="utf-8")
        return files

    return publish(home.store().path(packed), folder, finish), cached


def resize_and_pack(job: ConversionJob) -> tuple[Any, bool]:
    """Run the two steps as a flow."""
    done: list[StepRun] = []

    @flow(name="resize_and_pack", flow_run_name="{item}", persist_result=False)
    def two_steps(item: str) -> None:
        with steps_of_flow():
            conversion = conversion_of(job)
            drive_video(prepare_subject(job.source, conversion), conversion)
            done.extend(finished_steps())

    with flow_context():
        two_steps(job.item)
    return done[-1].result.outputs["driving_video"], all(step.cached for step in done)


def completed(expected: int) -> Counter[str]:
    """Return the number of completed runs by item, when all are recorded or after a timeout."""
    deadline = time.monotonic() + SETTLE_S
    while True:
        names: Counter[str] = Counter()
        with get_client(sync_client=True) as client:
            wanted = {"flows": {"name": {"any_": ["resize_and_pack"]}}, "sort": "ID_DESC", "limit": 200}
            wanted["flow_runs"] = {"state": {"type": {"any_": ["COMPLETED"]}}}
            while page := client.request("POST", "/flow_runs/filter", json=wanted | {"offset": names.total()}).json():
                names.update(found["name"] for found in page)
        if names.total() >= expected or time.monotonic() > deadline:
            return names
        time.sleep(1.0)


def draw(path: Path, number: int) -> None:
    """Draw a unique picture of 40 pixels: a disc on a transparent background."""
    path.parent.mkdir(exist_ok=True)
    picture = Image.new("RGBA", (40, 40))
    color = (number % 256, number // 256 % 256, 90, 255)
    ImageDraw.Draw(picture).ellipse((8, 8, 31, 31), fill=color)
    picture.save(path)


def environment(folder: Path) -> dict[str, str]:
    """Return the environment of the batch and its server, without other variables of the caller."""
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(("PREFECT_", "DG4D_"))}
    secret = auth_string(folder / "home" / "server")
    return {
        **inherited,
        **home.CLIENT_SETTINGS,
        "DG4D_HOME": str(folder / "home"),
        "DG4D_EXECUTOR": "in_process",
        "PREFECT_API_AUTH_STRING": secret,
        "PREFECT_HOME": str(folder / "prefect"),
        "PREFECT_SERVER_API_AUTH_STRING": secret,
    }


@contextmanager
def server(folder: Path, address: str) -> Iterator[int]:
    """Run the product's server; yield its port.

    Args:
        folder: where its database is, if it is a file.
        address: of another database; empty for a file.
    """
    port = free_port()
    settings = {**environment(folder), **SETTINGS, "PREFECT__SERVER_FINAL": "1"}
    if address:
        settings["PREFECT_API_DATABASE_CONNECTION_URL"] = address
    program = ["uvicorn", "--factory", "flows.serving.server_app:create_app", "--host", HOST, "--port", str(port)]
    process = subprocess.Popen([sys.executable, "-m", *program, "--log-level", "warning"], env=settings)
    (folder / "server.pid").write_text(str(process.pid), encoding="ascii")
    try:
        deadline = time.monotonic() + START_S
        while not answers(f"http://{HOST}:{port}", timeout_s=5.0):
            if process.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError(f"the server did not start within {START_S:.0f} s")
            time.sleep(0.2)
        yield port
    finally:
        process.terminate()
        process.wait()


@contextmanager
def postgresql(folder: Path) -> Iterator[str]:
    """Run a PostgreSQL server; yield its address."""
    place = folder / "postgresql"
    place.mkdir()
    database = Database(place)
    database.start()
    try:
        yield database.address
    finally:
        database.crash()


def server_seconds(folder: Path) -> float:
    """Return the CPU seconds of the Prefect server and the database server."""
    root = int((folder / "server.pid").read_text(encoding="ascii"))
    data = str(folder / "postgresql")
    ticks = 0
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
            command = (stat.parent / "cmdline").read_text(encoding="utf-8", errors="replace")
            parent = int(fields[1])
            of_database = data in command or data in (Path(f"/proc/{parent}") / "cmdline").read_text(errors="replace")
        except (OSError, IndexError):
            continue
        if int(stat.parent.name) == root or of_database:
            ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def memory_mb() -> float:
    """Return the memory of this process, MB."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def table(rows: list[Row]) -> Table:
    """Return the rows as a table."""
    steps = len(STEPS)
    shown = Table("database", "pass", "items", "wall s", "items/s", "CPU ms/item", "ms/step", "server CPU ms/item",
                  "growth MB", "lost", "duplicated")  # fmt: skip
    for row in rows:
        per_step = f"{1e3 * row.cpu / row.items / steps:.0f}" if row.what != "unchanged" else "-"
        cells = (1e3 * row.cpu / row.items, 1e3 * row.server_cpu / row.items)
        shown.add_row(
            row.database, row.what, str(row.items), f"{row.wall:.1f}", f"{row.per_second:.1f}", f"{cells[0]:.1f}",
            per_step, f"{cells[1]:.1f}", f"{row.growth_mb:.1f}", str(row.lost), str(row.duplicated),
        )  # fmt: skip
    return shown


if __name__ == "__main__":
    main()
