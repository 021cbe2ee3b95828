"""Items of a catalog as flow runs of a deployment, found again by their idempotency key after a catalog was killed.

Items are passed by reference: job, source and outcome are in the store that catalog and workers share.
"""

import itertools
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple
from uuid import UUID

import httpx
from prefect import runtime
from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.client.schemas.filters import (
    FlowFilter,
    FlowFilterName,
    FlowRunFilter,
    FlowRunFilterIdempotencyKey,
)
from prefect.client.schemas.objects import FlowRun, State, WorkerStatus
from prefect.deployments import run_deployment
from prefect.exceptions import PrefectHTTPStatusError
from prefect.states import Cancelled, Scheduled

from dg4d_lib.errors import BackendUnavailable, BadInput, DG4DError
from flows import home
from flows.engine import resources
from flows.engine.events import StepEvent, emit, remark_on_output
from flows.engine.leases import running
from flows.engine.output_lock import output_lock
from flows.inputs.conversion_job import ConversionJob
from flows.inputs.package_record import record_of
from flows.packages.delivery import Outcome, read_outcome, unpack_package
from flows.packages.publish import Files
from flows.step_errors import StepCrashed, StepError, StepOutOfMemory, StepTimedOut, StepUnreachable
from steps.contract import ArtifactRef, digest_of
from steps.runtime.installed_code import catalog, request_version
from steps.store.artifact_store import ArtifactMissing, ArtifactStore, StoreUnreachable

FLOW = "item-to-4d"
JOB_MEDIA_TYPE = "application/vnd.dg4d.order+json"
STEP = "item"  # step name in the events of a waiting item
POLL_S = 1.0  # between two queries of a run
POLLS_PER_S = 20  # queries of all waiting items of a catalog together
MAY_HEAL = (StepCrashed, StepOutOfMemory, StepTimedOut, StepUnreachable, StoreUnreachable, ArtifactMissing)
WORKER_LABEL = "prefect.worker.name"  # of a run that a worker has taken
PENDING_S = 120.0  # longest time in Pending; an image may have to be pulled
CRASHED_S = 60.0  # the automation of `registering.py` restarts a crashed run after 10 s, or never


