"""Access to the background server: the secret, hosts, origins, cookies, and permissions of files."""

import http.client
import json
import stat
import threading
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest
from prefect.client.orchestration import get_client
from starlette.datastructures import Headers

from flows import home
from flows.serving import access, background, server_app
from flows.serving.auth import SESSION_S, Sessions, auth_string, basic, is_authorized
from flows.serving.server import Server
from steps.contract import ArtifactRef
from steps.store.artifact_store import ArtifactStore
from tests.clients.node import run_node

PNG = b"\x89PNG\r\n\x1a\n"
OWN_PAGE = {"Sec-Fetch-Site": "same-origin"}


def ask(
    server: Server, path: str, method: str = "GET", body: str | None = None, **headers: str
) -> tuple[int, Mapping[str, str], bytes]:
    """Send a request as a program would that does not know the secret; underscores in names of headers are dashes."""
    host = str(server.address()).removeprefix("http://")
    connection = http.client.HTTPConnection(host, timeout=30)
    try:
        connection.request(method, path, body, {name.replace("_", "-"): value for name, value in headers.items()})
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()
    finally:
        connection.close()


@pytest.fixture
def artifact(server: Server) -> ArtifactRef:
    """A picture in the store of the server."""
    return ArtifactStore(server.folder.parent / "store").put_bytes(PNG, "image/png")


def address_of(ref: ArtifactRef) -> str:
    return f"/dg4d/artifacts/{ref.digest.removeprefix('sha256:')}/{ref.size_bytes}/subject.png"


def test_the_secret_is_made_once_and_only_its_owner_can_read_it(tmp_path: Path) -> None:
    found: list[str] = []
    commands = [threading.Thread(target=lambda: found.append(auth_string(tmp_path / "server"))) for _ in range(8)]
    for command in commands:
        command.start()
    for command in commands:
        command.join()
    assert len(found) == 8 and len(set(found)) == 1
    assert len(found[0]) > 40 and found[0] != auth_string(tmp_path / "other")
    (tmp_path / "server" / "auth").chmod(0o644)
    assert auth_string(tmp_path / "server") == found[0]
    assert stat.S_IMODE((tmp_path / "server" / "auth").stat().st_mode) == 0o600
    (tmp_path / "server" / "auth").write_text("")
    assert len(auth_string(tmp_path / "server")) > 40
    assert [path.name for path in (tmp_path / "server").iterdir()] == ["auth"]


@pytest.mark.parametrize("header", [None, "", "Basic", "Bearer dg4d:word", basic("dg4d:wird"), "Basic é"])
def test_another_header_is_not_authorized(header: str | None) -> None:
    assert not is_authorized(header, "dg4d:word")
    assert is_authorized(basic("dg4d:word"), "dg4d:word")


def test_a_session_expires_and_cannot_be_prolonged_or_moved_to_another_server() -> None:
    sessions = Sessions("dg4d:word")
    cookie = sessions.issue(now=1000)
    assert sessions.is_valid(cookie, now=1000 + SESSION_S - 1)
    assert not sessions.is_valid(cookie, now=1000 + SESSION_S)
    expires, _, signature = cookie.partition(".")
    for forged in (
        None,
        "",
        ".",
        expires,
        f"{int(expires) + 1}.{signature}",
        f"{expires}.{signature[:-1]}",
        f"é.{signature}",
    ):
        assert not sessions.is_valid(forged, now=1000)
    assert not Sessions("dg4d:wird").is_valid(cookie, now=1000)
    assert Sessions("dg4d:wird").cookie != sessions.cookie
    assert "word" not in cookie + sessions.cookie


@pytest.mark.parametrize(
    ("method", "headers", "foreign"),
    [
        ("GET", {}, False),
        ("POST", {}, False),  # a program
        ("POST", {"origin": "http://127.0.0.1:4200", "sec-fetch-site": "same-origin"}, False),
        ("POST", {"origin": "https://127.0.0.1:4200"}, False),  # behind a proxy with TLS
        ("GET", {"sec-fetch-site": "cross-site"}, False),  # a link
        ("GET", {"origin": "http://127.0.0.1:4201"}, True),
        ("GET", {"origin": "null"}, True),
        ("POST", {"origin": "http://evil.example"}, True),
        ("POST", {"origin": "http://127.0.0.1:4200.evil.example"}, True),
        ("POST", {"origin": ""}, True),
        ("POST", {"origin": "http://["}, True),
        ("POST", {"sec-fetch-site": "cross-site"}, True),
        ("DELETE", {"sec-fetch-site": "same-site"}, True),  # another port of this host
        ("WEBSOCKET", {"origin": "http://localhost:4200"}, True),
        ("WEBSOCKET", {"origin": "http://127.0.0.1:4200"}, False),
    ],
)
def test_a_request_of_a_page_of_another_origin_is_foreign(method: str, headers: dict[str, str], foreign: bool) -> None:
    assert access.is_foreign(Headers({"host": "127.0.0.1:4200", **headers}), method) is foreign


