"""Conversion of one job: connect to a server, run the flow, publish the package in a folder."""

import importlib
import json
import os
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flows import home
from flows.engine.free_space import require_free_space
from flows.inputs.conversion_job import ConversionJob, ConversionRequest
from flows.inputs.package_record import record_of
from flows.packages.publish import Files, check_folder, is_current, recover
from flows.serving import background
from flows.serving.server import ServerUnavailable
from steps.artifacts.archives import unpack
from steps.runtime.process_setup import garbage_collection_paused
from steps.store.artifact_store import ArtifactMissing
from steps.store.files import home as store_home

if TYPE_CHECKING:
    from flows.packages.flow_result import FlowResult

STARTING = "starting the Prefect server"  # stage of `connect` when no server runs
ANSWER_S = 10.0  # time limit of a health check of the user's own server


def prepare(job: ConversionJob) -> None:
    """Start the fork server for the first step of a job, unless the job was finished before."""
    from flows.engine import executors
    from flows.engine.versions import has_version

    if not has_version(home.store(), job):
        executors.prepare()


def connect() -> None:
    """Connect to a Prefect server, by default the background server; import Prefect and the flows while it starts.

    Raises:
        ServerUnavailable: the server does not answer, or another program took its port.
        BadInput: `$DG4D_SERVER_IDLE_S` is not a number of seconds.
        DiskFull: the disk of the home folder is nearly full.
    """
    require_free_space(store_home())
    server, given = background.background_server(), os.environ.get("PREFECT_API_URL")
    if given and not server.is_at(given):  # an earlier call sets the variable to the background server
        _announce(f"connecting to the Prefect server {given}")
        home.set_environment(given)
        _check(given)
    else:
        if server.address() is None:
            first = "" if server.has_database() else "; the first start creates its database, about 10 s"
            _announce(f"{STARTING}{first}")
        server.start()
        address = server.wait_for_address()
        if given and given != f"{address}/api":
            server.release()
            raise ServerUnavailable(f"another program took the port of the Prefect server at {given}; run this again")
        background.set_own_server(server, address)
        _announce("importing the flows")
        with garbage_collection_paused():
            importlib.import_module("flows.pipeline")  # takes seconds, as the start of the server does
        _announce("waiting for the Prefect server")
        server.wait()
    from flows.engine.orphans import settle_orphans

    settle_orphans()


@contextmanager
def announcing(say: Callable[[str], None]) -> Iterator[None]:
    """Call `say` with every stage of `connect` while the block runs."""
    _listeners.append(say)
    try:
        yield
    finally:
        _listeners.remove(say)


@contextmanager
def stored(request: ConversionRequest) -> Iterator[ConversionJob]:
    """Yield the job of a request; no garbage collection removes its files from the store while the block runs.

    Raises:
        BadInput: a file cannot be read, or the disk is full.
    """
    from flows.engine.leases import running

    with running(home.store(), request.item):
        yield request.to_job(home.store())


def convert_job(
    job: ConversionJob,
    folder: Path,
    run: "Callable[[ConversionJob, Path], FlowResult] | None" = None,
    force: bool = True,
) -> tuple[Files, bool]:
    """Run the flow of a job and publish the package in `folder`, signed if a key is configured.

    Cached artifacts that turn out to be missing or damaged are computed again. A run that finds another one writing the
    same folder waits for it, and reuses an equal package.

    Args:
        job: job to convert.
        folder: output folder.
        run: runs the steps and publishes the package; None: the flow, on the connected Prefect server.
        force: replace the package of another item in `folder`; false: refuse it, also if another run wrote it after the
            caller looked.

    Returns:
        Files of the package, and true if every step was cached.

    Raises:
        StepError: a step failed; `folder` is unchanged.
        BadInput: the folder cannot be written or is refused, the disk is full, or the key cannot sign; `folder` is
            unchanged.
        BackendUnavailable: a key is configured, and signing is not installed.
        ServerUnavailable: the server ended, and does not answer again.
    """
    from flows.engine.events import remark_on_output
    from flows.engine.leases import running
    from flows.engine.output_lock import output_lock
    from flows.step_errors import StepLost

    say = remark_on_output(job.item)
    run = run or run_flow
    cached = True
    with (
        running(home.store(), job.item, job.given().values()),
        output_lock(folder, lambda: say(f"waiting for another run that writes {folder}")) as waited,
    ):
        recover(folder, say)
        if not force:
            check_folder(folder, job.item)
        if not (waited and is_current(folder, job.digest())):
            try:
                result = run(job, folder)
            except (ArtifactMissing, StepLost):  # the cache entry of the missing artifact was dropped
                result = run(job, folder)
            cached = all(done.cached for done in result.steps)
    return (record_of(folder) or {"files": {}})["files"], cached


