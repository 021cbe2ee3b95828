"""The application of the background server: Prefect's own, and at two more addresses what the store holds."""

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path, PurePath

from fastapi import FastAPI, Request, Response
from fastapi.responses import FileResponse, HTMLResponse, PlainTextResponse
from prefect.server.api.server import create_app as prefect_app
from prefect.server.database.configurations import AioSqliteConfiguration
from prefect.server.database.dependencies import MODELS_DEPENDENCIES
from prefect.settings import PREFECT_API_DATABASE_CONNECTION_URL
from pydantic import ValidationError
from sqlalchemy.ext.asyncio import AsyncSession, AsyncSessionTransaction

from dg4d_lib.errors import BadInput
from flows import home
from flows.packages.view import page_of_package
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


def create_app() -> FastAPI:
    """Prefect's application with the artifacts in front; needs DG4D_HOME in the environment."""
    database = PREFECT_API_DATABASE_CONNECTION_URL.value()
    if database.startswith("sqlite"):
        MODELS_DEPENDENCIES["database_config"] = OneWriter(connection_url=database)
    application = prefect_app()
    routes = application.router.routes
    for route in routes:
        if isinstance(part := getattr(route, "app", None), FastAPI):
            part.add_exception_handler(ConnectionError, database_away)
    for place, answer in ((ARTIFACT_ADDRESS, artifact), (VIEWER_ADDRESS, viewer)):
        application.add_api_route(place + "{digest}/{size}/{name}", answer, response_class=Response)
        routes.insert(0, routes.pop())  # before the user interface, which answers to every address
    return application


def database_away(request: Request, error: Exception) -> Response:
    """What a client hears while the database starts: "ask again", where Prefect says "broken"."""
    return PlainTextResponse("the database does not answer", 503)


def artifact(digest: str, size: int, name: str) -> Response:
    """One file of the store, by the address that `pages.address` gives."""
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
    """The page that plays a package of the store."""
    path = _path(digest, size)
    if isinstance(path, Response):
        return path
    try:
        return HTMLResponse(page_of_package(path, PurePath(name).stem))
    except BadInput as error:
        return PlainTextResponse(str(error), 404)


def _path(digest: str, size: int) -> Path | Response:
    """An artifact's file, or the answer that says why there is none."""
    try:
        ref = ArtifactRef(digest=f"sha256:{digest}", media_type="application/octet-stream", size_bytes=size)
    except ValidationError:
        return PlainTextResponse("no such artifact", 404)
    store = home.store()
    if not store.has(ref):
        return PlainTextResponse("this artifact is not in the store; run the same command again to renew it", 404)
    return store.path(ref)
