"""Pages of the studio and their fragments: reading only."""

import time
from collections.abc import Mapping
from typing import Any, get_args
from urllib.parse import urlencode

from fastapi import Request, Response
from fastapi.responses import HTMLResponse, JSONResponse
from starlette.concurrency import run_in_threadpool

from dg4d_lib.input_settings import Motion
from flows import home
from flows.serving.addresses import STUDIO_ADDRESS
from flows.studio import gallery, html, quick, status
from flows.studio.drafts import Draft, Upload
from flows.studio.remedies import remedies
from flows.studio.server_api import ServerApi
from flows.studio.submission import GPU, draft_tag

SIDES = ("90", "180", "-90")  # azimuths in degrees, suggested for further pictures in their order
RECENT = 12  # runs that the front page shows
POOL = "process-cpu"
MOTIONS: tuple[str, ...] = get_args(Motion)
DESCRIPTIONS = {
    "preview": "minutes on any machine, no model",
    "paper": "the paper's numbers; GPU and weights",
    "paper-lgm": "the paper's variant with LGM as the static stage; GPU and weights",
    "video": "for input videos, 32 frames; GPU and weights",
    "video-fast": "for input videos, 16 frames; GPU and weights",
    "release": "the public code's first release; GPU and weights",
    "reference": "the authors' public code; GPU and weights",
    "quality": "best of four motions, finer mesh; GPU and weights",
    "open": "models quoted as Apache-2.0; GPU and weights",
}
HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; media-src 'self'; "
        "connect-src 'self'; frame-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    ),
    "Cache-Control": "no-store",
}


class Pages:
    """Pages from the state in Prefect's runs, the store and `$DG4D_HOME`.

    Args:
        api: of the server.
    """

    def __init__(self, api: ServerApi) -> None:
        self._api = api

    async def front(self, request: Request) -> Response:
        """Return the first page: drop zone, running conversions, gallery."""
        wanted = gallery.Filter.model_validate(dict(request.query_params))
        found = await run_in_threadpool(lambda: gallery.assets(home.store()))
        selected = gallery.filtered(found, wanted)
        shown = gallery.page_of(selected, wanted.page)
        last = max(1, -(-len(selected) // gallery.PAGE))
        values = {"assets": shown, "count": len(selected), "total": len(found), "filter": wanted, "last": last}
        values["pages"] = {n: _query(wanted, n) for n in (wanted.page - 1, wanted.page + 1) if 1 <= n <= last}
        if request.headers.get("x-fragment"):
            return _page("cards.html", **values)
        await run_in_threadpool(quick.warm_up)  # so that the first cut-out does not wait
        return _page("front.html", runs=await self._recent(), profiles=gallery.profiles(found), **values)

    async def activity(self, request: Request) -> Response:
        """Return the list of running conversions."""
        return _page("activity.html", runs=await self._recent())

    async def draft(self, request: Request) -> Response:
        """Return the page on which a draft is corrected and converted."""
        draft = Draft(request.path_params["identifier"])
        uploads = await run_in_threadpool(draft.uploads)
        first = await run_in_threadpool(draft.first)
        others = [each for each in uploads if each.path != first.path]
        runs = [status.summary(run) for run in await self._api.runs([draft_tag(draft)], limit=RECENT)]
        return _page(
            "draft.html",
            draft=draft,
            first=first,
            others=others,
            suggested=dict(zip([each.name for each in others if each.kind == "picture"], SIDES, strict=False)),
            motions=MOTIONS if first.kind != "video" else (),
            profiles=DESCRIPTIONS,
            runs=runs,
            masks=_takes_mask(first),
        )

    async def run(self, request: Request) -> Response:
        """Return the page of one conversion."""
        run = await self._api.run(request.path_params["identifier"])
        current = await status.full(run, self._api, time.time())
        return _page("run.html", run=current, worker=await self._api.has_worker(_pool_of(current)))

    async def run_status(self, request: Request) -> Response:
        """Return the state of a conversion as JSON."""
        run = await self._api.run(request.path_params["identifier"])
        current = await status.full(run, self._api, time.time())
        return JSONResponse(current.model_dump(mode="json") | {"has_ended": current.has_ended}, headers=HEADERS)

    async def asset(self, request: Request) -> Response:
        """Return the page of an asset: viewer, downloads, verdicts, versions side by side."""
        found = await run_in_threadpool(lambda: gallery.find(home.store(), request.path_params["key"]))
        versions = {each.key: each for each in found.versions}
        left = versions.get(request.query_params.get("v", ""), found.newest)
        right = versions.get(request.query_params.get("with", ""))
        made = await run_in_threadpool(lambda: gallery.settings_of(left.version))
        run = await self._api.run_into(str(made[1]), found.key) if made else None
        drafts = [tag.removeprefix("draft-") for tag in (run or {}).get("tags", ()) if tag.startswith("draft-")]
        gates = [
            (gate, remedies(gate, made[0], left.version.steps) if made and run else [])
            for gate in (left.gates or {}).get("gates", ())
        ]
        return _page(
            "asset.html",
            asset=found,
            shown=left,
            other=right if right is not left else None,
            failed=[row for row in gates if not row[0]["passed"]],
            passed=[row for row in gates if row[0]["passed"]],
            can_repeat=run is not None,
            draft=drafts[0] if drafts else "",
            downloads=await run_in_threadpool(lambda: gallery.downloads(left, home.store())),
            entries=quick.entry_address(left.version.package),
        )

    async def _recent(self) -> list[status.RunStatus]:
        """Return active runs and the latest that did not succeed, each output folder once."""
        rows = await self._api.runs(limit=3 * RECENT)
        latest: dict[str, Mapping[str, Any]] = {}
        for row in rows:
            latest.setdefault(str(row["parameters"].get("out", row["id"])), row)
        shown = [status.summary(dict(row)) for row in latest.values()]
        return [each for each in shown if each.state != "done" or each.is_batch][:RECENT]


def _takes_mask(first: Upload) -> bool:
    return first.kind == "picture"


def _pool_of(run: status.RunStatus) -> str:
    return POOL if run.profile in {"", "preview"} else POOL.replace("cpu", GPU.rpartition(" ")[2].lower())


def _query(wanted: gallery.Filter, number: int) -> str:
    """Return the address of another page of the gallery."""
    values = {name: value for name, value in wanted.model_dump().items() if value and name != "page"}
    return f"{STUDIO_ADDRESS}?{urlencode({**values, 'page': number})}#gallery"


def _page(template: str, **values: object) -> Response:
    return HTMLResponse(html.render(template, **values), headers=HEADERS)
