"""ASGI application of the background server: Prefect's own, with artifacts and viewer below `/dg4d/`.

`python -m flows.serving.server_app FD` serves it on a listening socket that it inherits.
"""

import socket
import sys
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path, PurePath

import uvicorn
from fastapi import Depends, FastAPI, Request, Response
from fastapi.responses import FileResponse, HTMLResponse, PlainTextResponse
from prefect.server.api.server import create_app as prefect_app
from prefect.server.api.server import custom_internal_exception_handler
from prefect.server.database.configurations import AioSqliteConfiguration
from prefect.server.database.dependencies import MODELS_DEPENDENCIES
from prefect.settings import PREFECT_API_DATABASE_CONNECTION_URL, PREFECT_SERVER_API_AUTH_STRING
from pydantic import ValidationError
from sqlalchemy.ext.asyncio import AsyncSession, AsyncSessionTransaction
from starlette.types import ASGIApp

from dg4d_lib.errors import BadInput
from flows import home
from flows.packages.view import page_of_package
from flows.serving.access import SESSION, SignIn, protect
from flows.serving.server import LOGIN
from flows.ui.pages import ARTIFACT_ADDRESS, VIEWER_ADDRESS
from steps.contract import ArtifactRef

SHOWN = {".png": "image/png", ".json": "application/json"}  # what a browser shows; the rest is saved to disk


class OneWriter(AioSqliteConfiguration):
    """SQLite whose transactions take their turn at the beginning.

    One that begins to write after it has read is refused at once if another has written in between; the server then
    answers 503, and a client waits two seconds and more before it asks again: half the time of a batch.
    """

    @asynccontextmanager
    async def begin_transaction(
        self, session: AsyncSession, with_for_update: bool = False
    ) -> AsyncGenerator[AsyncSessionTransaction, None]:
        """As Prefect's, with the lock for writing from the beginning."""
        async with super().begin_transaction(session, with_for_update=True) as transaction:
            yield transaction


def create_app() -> ASGIApp:
    """Build Prefect's application with artifacts, viewer and access control; needs DG4D_HOME in the environment.

    Raises:
        RuntimeError: the server has no secret.
    """
    secret = PREFECT_SERVER_API_AUTH_STRING.value()
    if not secret:
        raise RuntimeError(
            "PREFECT_SERVER_API_AUTH_STRING is not set: whoever reaches this server could run code on its workers. Set "
            "it to NAME:PASSWORD here, and PREFECT_API_AUTH_STRING to the same for clients and workers."
        )
    database = PREFECT_API_DATABASE_CONNECTION_URL.value()
    if database.startswith("sqlite"):
        MODELS_DEPENDENCIES["database_config"] = OneWriter(connection_url=database)
    application = prefect_app()
    routes = application.router.routes
    for route in routes:
        if isinstance(part := getattr(route, "app", None), FastAPI):
            part.add_exception_handler(ConnectionError, database_away)
    application.add_exception_handler(Exception, unavailable)  # Prefect's CSRF check reads the database before its API
    sign_in = SignIn(secret)
    file = "{digest}/{size}/{name}"
    for path, answer, signed_in in (
        (ARTIFACT_ADDRESS + file, artifact, True),
        (VIEWER_ADDRESS + file, viewer, True),
        (LOGIN, sign_in.page, False),
        (SESSION, sign_in.session, False),
    ):
        required = [Depends(sign_in.required)] if signed_in else []
        application.add_api_route(path, answer, response_class=Response, dependencies=required, include_in_schema=False)
        routes.insert(0, routes.pop())  # before the user interface, which answers to every address
    return protect(application)


def serve(listener: socket.socket) -> None:
    """Serve the application on a bound socket until the process is told to stop."""
    uvicorn.Server(uvicorn.Config(create_app(), log_level="warning")).run(sockets=[listener])


def database_away(request: Request, error: Exception) -> Response:
    """Return 503 (retryable) while the database starts."""
    return PlainTextResponse("the database does not answer", 503)


async def unavailable(request: Request, error: Exception) -> Response:
    """Answer an error outside of the API: 503 if the request may be repeated, else 500."""
    if isinstance(error, ConnectionError):
        return database_away(request, error)
    return await custom_internal_exception_handler(request, error)


def artifact(digest: str, size: int, name: str) -> Response:
    """Return a file of the store, by the address that `pages.address` gives."""
    path = _path(digest, size)
    if isinstance(path, Response):
        return path
    kind = SHOWN.get(PurePath(name).suffix)
    return FileResponse(
        path,
        media_type=kind or "application/octet-stream",
        filename=PurePath(name).name,
        content_disposition_type="inline" if kind else "attachment",
    )


def viewer(digest: str, size: int, name: str) -> Response:
    """Return the page that plays a package of the store, in an origin of its own: it cannot read the secret."""
    path = _path(digest, size)
    if isinstance(path, Response):
        return path
    try:
        page = page_of_package(path, PurePath(name).stem)
        return HTMLResponse(page, headers={"Content-Security-Policy": "sandbox allow-scripts allow-downloads"})
    except BadInput as error:
        return PlainTextResponse(str(error), 404)


def _path(digest: str, size: int) -> Path | Response:
    """Return the file of an artifact, or a 404."""
    try:
        ref = ArtifactRef(digest=f"sha256:{digest}", media_type="application/octet-stream", size_bytes=size)
    except ValidationError:
        return PlainTextResponse("no such artifact", 404)
    store = home.store()
    if not store.has(ref):
        return PlainTextResponse("this artifact is not in the store; run the same command again to renew it", 404)
    return store.path(ref)


if __name__ == "__main__":
    serve(socket.socket(fileno=int(sys.argv[1])))
