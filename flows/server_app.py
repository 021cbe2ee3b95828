"""The application of the background server: Prefect's own, and the artifacts of the store at one more address."""

from pathlib import PurePath

from prefect.server.api.server import create_app as prefect_app
from pydantic import ValidationError
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Route

from flows import home
from flows.pages import ARTIFACT_ADDRESS
from steps.contract import ArtifactRef

SHOWN = {".png": "image/png", ".json": "application/json"}  # what a browser shows; the rest is saved to disk


def create_app() -> Starlette:
    """Prefect's application with the artifacts in front; needs DG4D_HOME in the environment."""
    application: Starlette = prefect_app()
    application.router.routes.insert(0, Route(ARTIFACT_ADDRESS + "{digest}/{size:int}/{name}", artifact))
    return application


def artifact(request: Request) -> Response:
    """One file of the store, by the address that `pages.address` gives."""
    name = request.path_params["name"]
    try:
        ref = ArtifactRef(
            digest=f"sha256:{request.path_params['digest']}",
            media_type="application/octet-stream",
            size_bytes=request.path_params["size"],
        )
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
