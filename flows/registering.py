"""Work pools, deployments and automations put on a Prefect server, again and again with the same result."""

import os
import subprocess
import sys
from collections.abc import Mapping
from datetime import timedelta

from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.client.schemas.actions import WorkPoolCreate
from prefect.client.schemas.objects import StateType
from prefect.events.actions import ChangeFlowRunState
from prefect.events.schemas.automations import AutomationCore, EventTrigger, Posture
from prefect.events.schemas.events import ResourceSpecification

from dg4d_lib.errors import BackendUnavailable
from flows.pools import DEPLOYMENTS, Json, Pool, read_deployments
from flows.workers import HEARTBEAT_S

DEAD = "dg4d: runs whose process died"  # the name of the automation
MISSED = 3  # heartbeats, before a run is taken for dead
ENDINGS = ("Completed", "Failed", "Cancelled", "Crashed")


def register(pools: Mapping[str, Pool], chosen: list[str]) -> list[str]:
    """Have the chosen pools, their deployments, and an automation that notices runs whose process died.

    Args:
        pools: every pool that there may be, by name.
        chosen: the names of those to make.

    Returns:
        The full names of the deployments.

    Raises:
        BadInput: a pool or a deployment that cannot be; nothing was changed.
        BackendUnavailable: the server did not take it.
    """
    with get_client(sync_client=True) as client:
        defaults = default_templates(client)
        deployments = [
            deployment
            for deployment in read_deployments(pools, defaults, os.environ)
            if deployment["work_pool"]["name"] in chosen
        ]
        templates = {name: pools[name].template(defaults[pools[name].type]) for name in chosen}
        for name, template in templates.items():
            pool = pools[name]
            client.create_work_pool(
                WorkPoolCreate(
                    name=name,
                    type=pool.type,
                    description=pool.description,
                    base_job_template=template,
                    concurrency_limit=pool.limit,
                ),
                overwrite=True,
            )
        _deploy(sorted({deployment["name"] for deployment in deployments}))
        _notice_the_dead(client)
        there = {f"{client.read_flow(found.flow_id).name}/{found.name}" for found in client.read_deployments()}
    wanted = [f"{deployment['tags'][0]}/{deployment['name']}" for deployment in deployments]
    if missing := [name for name in wanted if name not in there]:
        raise BackendUnavailable(f"the Prefect server did not take the deployments {', '.join(missing)}")
    return wanted


def default_templates(client: SyncPrefectClient) -> dict[str, Json]:
    """The base job template of every kind of worker."""
    collections = client.read_worker_metadata().values()
    return {
        kind: worker["default_base_job_configuration"]
        for collection in collections
        for kind, worker in collection.items()
    }


def _deploy(names: list[str]) -> None:
    """Prefect's own reading of the file, so that it means here what it means elsewhere."""
    chosen = [word for name in names for word in ("--name", name)]
    done = subprocess.run(
        [sys.executable, "-m", "prefect", "--no-prompt", "deploy", "--prefect-file", str(DEPLOYMENTS), *chosen],
        capture_output=True,
        text=True,
        check=False,
        cwd=DEPLOYMENTS.parents[1],
    )
    if done.returncode:
        raise BackendUnavailable(f"`prefect deploy` failed: {(done.stderr or done.stdout).strip()[-1000:]}")


def _notice_the_dead(client: SyncPrefectClient) -> None:
    """A run that was alive and misses its heartbeats has crashed; `dg4d make` has no heartbeats and is not meant."""
    automation = AutomationCore(
        name=DEAD,
        description="A worker or a whole machine that dies reports nothing; its runs would stay Running for ever.",
        trigger=EventTrigger(
            after={"prefect.flow-run.heartbeat"},
            expect={"prefect.flow-run.heartbeat", *(f"prefect.flow-run.{ending}" for ending in ENDINGS)},
            match=ResourceSpecification({"prefect.resource.id": ["prefect.flow-run.*"]}),
            for_each={"prefect.resource.id"},
            posture=Posture.Proactive,
            threshold=1,
            within=timedelta(seconds=MISSED * HEARTBEAT_S),
        ),
        actions=[
            ChangeFlowRunState(
                state=StateType.CRASHED,
                name=None,
                message=f"no heartbeat for {MISSED * HEARTBEAT_S} s: its process was killed, or its machine is gone",
            )
        ],
    )
    known = client.find_automation(DEAD)
    if known is None:
        client.create_automation(automation)
    else:
        client.update_automation(known.id, automation)