def test_a_server_without_a_secret_does_not_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_app.PREFECT_SERVER_API_AUTH_STRING, "value", lambda: None, raising=False)
    with pytest.raises(RuntimeError, match="PREFECT_SERVER_API_AUTH_STRING"):
        server_app.create_app()


@pytest.mark.parametrize("path", ["/api/flows/filter", "/api/deployments/", "/api/flow_runs/filter", "/api/events"])
def test_the_api_answers_nobody_without_the_secret(server: Server, path: str) -> None:
    for headers in ({}, {"Authorization": basic("dg4d:guess")}, {"Cookie": "prefect-password=x"}):
        status, _, _ = ask(server, path, "POST", "{}", Content_Type="application/json", **headers)
        assert status in {401, 403}
    assert ask(server, "/api/admin/settings")[0] == 401
    assert ask(server, "/api/admin/settings", Authorization=basic(server.auth_string()))[0] == 200


def test_a_change_needs_the_token_against_forged_requests_too(server: Server) -> None:
    signed_in = {"Authorization": basic(server.auth_string())}
    status, _, said = ask(server, "/api/flows/", "POST", '{"name": "x"}', **signed_in)
    assert status == 403 and b"CSRF" in said
    with get_client(sync_client=True) as client:
        assert client.request("POST", "/flows/", json={"name": "x"}).status_code in {200, 201}


@pytest.mark.parametrize("host", ["rebind.evil.example", "127.0.0.1.evil.example", "evil.example:80", ""])
def test_a_request_for_another_host_is_refused(server: Server, host: str) -> None:
    for path in ("/api/health", "/", "/dg4d/login"):
        assert ask(server, path, Host=host)[0] == 400


def test_a_page_of_another_origin_is_refused_and_never_allowed_to_read(server: Server) -> None:
    signed_in = {"Authorization": basic(server.auth_string())}
    for origin in ("http://evil.example", "http://127.0.0.1:1", "null"):
        for method, path in (("GET", "/api/admin/version"), ("OPTIONS", "/api/flows/"), ("GET", "/ui-settings")):
            status, headers, _ = ask(server, path, method, Origin=origin, **signed_in)
            assert status == 403
            assert not [name for name in headers if name.lower().startswith("access-control")]


def test_an_artifact_needs_the_secret_or_a_session_of_our_own_page(server: Server, artifact: ArtifactRef) -> None:
    path = address_of(artifact)
    assert ask(server, path)[0] == 401
    assert ask(server, path.replace("artifacts", "viewer"))[0] == 401
    assert ask(server, path, Authorization=basic("dg4d:guess"))[0] == 401
    assert ask(server, path, Authorization=basic(server.auth_string()))[2] == PNG
    status, headers, _ = ask(server, path, "HEAD", Authorization=basic(server.auth_string()))
    assert (status, headers["content-length"]) == (200, str(len(PNG)))
    assert ask(server, "/dg4d/session")[0] == 401
    status, headers, _ = ask(server, "/dg4d/session", Authorization=basic(server.auth_string()))
    set_cookie = next(value for name, value in headers.items() if name.lower() == "set-cookie")
    assert status == 204
    assert {"HttpOnly", "SameSite=strict", "Path=/dg4d/"} <= set(set_cookie.split("; "))
    cookie = set_cookie.partition(";")[0]
    assert server.auth_string() not in cookie
    assert ask(server, path, Cookie=cookie, **OWN_PAGE)[2] == PNG
    assert ask(server, path, Cookie=cookie, Sec_Fetch_Site="none")[2] == PNG  # typed into the address bar
    for site in ({"Sec_Fetch_Site": "same-site"}, {"Sec_Fetch_Site": "cross-site"}, {}):
        assert ask(server, path, Cookie=cookie, **site)[0] == 401
    assert ask(server, "/api/admin/version", Cookie=cookie, **OWN_PAGE)[0] == 401  # it opens artifacts only