def run_flow(
    job: ConversionJob, folder: Path | None = None, refresh: bool = False, mesh_parts: int = 0
) -> "FlowResult":
    """Run the flow of a job; if the server restarts meanwhile, go on after the last finished step.

    Args:
        job: job to convert.
        folder: output folder; None: the package stays in the store.
        refresh: run cached steps again.
        mesh_parts: number of tasks that extract a mesh per frame; 0: one per slot of this machine.

    Raises:
        StepError: a step failed.
        ServerUnavailable: the server ended, and does not answer again.
    """
    from prefect.settings import PREFECT_TASKS_REFRESH_CACHE
    from prefect.task_runners import ThreadPoolTaskRunner

    from flows import pipeline
    from flows.engine.resources import slots
    from flows.ui.showing import run_again

    flow = (
        pipeline.text_to_4d if job.generates_picture else pipeline.video_to_4d if job.moving else pipeline.image_to_4d
    )
    runner: Any = ThreadPoolTaskRunner(max_workers=slots())
    with _flow_context(job, {PREFECT_TASKS_REFRESH_CACHE: refresh}):
        return run_again(lambda: flow.with_options(task_runner=runner)(job, folder, mesh_parts))


def rank_motions(job: ConversionJob, folder: Path) -> dict[str, Any]:
    """Generate and rank motions of a job's picture, write sheet, ranking and videos into `folder`; return the ranking.

    Raises:
        StepError: a step failed.
    """
    from flows.engine.leases import running
    from flows.pipeline import motions
    from flows.ui.showing import run_again

    store = home.store()
    with running(store, job.item, job.given().values()), _flow_context(job):
        outputs = run_again(lambda: motions(job))
        folder.mkdir(parents=True, exist_ok=True)
        store.get(outputs["candidates"], folder / "motions.png")
        store.get(outputs["ranking"], folder / "motions.json")
        unpack(store.path(outputs["films"]), folder, "the zip of videos")
    ranking: dict[str, Any] = json.loads((folder / "motions.json").read_text(encoding="utf-8"))
    return ranking


@contextmanager
def _flow_context(job: ConversionJob, settings: dict[Any, Any] | None = None) -> Iterator[None]:
    """Enter the context of a job's flow, tagged with its profile, with further settings of Prefect."""
    from prefect import tags

    from flows.engine.step_tasks import flow_context

    with flow_context(settings), tags(job.profile):
        yield


def save_pictures(job: ConversionJob, error: Exception) -> list[Path]:
    """Copy the pictures that explain a failure to the folder of failures."""
    saved = []
    for name, ref in getattr(error, "pictures", {}).items():
        path = home.failures() / f"{job.item.replace('/', '-')}-{getattr(error, 'step', 'step')}-{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            home.store().get(ref, path)
        except (OSError, ArtifactMissing):
            continue
        saved.append(path)
    return saved


_listeners: list[Callable[[str], None]] = []


def _announce(stage: str) -> None:
    for say in tuple(_listeners):
        say(stage)


def _check(api_url: str) -> None:
    try:
        urllib.request.urlopen(f"{api_url.rstrip('/')}/health", timeout=ANSWER_S).close()
    except (urllib.error.URLError, OSError, ValueError) as error:
        raise ServerUnavailable(
            f"PREFECT_API_URL is {api_url}, where no server answers ({error}); start that server, or unset the "
            "variable to use the background server"
        ) from error
