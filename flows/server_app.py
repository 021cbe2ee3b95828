"""The application of the background server: Prefect's own, and the artifacts of the store at one more address."""

from pathlib import PurePath

from fastapi import FastAPI, Response
from fastapi.responses import FileResponse, PlainTextResponse
from prefect.server.api.server import create_app as prefect_app
from pydantic import ValidationError

from flows import home
from flows.pages import ARTIFACT_ADDRESS
from steps.contract import ArtifactRef

SHOWN = {".png": "image/png", ".json": "application/json"}  # what a browser shows; the rest is saved to disk


def create_app() -> FastAPI:
    """Prefect's application with the artifacts in front; needs DG4D_HOME in the environment."""
    application = prefect_app()
    application.add_api_route(ARTIFACT_ADDRESS + "{digest}/{size}/{name}", artifact, response_class=Response)
    routes = application.router.routes
    routes.insert(0, routes.pop())  # before the user interface, which answers to every address
    return application


def artifact(digest: str, size: int, name: str) -> Response:
    """One file of the store, by the address that `pages.address` gives."""
    try:
        ref = ArtifactRef(digest=f"sha256:{digest}", media_type="application/octet-stream", size_bytes=size)
    except ValidationError:
        return PlainTextResponse("no such artifact", 404)
    store = home.store()
    if not store.has(ref):
        return PlainTextResponse("this artifact is not in the store; run the same command again to renew it", 404)
    kind = SHOWN.get(PurePath(name).suffix)
    return FileResponse(
        store.path(ref),
        media_type=kind or ref.media_type,
        filename=PurePath(name).name,
        content_disposition_type="inline" if kind else "attachment",
    )