def test_who_is_not_signed_in_is_told_the_form_of_the_address_that_signs_in(
    server: Server, artifact: ArtifactRef
) -> None:
    status, _, said = ask(server, address_of(artifact))
    assert status == 401
    for text in (said, ask(server, "/dg4d/login")[2]):
        assert b"/dg4d/login#NAME:PASSWORD" in text and b"$PREFECT_SERVER_API_AUTH_STRING" in text


def test_a_browser_that_is_not_signed_in_is_sent_to_the_page_that_signs_in(
    server: Server, artifact: ArtifactRef
) -> None:
    path = address_of(artifact)
    status, headers, _ = ask(server, path, Sec_Fetch_Dest="document", Sec_Fetch_Site="same-origin")
    assert (status, headers["location"]) == (303, f"/dg4d/login?next={path}")
    _, headers, _ = ask(server, f"{path}?page=2&search=a%26b", Sec_Fetch_Dest="document")
    assert parse_qs(urlsplit(headers["location"]).query) == {"next": [f"{path}?page=2&search=a%26b"]}
    status, headers, page = ask(server, "/dg4d/login")
    nonce = headers["content-security-policy"].partition("'nonce-")[2].partition("'")[0]
    assert status == 200 and page.count(nonce.encode()) == 2 and b"NONCE" not in page
    assert headers["x-frame-options"] == "DENY"
    assert server.auth_string() not in page.decode()
    assert server.login_address("http://h:1") == f"http://h:1/dg4d/login#{server.auth_string()}"


@pytest.mark.parametrize(
    ("given", "status", "kept", "left"),
    [("dg4d:new", 204, "new", True), ("dg4d:wrong", 401, "old", False), ("dg4d:new", 503, "old", False),
     ("", 204, "old", True), ("", 401, "", False)],
)  # fmt: skip
def test_a_browser_keeps_a_secret_that_the_server_accepted(given: str, status: int, kept: str, left: bool) -> None:
    page = Path(access.__file__).with_name("login.html")
    word = {name: basic(f"dg4d:{name}").removeprefix("Basic ") for name in ("old", "new")} | {"": ""}
    asked = {"page": str(page), "hash": f"#{given}" if given else "", "kept": word["old"], "status": status}
    assert run_node("login.mjs", json.dumps(asked)) == {"kept": word[kept], "left": left}


@pytest.mark.parametrize("given", ["dg4d:50%25", "dg4d:50%"])
def test_a_percent_sign_in_a_secret_may_be_written_as_it_is(given: str) -> None:
    page = Path(access.__file__).with_name("login.html")
    asked = {"page": str(page), "hash": f"#{given}", "kept": "", "status": 204}
    kept = basic("dg4d:50%").removeprefix("Basic ")
    assert run_node("login.mjs", json.dumps(asked)) == {"kept": kept, "left": True}


def test_further_hosts_are_named_by_the_environment_and_never_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DG4D_SERVER_HOSTS", "server, dg4d.example.com,*,")
    assert access.allowed_hosts() == [*access.LOCAL_HOSTS, "server", "dg4d.example.com"]


def test_a_home_is_closed_to_others_also_one_of_an_earlier_version(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "new" / "home"))
    ref = home.store().put_bytes(b"content", "text/plain")
    assert stat.S_IMODE((tmp_path / "new" / "home").stat().st_mode) == 0o700
    assert stat.S_IMODE(home.store().path(ref).stat().st_mode) == 0o400
    old = tmp_path / "old"
    (old / "prefect").mkdir(parents=True)
    (old / "prefect" / "prefect.db").touch(0o644)
    (tmp_path / "elsewhere").touch(0o644)
    (old / "link").symlink_to(tmp_path / "elsewhere")
    old.chmod(0o755)
    monkeypatch.setenv("DG4D_HOME", str(old))
    background.background_server()
    assert [stat.S_IMODE(path.stat().st_mode) for path in (old, old / "prefect", old / "prefect" / "prefect.db")] == [
        0o700, 0o700, 0o600,
    ]  # fmt: skip
    assert stat.S_IMODE((tmp_path / "elsewhere").stat().st_mode) == 0o644


def test_what_a_server_writes_is_closed_to_others(server: Server) -> None:
    wrong = [
        path for path in (server.folder.parent / "prefect").rglob("*") if path.is_file() and path.stat().st_mode & 0o077
    ]
    assert wrong == []
    assert server.folder.parent.stat().st_mode & 0o077 == 0
