"""Prefect's API, called within the server's process as its clients call it over HTTP."""

from collections.abc import Mapping, Sequence
from typing import Any
from uuid import UUID

import httpx
from fastapi import HTTPException
from prefect.client.base import PrefectHttpxAsyncClient
from starlette.types import ASGIApp

from flows.serving.auth import basic

TAG = "studio"  # of the runs that the page started
PAGE = 200  # rows in one answer of the server
ENDED = {"COMPLETED", "FAILED", "CANCELLED"}  # a crashed run is started again by itself

Row = dict[str, Any]


class ServerApi:
    """Client of Prefect's API; the application answers in this process.

    Args:
        application: Prefect's application.
        secret: NAME:PASSWORD of the server.
    """

    def __init__(self, application: ASGIApp, secret: str) -> None:
        self._client = PrefectHttpxAsyncClient(
            transport=httpx.ASGITransport(app=application, raise_app_exceptions=False),
            headers={"Authorization": basic(secret)},
            base_url="http://studio/api",
            enable_csrf_support=True,
            raise_on_all_errors=False,
        )

    async def start(self, deployment: str, name: str, parameters: Mapping[str, Any], tags: Sequence[str]) -> str:
        """Start a run of a deployment, and return its id.

        Raises:
            HTTPException: 409 if the deployment is not registered; 422 if it refuses the parameters.
        """
        found = await self._client.get(f"/deployments/name/{deployment}")
        if found.status_code == httpx.codes.NOT_FOUND:
            raise HTTPException(
                409, f"the deployment {deployment!r} is not registered; run `dg4d up` with its work pool (--pool)"
            )
        wanted = {"parameters": dict(parameters), "name": name, "tags": [TAG, *tags]}
        answer = await self._client.post(f"/deployments/{found.json()['id']}/create_flow_run", json=wanted)
        if answer.status_code >= httpx.codes.BAD_REQUEST:
            raise HTTPException(422, f"the server refused the run: {_detail(answer)}")
        return str(answer.json()["id"])

    async def run(self, identifier: str) -> Row:
        """Return a flow run.

        Raises:
            HTTPException: 404; there is none, or the page did not start it.
        """
        nothing = HTTPException(404, "there is no such conversion")
        try:
            answer = await self._client.get(f"/flow_runs/{UUID(identifier)}")
        except ValueError:
            raise nothing from None
        if answer.status_code != httpx.codes.OK or TAG not in answer.json()["tags"]:
            raise nothing
        row: Row = answer.json()
        return row

    async def runs(self, tags: Sequence[str] = (), limit: int = PAGE) -> list[Row]:
        """Return runs that the page started, the newest first.

        Args:
            tags: all of which they have.
            limit: largest number.
        """
        wanted = {"tags": {"all_": [TAG, *tags]}}
        return await self._filter(
            "flow_runs", {"flow_runs": wanted, "sort": "EXPECTED_START_TIME_DESC", "limit": limit}
        )

    async def run_into(self, out: str, tag: str) -> Row | None:
        """Return the run with a tag that made the package in an output folder; None if the page started none."""
        rows = await self.runs([tag])
        return next((row for row in rows if row["parameters"].get("out") == out), None)

    async def children(self, identifier: str) -> list[Row]:
        """Return the flow runs that a run started, the oldest first."""
        wanted = {"parent_flow_run_id": {"any_": [identifier]}}
        return await self._filter("flow_runs", {"flow_runs": wanted, "sort": "START_TIME_ASC", "limit": PAGE})

    async def tasks(self, runs: Sequence[str]) -> list[Row]:
        """Return the task runs of flow runs, the latest end first."""
        return await self._filter(
            "task_runs", {"flow_runs": {"id": {"any_": list(runs)}}, "sort": "END_TIME_DESC", "limit": PAGE}
        )

    async def artifacts(self, runs: Sequence[str]) -> list[Row]:
        """Return the artifacts of flow runs, the newest first."""
        return await self._filter(
            "artifacts", {"artifacts": {"flow_run_id": {"any_": list(runs)}}, "sort": "UPDATED_DESC", "limit": PAGE}
        )

    async def cancel(self, run: Row) -> None:
        """Cancel a run: a scheduled run never starts, and a crashed one is not restarted.

        Raises:
            HTTPException: 409; it cannot be cancelled.
        """
        kind = "CANCELLED" if run["state_type"] == "CRASHED" else "CANCELLING"  # nothing runs that could be ended
        state = {"type": kind, "name": kind.capitalize(), "message": "cancelled in the studio"}
        answer = await self._client.post(f"/flow_runs/{run['id']}/set_state", json={"state": state})
        reached = (answer.json().get("state") or {}).get("type") if answer.is_success else None
        if reached not in {"CANCELLING", "CANCELLED"}:  # of a run that has no process yet it is the latter
            raise HTTPException(409, "this conversion has ended and cannot be cancelled")

    async def has_worker(self, pool: str) -> bool:
        """Return true if a worker serves a pool."""
        answer = await self._client.post(f"/work_pools/{pool}/workers/filter", json={})
        return answer.status_code == httpx.codes.OK and any(row["status"] == "ONLINE" for row in answer.json())

    async def _filter(self, kind: str, wanted: Row) -> list[Row]:
        answer = await self._client.post(f"/{kind}/filter", json=wanted)
        if answer.status_code != httpx.codes.OK:
            raise HTTPException(503, f"the Prefect server does not answer: {_detail(answer)}")
        rows: list[Row] = answer.json()
        return rows


def _detail(answer: httpx.Response) -> str:
    """Return the reason that the server gives, shortened."""
    try:
        detail = answer.json().get("detail", answer.text)
    except ValueError:
        detail = answer.text
    return str(detail)[:500]