class ItemFailed(DG4DError):
    """Failure of an item on another machine.

    Attributes:
        outcome: outcome reported by that machine.
        step: failed step.
        pictures: pictures that explain the failure, in the store.
    """

    def __init__(self, outcome: Outcome) -> None:
        super().__init__(outcome.message)
        self.outcome, self.step, self.pictures = outcome, outcome.step or STEP, outcome.pictures

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the argument of `__init__`; `args` holds the message."""
        return type(self), (self.outcome,)


class ItemDeployment(NamedTuple):
    """Deployment that converts items.

    Attributes:
        name: full name, FLOW/NAME.
        pool: work pool that executes its runs.
        poll_s: seconds between two queries of a run.
    """

    name: str
    pool: str
    poll_s: float = POLL_S

    def convert_job(self, job: ConversionJob, folder: Path) -> tuple[Files, bool]:
        """Run a job on a worker and put the package into `folder`, as `flows.convert.convert_job` does on this machine.

        Raises:
            ItemFailed: the conversion failed, or the worker died.
            BadInput: the folder cannot be written.
        """
        store = home.store()
        ref = store.put_bytes(job.model_dump_json().encode(), JOB_MEDIA_TYPE)
        with running(store, job.item, [ref, *job.given().values()]):
            outcome = self._outcome(job, ref, store)
            if outcome.package is None:
                raise ItemFailed(outcome)
            with output_lock(folder, lambda: None):
                files = unpack_package(outcome.package, folder, store, remark_on_output(job.item))
        if (record_of(folder) or {}).get("order") != job.digest():
            note = "converted with weights, a rasterizer or a signing key that differ from those of this machine"
            emit(StepEvent(job.item, STEP, "remark", text=note))
        return files, outcome.cached

    def _outcome(self, job: ConversionJob, ref: ArtifactRef, store: ArtifactStore) -> Outcome:
        with get_client(sync_client=True) as client:
            run = self._begin(client, job, ref, store)
            run = self._wait(client, run, job.item)
        return _outcome_of(run, store)

    def _begin(self, client: SyncPrefectClient, job: ConversionJob, ref: ArtifactRef, store: ArtifactStore) -> FlowRun:
        """Create the run of an item, or return an earlier one that is active or has produced the package."""
        for number in itertools.count():
            key = digest_of([job.digest(), ref.digest, self.name, number])
            found = client.read_flow_runs(
                flow_run_filter=FlowRunFilter(idempotency_key=FlowRunFilterIdempotencyKey(any_=[key]))
            )
            if not found:
                break
            if _is_at_work(found[0]) or _has_package(found[0], store):
                return found[0]
        parameters: dict[str, Any] = {
            "item": job.item,
            "job": ref.model_dump(mode="json"),
            "code": code_version(),
            "store": store.address,
        }
        run = run_deployment(self.name, parameters=parameters, timeout=0, tags=[job.profile], idempotency_key=key)
        assert isinstance(run, FlowRun)
        return run

    def _wait(self, client: SyncPrefectClient, run: FlowRun, item: str) -> FlowRun:
        """Wait until a run has ended and will not be restarted."""
        shown = ""
        while _is_at_work(run):
            name = run.state.name if run.state else ""
            if name != shown:
                shown = str(name)
                emit(StepEvent(item, STEP, "note", text=f"{shown.lower()} in {self.pool}"))
            if resources.stopping.wait(self.poll_s):
                _give_up(client, run)
                raise resources.Stopped(f"stopped while {item} was converted in {self.pool}")
            try:
                run = client.read_flow_run(run.id)
                if _is_stranded(client, run, self.pool):
                    again: State[Any] = Scheduled(
                        name="AwaitingRetry", message="the worker stopped before the run began"
                    )
                    client.set_flow_run_state(run.id, again, force=True)
            except (httpx.TransportError, PrefectHTTPStatusError):
                continue  # the run continues while the server is unavailable
        return run


def item_deployment(pool: str, workers: int) -> ItemDeployment:
    """Find the deployment that converts items in a pool.

    Args:
        pool: name of the pool; empty: the only one that has such a deployment.
        workers: items at a time.

    Raises:
        BadInput: no such deployment, or several without a given pool; or the catalog itself fills the pool.
    """
    with get_client(sync_client=True) as client:
        found = client.read_deployments(flow_filter=FlowFilter(name=FlowFilterName(any_=[FLOW])))
        pools = {str(one.work_pool_name): one for one in found}
        if (not pool and len(pools) != 1) or (pool and pool not in pools):
            there = ", ".join(sorted(pools)) or "none"
            raise BadInput(
                f"--where deployment{f':{pool}' if pool else ''}: give a pool that takes items, one of: {there}; "
                "`dg4d up --pool POOL` adds one"
            )
        pool = pool or next(iter(pools))
        _require_free_place(client, pool)
    return ItemDeployment(f"{FLOW}/{pools[pool].name}", pool, max(POLL_S, workers / POLLS_PER_S))


def failure(error: Exception) -> Outcome:
    """Return the outcome of an item that ended with an exception."""
    if isinstance(error, ItemFailed):
        return error.outcome
    known = isinstance(error, DG4DError)
    return Outcome(
        kind=type(error).__name__ if known else "Crashed",
        message=error.message
        if isinstance(error, StepError)
        else f"{'' if known else f'{type(error).__name__}: '}{error}",
        step=getattr(error, "step", ""),
        pictures=getattr(error, "pictures", {}),
        may_heal=isinstance(error, MAY_HEAL) or not known,
    )


def code_version() -> str:
    """Return a digest of the code of all steps."""
    return digest_of({name: request_version(spec) for name, spec in catalog().items()})


def read_job(job: ArtifactRef, code: str, store: ArtifactStore, address: str) -> ConversionJob:
    """Read a job that a catalog put into the store.

    Args:
        job: reference of the job.
        code: `code_version` of the catalog's machine.
        store: store of this machine.
        address: address of the catalog's store.

    Raises:
        BackendUnavailable: code or store of this machine differ.
    """
    if code != code_version():
        raise BackendUnavailable(
            "this worker runs another version of dg4d than the catalog; install the same on all machines"
        )
    if not store.has(job):
        raise BackendUnavailable(
            f"the job {job.digest} is not in the store of this worker, {store.address}; the catalog put it into "
            f"{address}: set $DG4D_STORE of both to one store"
        )
    return ConversionJob.model_validate_json(store.path(job).read_bytes())


def _is_at_work(run: FlowRun) -> bool:
    """Return true if a run may still complete; the server may restart a crashed one."""
    if run.state is None or not run.state.is_final():
        return True
    return run.state.is_crashed() and _age_s(run) < CRASHED_S


def _outcome_of(run: FlowRun, store: ArtifactStore) -> Outcome:
    """Return the outcome of an ended run, or one made from its state if it wrote none."""
    if run.state is not None and run.state.is_cancelled():
        return Outcome(kind="Cancelled", message="the run was cancelled")
    outcome = read_outcome(store, str(run.id))
    if outcome is not None:
        return outcome
    message = str(run.state.message or run.state.name) if run.state else "the run has no state"
    return Outcome(kind="Crashed", message=message, may_heal=True)


def _is_stranded(client: SyncPrefectClient, run: FlowRun, pool: str) -> bool:
    """Return true if the worker of a pending run died; runs send heartbeats only after they have started."""
    if run.state is None or not run.state.is_pending() or _age_s(run) < PENDING_S:
        return False
    workers = client.read_workers_for_work_pool(pool)
    online = {worker.name for worker in workers if worker.status is WorkerStatus.ONLINE}
    return run.labels.get(WORKER_LABEL) not in online


def _age_s(run: FlowRun) -> float:
    """Return the age of the state of a run in seconds."""
    return 0.0 if run.state is None else (datetime.now(UTC) - run.state.timestamp).total_seconds()


def _has_package(run: FlowRun, store: ArtifactStore) -> bool:
    if run.state is None or not run.state.is_completed():
        return False
    outcome = read_outcome(store, str(run.id))
    return outcome is not None and outcome.package is not None


def _give_up(client: SyncPrefectClient, run: FlowRun) -> None:
    """Cancel a scheduled run; leave a running one, which a restart of the catalog picks up."""
    if run.state is not None and run.state.is_scheduled():
        with suppress(httpx.HTTPError, PrefectHTTPStatusError):  # a run that is not cancelled is found again
            client.set_flow_run_state(run.id, Cancelled(message="the catalog was stopped"))


def _require_free_place(client: SyncPrefectClient, pool: str) -> None:
    """Refuse a pool whose concurrency limit the current run already fills."""
    run_id = runtime.flow_run.id
    own = client.read_flow_run(UUID(run_id)) if run_id else None
    if own is None or own.work_pool_name != pool:
        return
    limit = client.read_work_pool(pool).concurrency_limit
    if limit is not None and limit < 2:
        raise BadInput(
            f"the pool {pool} has concurrency limit 1, which this catalog takes: its items would never start; give "
            "another pool, or raise the limit"
        )
