"""Access control in front of the Prefect server: hosts, origins, and sign-in for artifact downloads."""

import os
import secrets
from importlib.resources import files
from urllib.parse import quote

from fastapi import HTTPException, Request, Response
from fastapi.responses import HTMLResponse, PlainTextResponse
from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from flows.serving.auth import SESSION_S, Sessions, is_authorized
from flows.serving.server import LOGIN

LOCAL_HOSTS = ("127.0.0.1", "localhost", "[::1]")
HOSTS_VARIABLE = "DG4D_SERVER_HOSTS"  # further host names of this server, separated by commas
PREFIX = "/dg4d/"  # of all routes beside Prefect's
SESSION = "/dg4d/session"
READING = frozenset(["GET", "HEAD", "OPTIONS"])
OWN_SITES = frozenset(["same-origin", "none"])  # Sec-Fetch-Site of our own pages, and of a typed address
UNAUTHORIZED = (
    "Unauthorized: sign in at the address that `dg4d up` or `dg4d studio` prints, or, on a server of your own, at "
    f"{LOGIN}#NAME:PASSWORD with the value of its $PREFECT_SERVER_API_AUTH_STRING."
)
HEADERS = {
    # Prefect's pages load nothing from elsewhere (they would report what is clicked), nor do pictures in artifacts;
    # without 'unsafe-eval' the drawing library of their run graph draws nothing
    "Content-Security-Policy": (
        "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
        "img-src 'self' data: blob:; font-src 'self' data:; worker-src 'self' blob:; object-src 'none'; "
        "base-uri 'self'; form-action 'self'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}


def allowed_hosts() -> list[str]:
    """Return the names under which this server may be addressed, without ports."""
    given = (name.strip() for name in os.environ.get(HOSTS_VARIABLE, "").split(","))
    return [*LOCAL_HOSTS, *(name for name in given if name and name != "*")]


def protect(application: ASGIApp) -> ASGIApp:
    """Wrap an application so that it refuses a foreign `Host` (DNS rebinding) and pages of other origins.

    Requests for `/api` are authenticated by Prefect itself, those for `/dg4d/` by `SignIn`. The application is wrapped
    rather than given middleware: Prefect's services call it within the process, under a host name of their own.
    """
    return TrustedHostMiddleware(SameOriginMiddleware(application), allowed_hosts(), www_redirect=False)


class SameOriginMiddleware:
    """Refuse requests and WebSockets of foreign pages; forbid browsers to embed or share responses."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request, or refuse it with 403."""
        if scope["type"] not in {"http", "websocket"}:
            await self._app(scope, receive, send)
            return
        if is_foreign(Headers(scope=scope), scope.get("method", "WEBSOCKET")):
            if scope["type"] == "websocket":
                await send({"type": "websocket.close", "code": 1008, "reason": "foreign origin"})
            else:
                await PlainTextResponse("refused: this request comes from a page of another origin", 403)(
                    scope, receive, send
                )
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        await self._app(scope, receive, with_headers)


def is_foreign(headers: Headers, method: str) -> bool:
    """Return true if a request was made by a page of another origin.

    The scheme is not compared: a proxy may add TLS in front of this server.

    Args:
        headers: of the request; `Host` was checked before.
        method: HTTP method, or "WEBSOCKET".
    """
    origin = headers.get("origin")
    if origin is not None and origin.partition("://")[2].lower() != headers.get("host", "").lower():
        return True
    return method not in READING and headers.get("sec-fetch-site", "none") not in OWN_SITES


class SignIn:
    """Sign-in of browsers to the routes below `/dg4d/`: they need the secret, or the cookie it was exchanged for.

    Args:
        secret: NAME:PASSWORD of the server.
    """

    def __init__(self, secret: str) -> None:
        self._secret, self._sessions = secret, Sessions(secret)

    def required(self, request: Request) -> None:
        """Refuse a request that is not signed in; send the address bar of a browser to the sign-in page.

        Raises:
            HTTPException: 401, or 303 to the sign-in page.
        """
        if is_authorized(request.headers.get("authorization"), self._secret) or self._has_session(request):
            return
        if request.headers.get("sec-fetch-dest") == "document":
            query = f"?{request.url.query}" if request.url.query else ""
            wanted = quote(request.scope["path"]) + query
            raise HTTPException(303, headers={"Location": f"{LOGIN}?next={quote(wanted)}"})
        raise HTTPException(401, UNAUTHORIZED)

    def session(self, request: Request) -> Response:
        """Exchange the secret for a cookie."""
        if not is_authorized(request.headers.get("authorization"), self._secret):
            raise HTTPException(401, "Unauthorized")
        answer = Response(status_code=204, headers={"Cache-Control": "no-store"})
        answer.set_cookie(
            self._sessions.cookie,
            self._sessions.issue(),
            max_age=SESSION_S,
            path=PREFIX,
            httponly=True,
            samesite="strict",
        )
        return answer

    def page(self) -> Response:
        """Return the page that hands the secret in its address to Prefect's pages and opens a session."""
        nonce = secrets.token_urlsafe(16)
        page = files("flows.serving").joinpath("login.html").read_text(encoding="utf-8")
        policy = (
            f"default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; connect-src 'self'; "
            "base-uri 'none'; form-action 'none'"
        )
        headers = {"Content-Security-Policy": policy, "Cache-Control": "no-store"}
        return HTMLResponse(page.replace("NONCE", nonce), headers=headers)

    def _has_session(self, request: Request) -> bool:
        """Check the cookie of a request from our own pages; a page on another port of this host sends it too."""
        return request.headers.get("sec-fetch-site") in OWN_SITES and self._sessions.is_valid(
            request.cookies.get(self._sessions.cookie)
        )
