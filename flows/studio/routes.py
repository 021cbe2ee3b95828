"""Routes of the studio page, below `/dg4d/studio`.

Reading needs the session of a browser, as artifacts do. Changes need the secret itself in the header `Authorization`:
no other page can send it, and the cookie, which other servers of this host may see, starts nothing.
"""

import zipfile
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path, PurePath
from typing import NamedTuple

from fastapi import Depends, FastAPI, HTTPException, Request, Response
from fastapi.responses import FileResponse, JSONResponse
from pydantic import ValidationError
from starlette.concurrency import run_in_threadpool

from dg4d_lib.errors import DG4DError
from flows import home
from flows.prefect_compat import add_first
from flows.serving.access import UNAUTHORIZED, SignIn
from flows.serving.addresses import STUDIO_ADDRESS
from flows.serving.auth import is_authorized
from flows.step_errors import StepError
from flows.studio import gallery
from flows.studio.changes import Changes
from flows.studio.drafts import TooLarge
from flows.studio.pages import HEADERS, Pages
from flows.studio.server_api import ServerApi
from steps.artifacts.archives import can_exist, stays_inside
from steps.contract import ArtifactRef, settings_errors
from steps.store.artifact_store import ArtifactMissing
from steps.store.files import DiskFull, remove_tree, write_atomically

Answer = Callable[[Request], Awaitable[Response]]

STATIC = {".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
INLINE = {".png": "image/png", ".webp": "image/webp", ".mp4": "video/mp4"}  # entries of zips; others are downloads
FOREVER = {"Cache-Control": "private, max-age=31536000, immutable"}  # of content that its address names
MOST_EXTRACTED = 100  # zips of which extracted files are kept


class Route(NamedTuple):
    """Path below the studio with its answer; `changes` asks for the secret."""

    path: str
    answer: Answer
    changes: bool = False


def add_routes(application: FastAPI, sign_in: SignIn, secret: str) -> None:
    """Add the page to the server's application.

    Args:
        application: Prefect's.
        sign_in: of browsers.
        secret: NAME:PASSWORD of the server.
    """

    def with_secret(request: Request) -> None:
        """Refuse a change without the secret.

        Raises:
            HTTPException: 401.
        """
        if not is_authorized(request.headers.get("authorization"), secret):
            raise HTTPException(401, UNAUTHORIZED)

    for route in routes(ServerApi(application, secret)):
        methods, needed = (["POST"], with_secret) if route.changes else (["GET", "HEAD"], sign_in.required)
        answer = _explained(route.answer)
        add_first(application, STUDIO_ADDRESS + route.path, answer, methods=methods, dependencies=[Depends(needed)])


def routes(api: ServerApi) -> list[Route]:
    """Return all routes of the studio."""
    pages, changes = Pages(api), Changes(api)
    return [
        Route("", pages.front),
        Route("/activity", pages.activity),
        Route("/drafts/{identifier}", pages.draft),
        Route("/runs/{identifier}", pages.run),
        Route("/runs/{identifier}/status", pages.run_status),
        Route("/assets/{key}", pages.asset),
        Route("/static/{name}", static),
        Route("/thumbnails/{digest}/{size}", thumbnail),
        Route("/entries/{digest}/{size}/{name:path}", entry),
        Route("/drafts", changes.create_draft, True),
        Route("/drafts/{identifier}/files", changes.upload, True),
        Route("/drafts/{identifier}/mask", changes.mask, True),
        Route("/drafts/{identifier}/cutout", changes.cut_out, True),
        Route("/drafts/{identifier}/motions", changes.motions, True),
        Route("/drafts/{identifier}/runs", changes.convert, True),
        Route("/runs/{identifier}/cancel", changes.cancel, True),
        Route("/runs/{identifier}/retry", changes.retry, True),
        Route("/assets/{key}/again", changes.repeat, True),
    ]


async def static(request: Request) -> Response:
    """Return the script or the style sheet."""
    name = request.path_params["name"]
    file = Path(__file__).parent / "static" / PurePath(name).name
    if name != file.name or file.suffix not in STATIC or not file.is_file():
        raise HTTPException(404, "there is no such file")
    return FileResponse(file, media_type=STATIC[file.suffix], headers={"Cache-Control": "no-cache"})


async def thumbnail(request: Request) -> Response:
    """Return a small picture of a package, WebP."""
    ref = _ref(request)
    small = await run_in_threadpool(lambda: gallery.thumbnail(ref, home.store()))
    if small is None:
        raise HTTPException(404, "this package shows no picture")
    return FileResponse(small, media_type="image/webp", headers=FOREVER)


async def entry(request: Request) -> Response:
    """Return a file inside a zip of the store."""
    ref, name = _ref(request), request.path_params["name"]
    path = await run_in_threadpool(lambda: _extracted(ref, name))
    kind = INLINE.get(path.suffix)
    return FileResponse(
        path,
        media_type=kind or "application/octet-stream",
        headers={**FOREVER, "Content-Security-Policy": "sandbox; default-src 'none'"},
        filename=path.name,
        content_disposition_type="inline" if kind else "attachment",
    )


def _extracted(ref: ArtifactRef, name: str) -> Path:
    """Return a file inside a zip of the store, extracted below the studio's folder: players ask for ranges of it.

    Raises:
        LookupError: there is no such file.
    """
    folder = home.studio() / "entries" / ref.digest.removeprefix("sha256:")
    path = folder / name
    try:
        if not stays_inside(name) or not can_exist(name):
            raise KeyError(name)
        if path.is_file():
            return path
        with zipfile.ZipFile(home.store().path(ref)) as archive:
            content = archive.read(name)
    except (zipfile.BadZipFile, KeyError) as error:
        raise LookupError(f"there is no file {name!r} here") from error
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, content)
    with suppress(FileNotFoundError):  # another request may be removing the same ones
        for old in sorted(folder.parent.iterdir(), key=lambda each: each.stat().st_mtime)[:-MOST_EXTRACTED]:
            remove_tree(old)
    return path


def _ref(request: Request) -> ArtifactRef:
    """Return the artifact that a path names.

    Raises:
        LookupError: it is the address of none.
    """
    try:
        digest, size = f"sha256:{request.path_params['digest']}", int(request.path_params["size"])
        return ArtifactRef(digest=digest, media_type="application/octet-stream", size_bytes=size)
    except ValueError as error:  # pydantic's is one
        raise LookupError("this is not the address of an artifact") from error


def _explained(answer: Answer) -> Answer:
    """Return an answer whose errors are sentences with a status."""

    async def explained(request: Request) -> Response:
        try:
            return await answer(request)
        except (DG4DError, LookupError, ValidationError) as error:
            return JSONResponse({"detail": _sentence(error)}, _status(error), headers=HEADERS)

    return explained


def _sentence(error: Exception) -> str:
    match error:
        case StepError():
            return error.message
        case ValidationError():
            return settings_errors(error)
        case LookupError():
            return str(error.args[0])
        case _:
            return str(error)


def _status(error: Exception) -> int:
    match error:
        case TooLarge():
            return 413
        case DiskFull():
            return 507
        case LookupError() | ArtifactMissing():
            return 404
        case _:
            return 422
