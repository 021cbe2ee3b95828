"""Requests of the studio page that change something: uploads, cut-outs, conversions, cancel, retry, repetition."""

from typing import Any, TypeVar

from fastapi import HTTPException, Request, Response
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect

from dg4d_lib.errors import BadInput
from flows import home
from flows.serving.addresses import STUDIO_ADDRESS
from flows.studio import gallery, quick
from flows.studio.drafts import MOST_MASK_BYTES, Draft, TooLarge
from flows.studio.pages import HEADERS
from flows.studio.server_api import ENDED, ServerApi
from flows.studio.submission import RunRequest, Submission, convert, repetition, retry
from steps.contract import LARGEST_SEED, Frozen

T = TypeVar("T", bound=BaseModel)

LARGEST_JSON = 2**20  # bytes of a request
CLOSED = 499  # status, for the log alone: the client ended the request


class Region(Frozen):
    """Region of a draft whose cut-out or motions are asked for.

    Attributes:
        file: name of the file; empty: the first.
        box: left, top, width, height in pixels; empty: the whole picture.
        masked: true to use the matte that the page drew.
    """

    file: str = ""
    box: tuple[int, ...] = Field((), max_length=4)
    masked: bool = False
    profile: str = "preview"


class Repetition(Frozen):
    """Changes of a repeated conversion.

    Attributes:
        version: short name of the version that is repeated.
        settings: NAME=VALUE.
        seed: other seed; None: as before.
    """

    version: str
    settings: tuple[str, ...] = Field((), max_length=20)
    seed: int | None = Field(None, ge=0, le=LARGEST_SEED)


class Changes:
    """Answers to changes.

    Args:
        api: of the server.
    """

    def __init__(self, api: ServerApi) -> None:
        self._api = api

    async def create_draft(self, request: Request) -> Response:
        """Make an empty draft."""
        draft = await run_in_threadpool(Draft.create)
        return _json({"id": draft.identifier, "address": f"{STUDIO_ADDRESS}/drafts/{draft.identifier}"}, 201)

    async def upload(self, request: Request) -> Response:
        """Keep one file of a draft, streamed as the body; its name is in the query."""
        draft = Draft(request.path_params["identifier"])
        try:
            kept = await draft.receive(request.query_params.get("name", ""), request.stream())
        except ClientDisconnect:
            return Response(status_code=CLOSED)
        return _json({"name": kept.name, "kind": kept.kind}, 201)

    async def mask(self, request: Request) -> Response:
        """Keep the matte that the page drew, of the size of the source."""
        draft = Draft(request.path_params["identifier"])
        content = await _body(request, MOST_MASK_BYTES)

        def keep() -> None:
            cut = quick.cut_out(draft, draft.first())
            draft.save_mask(content, (cut.width, cut.height))

        await run_in_threadpool(keep)
        return _json({}, 201)

    async def cut_out(self, request: Request) -> Response:
        """Cut the subject out of a file of a draft."""
        draft, region = Draft(request.path_params["identifier"]), await _parsed(request, Region)

        def cut() -> quick.CutOut:
            upload = draft.upload(region.file) if region.file else draft.first()
            return quick.cut_out(draft, upload, region.box)

        return _json((await run_in_threadpool(cut)).model_dump(mode="json"))

    async def motions(self, request: Request) -> Response:
        """Generate preview videos of the motions of a draft."""
        draft, region = Draft(request.path_params["identifier"]), await _parsed(request, Region)
        found = await run_in_threadpool(lambda: quick.motion_previews(draft, region.profile, region.box, region.masked))
        return _json({"films": [preview.model_dump() for preview in found]})

    async def convert(self, request: Request) -> Response:
        """Start the conversion of a draft."""
        draft, wanted = Draft(request.path_params["identifier"]), await _parsed(request, Submission)
        return await self._start(await run_in_threadpool(lambda: convert(draft, wanted)))

    async def cancel(self, request: Request) -> Response:
        """Cancel a conversion."""
        await self._api.cancel(await self._api.run(request.path_params["identifier"]))
        return _json({})

    async def retry(self, request: Request) -> Response:
        """Restart a conversion that did not succeed."""
        run = await self._api.run(request.path_params["identifier"])
        if run["state_type"] not in ENDED:
            raise HTTPException(409, "this conversion has not ended; cancel it first")
        return await self._start(retry(run))

    async def repeat(self, request: Request) -> Response:
        """Start the conversion of an asset with changed settings."""
        key, wanted = request.path_params["key"], await _parsed(request, Repetition)
        found = await run_in_threadpool(lambda: gallery.find(home.store(), key))
        shown = next((each for each in found.versions if each.key == wanted.version), None)
        if shown is None:
            raise LookupError("there is no such version")
        made = await run_in_threadpool(lambda: gallery.settings_of(shown.version))
        run = await self._api.run_into(str(made[1]), key) if made else None
        if run is None:
            raise BadInput(
                "this version was not made in the studio; repeat it with `dg4d make` and the settings in its report"
            )
        return await self._start(repetition(run, wanted.settings, wanted.seed))

    async def _start(self, wanted: RunRequest) -> Response:
        identifier = await self._api.start(*wanted)
        return _json({"id": identifier, "address": f"{STUDIO_ADDRESS}/runs/{identifier}"}, 201)


async def _parsed(request: Request, kind: type[T]) -> T:
    """Return the body of a request as a model."""
    return kind.model_validate_json(await _body(request, LARGEST_JSON) or b"{}")


async def _body(request: Request, most: int) -> bytes:
    """Return the body of a request.

    Raises:
        TooLarge: it has more bytes than that.
    """
    content = bytearray()
    async for chunk in request.stream():
        content += chunk
        if len(content) > most:
            raise TooLarge(f"the request has more than {most} bytes")
    return bytes(content)


def _json(content: dict[str, Any], status: int = 200) -> Response:
    return JSONResponse(content, status, headers=HEADERS)
