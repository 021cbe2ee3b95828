"""Idempotent registration of work pools, deployments and automations on a Prefect server."""

import subprocess
from collections.abc import Mapping
from datetime import timedelta

from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.client.schemas.actions import WorkPoolCreate
from prefect.client.schemas.objects import StateType
from prefect.events.actions import ChangeFlowRunState
from prefect.events.schemas.automations import AutomationCore, EventTrigger, Posture
from prefect.events.schemas.events import ResourceSpecification

from dg4d_lib.errors import BackendUnavailable
from flows import home
from flows.processes import locked, python
from flows.serving.pools import DEPLOYMENTS, Json, Pool, read_deployments
from flows.serving.workers import HEARTBEAT_S

MISSED = 3  # heartbeats before a run counts as crashed
REPORTED_S = 10  # a process worker reports a crash twice within this time
PATIENCE_S = 300.0  # for another command that registers, which takes about 10 s on an idle machine
ALIVE = "prefect.flow-run.heartbeat"
CRASHED = "prefect.flow-run.Crashed"
ENDINGS = {f"prefect.flow-run.{ending}" for ending in ("Completed", "Failed", "Cancelled")}
BEGINNINGS = {f"prefect.flow-run.{beginning}" for beginning in ("AwaitingRetry", "Scheduled", "Pending", "Running")}


def _trigger(after: str, expect: set[str], within_s: float) -> EventTrigger:
    """Return a trigger for runs of deployments that see none of the expected events within a time after an event."""
    return EventTrigger(
        after={after},
        expect=expect,
        match=ResourceSpecification({"prefect.resource.id": ["prefect.flow-run.*"]}),
        match_related=ResourceSpecification({"prefect.resource.role": ["deployment"]}),
        for_each={"prefect.resource.id"},
        posture=Posture.Proactive,
        threshold=1,
        within=timedelta(seconds=within_s),
    )


AUTOMATIONS = (
    AutomationCore(
        name="dg4d: mark orphaned runs as crashed",
        description="Marks runs as crashed whose worker or machine stopped without a report.",
        trigger=_trigger(ALIVE, {ALIVE, CRASHED, *ENDINGS}, MISSED * HEARTBEAT_S),
        actions=[
            ChangeFlowRunState(
                state=StateType.CRASHED,
                name=None,
                message=f"no heartbeat for {MISSED * HEARTBEAT_S} s: process killed or machine unreachable",
            )
        ],
    ),
    AutomationCore(
        name="dg4d: resume crashed runs",
        description="Resumes crashed runs on any worker; a run that crashes repeatedly fails.",
        trigger=_trigger(CRASHED, BEGINNINGS | ENDINGS, REPORTED_S),
        actions=[ChangeFlowRunState(state=StateType.SCHEDULED, name="AwaitingRetry", message="resumed after a crash")],
    ),
)
RENAMED = ("dg4d: runs whose process died", "dg4d: runs that died go on")  # names of these in earlier versions


def register(pools: Mapping[str, Pool], pool_names: list[str]) -> list[str]:
    """Create pools, their deployments, and the automations that restart crashed runs; return the deployments' names.

    Commands of one user wait for each other: two at a time would create every automation twice.

    Args:
        pools: all known pools by name.
        pool_names: names of the pools to create.

    Raises:
        BadInput: a pool is invalid; nothing was changed.
        BackendUnavailable: the server rejected the deployments, or another command has not finished in time.
    """
    with locked(home.locks() / "register.lock", patience_s=PATIENCE_S) as alone:
        if not alone:
            raise BackendUnavailable(
                f"another `dg4d up` or `dg4d studio` has not registered its deployments within {PATIENCE_S:g} s; end "
                "it, then run this again"
            )
        return _register(pools, pool_names)


def _register(pools: Mapping[str, Pool], pool_names: list[str]) -> list[str]:
    with get_client(sync_client=True) as client:
        workers = {kind: worker for types in client.read_worker_metadata().values() for kind, worker in types.items()}
        defaults = {kind: worker["default_base_job_configuration"] for kind, worker in workers.items()}
        templates = {name: pools[name].template(defaults[pools[name].type]) for name in pool_names}
        for name, template in templates.items():
            pool = pools[name]
            wanted = WorkPoolCreate(
                name=name,
                type=pool.type,
                description=pool.description,
                base_job_template=template,
                concurrency_limit=pool.limit,
            )
            client.create_work_pool(wanted, overwrite=True)
        deployments = [one for one in read_deployments() if one["work_pool"]["name"] in pool_names]
        _deploy(sorted({one["name"] for one in deployments}))
        _automate(client)
        there = {f"{client.read_flow(found.flow_id).name}/{found.name}" for found in client.read_deployments()}
    names = [f"{_flow_of(one)}/{one['name']}" for one in deployments]
    if missing := [name for name in names if name not in there]:
        raise BackendUnavailable(f"the Prefect server did not register the deployments {', '.join(missing)}")
    return names


def _flow_of(deployment: Json) -> str:
    """Return the name of the flow of a deployment, which is that of its function with dashes."""
    return str(deployment["entrypoint"]).rpartition(".")[2].replace("_", "-")


def _deploy(names: list[str]) -> None:
    """Run `prefect deploy`, so that the file means the same as with Prefect's own command."""
    options = [word for name in names for word in ("--name", name)]
    done = subprocess.run(
        python("-m", "prefect", "--no-prompt", "deploy", "--prefect-file", str(DEPLOYMENTS), *options),
        capture_output=True,
        text=True,
        check=False,
        cwd=DEPLOYMENTS.parents[1],
    )
    if done.returncode:
        raise BackendUnavailable(f"`prefect deploy` failed: {(done.stderr or done.stdout).strip()[-1000:]}")


def _automate(client: SyncPrefectClient) -> None:
    for name in RENAMED:
        for old in client.read_automations_by_name(name):
            client.delete_automation(old.id)
    for automation in AUTOMATIONS:
        known = client.read_automations_by_name(automation.name)
        for surplus in known[1:]:  # of commands on several machines at the same time
            client.delete_automation(surplus.id)
        if not known:
            client.create_automation(automation)
        elif _content(known[0]) != _content(automation):  # an update resets the runs that a trigger follows
            client.update_automation(known[0].id, automation)


def _content(automation: AutomationCore) -> Json:
    """Return an automation without the fields that the server adds."""
    return automation.model_dump(include=set(AutomationCore.model_fields))
