"""ASGI application of the background server: Prefect's own, with artifacts, viewer and studio below `/dg4d/`."""

from pathlib import Path, PurePath

from fastapi import Depends, HTTPException, Response
from fastapi.responses import FileResponse, HTMLResponse
from prefect.settings import PREFECT_SERVER_API_AUTH_STRING
from pydantic import ValidationError
from starlette.types import ASGIApp

from dg4d_lib.errors import BadInput
from flows import home, prefect_compat
from flows.packages.view import viewer_of_artifact
from flows.prefect_compat import add_first
from flows.serving.access import SESSION, SignIn, protect
from flows.serving.addresses import ARTIFACT_ADDRESS, VIEWER_ADDRESS
from flows.serving.server import LOGIN
from steps.contract import ArtifactRef, load_object

STUDIO = "flows.studio.routes:add_routes"  # the page uses the engine, which uses this package
SHOWN = {".png": "image/png", ".json": "application/json"}  # inline; other files are downloads


def create_app() -> ASGIApp:
    """Build Prefect's application with artifacts, viewer and access control; needs DG4D_HOME in the environment.

    Raises:
        RuntimeError: the server has no secret.
    """
    secret = PREFECT_SERVER_API_AUTH_STRING.value()
    if not secret:
        raise RuntimeError(
            "PREFECT_SERVER_API_AUTH_STRING is not set: every client of this server could run code on its workers. Set "
            "it to NAME:PASSWORD here, and PREFECT_API_AUTH_STRING to the same for clients and workers."
        )
    application = prefect_compat.create_app()
    sign_in = SignIn(secret)
    file = "{digest}/{size}/{name}"
    signed_in = [Depends(sign_in.required)]
    add_first(application, ARTIFACT_ADDRESS + file, artifact, methods=["GET", "HEAD"], dependencies=signed_in)
    add_first(application, VIEWER_ADDRESS + file, viewer, methods=["GET", "HEAD"], dependencies=signed_in)
    load_object(STUDIO)(application, sign_in, secret)
    add_first(application, LOGIN, sign_in.page)
    add_first(application, SESSION, sign_in.session)
    return protect(application)


def artifact(digest: str, size: int, name: str) -> Response:
    """Return a file of the store, by the address that `pages.address` gives."""
    kind = SHOWN.get(PurePath(name).suffix)
    return FileResponse(
        _path(digest, size),
        media_type=kind or "application/octet-stream",
        filename=PurePath(name).name,
        content_disposition_type="inline" if kind else "attachment",
    )


def viewer(digest: str, size: int, name: str) -> Response:
    """Return the page of a package or of web splats, in an origin of its own: it cannot read the secret."""
    try:
        page = viewer_of_artifact(_path(digest, size), PurePath(name).stem)
    except BadInput as error:
        raise HTTPException(404, str(error)) from error
    policy = "sandbox allow-scripts allow-downloads; frame-ancestors 'self'"
    return HTMLResponse(page, headers={"Content-Security-Policy": policy, "X-Frame-Options": "SAMEORIGIN"})


def _path(digest: str, size: int) -> Path:
    """Return the file of an artifact.

    Raises:
        HTTPException: 404; it is not in the store.
    """
    try:
        ref = ArtifactRef(digest=f"sha256:{digest}", media_type="application/octet-stream", size_bytes=size)
    except ValidationError as error:
        raise HTTPException(404, "this is not the address of an artifact") from error
    store = home.store()
    if not store.has(ref):
        raise HTTPException(404, "this artifact is not in the store; run the same command again to renew it")
    return store.path(ref)
