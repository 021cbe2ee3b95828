"""One order becomes one folder: connect to a server, run the flow, publish what it made."""

import importlib
import os
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flows import home
from flows.engine.free_space import require_free_space
from flows.inputs.orders import Order
from flows.inputs.package_record import record_of
from flows.packages.publish import Files, is_current
from flows.serving import background
from flows.serving.server import ServerUnavailable
from steps.store.artifact_store import ArtifactMissing
from steps.store.files import home as store_home

if TYPE_CHECKING:
    from flows.packages.flow_result import FlowResult

ANSWER_S = 10.0  # for a server of the user's own


def prepare(order: Order) -> None:
    """Begin what the first step of an order would wait for, unless every step was done before."""
    from flows.engine import executors
    from flows.engine.versions import has_version

    if not has_version(home.store(), order):
        executors.prepare()


def connect() -> None:
    """Have a Prefect server, and import Prefect and the flows while it starts.

    Raises:
        ServerUnavailable: there is none; says what to do.
        DiskFull: there is no room for what a run keeps.
    """
    require_free_space(store_home())
    own = os.environ.get("PREFECT_API_URL")
    if own:
        home.set_environment(own)
        _check(own)
    else:
        server = background.background_server()
        server.start()
        background.set_own_server(server, server.wait_for_address())
        importlib.import_module("flows.pipeline")  # takes seconds, and so does the server
        server.wait()
    from flows.engine.orphans import settle_orphans

    settle_orphans()


def make(order: Order, folder: Path) -> tuple[Files, bool]:
    """Run the flow of an order and put the package into `folder`, signed if a key is configured; keep it as a version.

    What turns out to be damaged or gone on the way is made again. Another run that writes the same folder is waited
    for; if it made the same package, there is nothing left to do.

    Returns:
        The files of the package, and whether every step had been done before.

    Raises:
        StepError: a step did not finish; `folder` is as it was.
        BadInput: the folder cannot be written, the disk is full, or the key cannot sign; it is as it was.
        BackendUnavailable: a key is configured, and signing is not installed.
    """
    from flows.engine.events import StepEvent, tell
    from flows.engine.output_lock import output_lock
    from flows.step_errors import StepLost

    def waiting() -> None:
        tell(StepEvent(order.item, "output", "remark", text=f"waiting for another run that writes {folder}"))

    with output_lock(folder, waiting) as waited:
        if waited and is_current(folder, order.digest()):
            return _files_in(folder), True
        try:
            result = _make(order, folder)
        except (ArtifactMissing, StepLost):  # it was dropped when it was found, and so was the result that named it
            result = _make(order, folder)
    return _files_in(folder), all(done.cached for done in result.steps)


def run(order: Order, folder: Path | None = None, refresh: bool = False, mesh_parts: int = 0) -> "FlowResult":
    """Run the flow of an order.

    Args:
        order: request of the conversion.
        folder: output folder; None: the package stays in the store.
        refresh: run every step, also those whose result exists.
        mesh_parts: number of tasks that extract a mesh per frame; 0: one per slot of this machine.

    Raises:
        StepError: a step did not finish.
    """
    from prefect.settings import PREFECT_TASKS_REFRESH_CACHE
    from prefect.task_runners import ThreadPoolTaskRunner

    from flows import pipeline
    from flows.engine.resources import slots

    flow = pipeline.text_to_4d if order.drawn else pipeline.video_to_4d if order.moving else pipeline.image_to_4d
    runner: Any = ThreadPoolTaskRunner(max_workers=slots())
    with _surroundings(order, {PREFECT_TASKS_REFRESH_CACHE: refresh}):
        return flow.with_options(task_runner=runner)(order, folder, mesh_parts)


def _make(order: Order, folder: Path) -> "FlowResult":
    from flows.engine.leases import running

    with running(home.store(), order.item):
        return run(order, folder)


def _files_in(folder: Path) -> Files:
    files: Files = (record_of(folder) or {"files": {}})["files"]
    return files


def make_motions(order: Order, folder: Path) -> dict[str, Any]:
    """Hold the tournament of an order's motions and put sheet, ranking and films into `folder`; the ranking.

    Raises:
        StepError: a step did not finish.
    """
    from flows.motions import motions, unpack

    with _surroundings(order):
        outputs = motions(order)
    return unpack(outputs, folder)


@contextmanager
def _surroundings(order: Order, settings: dict[Any, Any] | None = None) -> Iterator[None]:
    """What a flow of an order runs in, with these settings of Prefect beside those of every flow."""
    from prefect import tags

    from flows.engine.step_tasks import flow_context

    with flow_context(settings), tags(order.profile):
        yield


def save_pictures(order: Order, error: Exception) -> list[Path]:
    """Keep the pictures that explain a failure where the user can look at them."""
    saved = []
    for name, ref in getattr(error, "pictures", {}).items():
        path = home.failures() / f"{order.item.replace('/', '-')}-{getattr(error, 'step', 'step')}-{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            home.store().get(ref, path)
        except (OSError, ArtifactMissing):
            continue
        saved.append(path)
    return saved


def _check(api_url: str) -> None:
    try:
        urllib.request.urlopen(f"{api_url.rstrip('/')}/health", timeout=ANSWER_S).close()
    except (urllib.error.URLError, OSError, ValueError) as error:
        raise ServerUnavailable(
            f"PREFECT_API_URL is {api_url} and nothing answers there ({error}); "
            "start that server, or unset the variable to have one started"
        ) from error
