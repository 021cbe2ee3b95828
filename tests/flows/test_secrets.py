"""What only the environment may know is in nothing that a run leaves behind, whether it ends well or badly."""

import base64
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from fake_steps import picture
from prefect.client.orchestration import get_client
from prefect.logging.handlers import APILogHandler
from signing import identity
from waiting import retry_after

from flows import home
from flows.convert import convert_job
from flows.inputs.conversion_job import ConversionRequest
from flows.serving.auth import basic
from flows.serving.server import Server
from flows.step_errors import StepCrashed
from steps.profiles import PREVIEW

MARKER = "c0ffee-and-nobody-else-knows"
SECRETS = ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN", "HF_TOKEN")


@pytest.fixture
def place(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Fake steps in processes of their own, under the home folder of the server, with secrets in the environment."""
    monkeypatch.setenv("DG4D_HOME", str(server.folder.parent))
    monkeypatch.setenv("DG4D_CATALOG", "fake_steps:STEPS")
    monkeypatch.setenv("DG4D_CODE_VERSION", "secrets")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
    monkeypatch.setenv("FAKE_LOG", str(tmp_path / "ran"))
    retry_after(0.01, monkeypatch)
    for name in SECRETS:
        monkeypatch.setenv(name, MARKER)
    with identity(tmp_path / MARKER).configured():
        yield tmp_path


def left_by(words: str, place: Path) -> dict[str, bytes]:
    """Everything that is on disk after a run with these words: the package, records, artifacts, logs, the database."""
    (place / "secret.png").write_text(picture(words))
    request = ConversionRequest(item="secret", picture=place / "secret.png", settings=PREVIEW)
    try:
        convert_job(request.to_job(home.store()), place / "out")
    except StepCrashed:
        assert "crash" in words
    APILogHandler().flush()
    files = (path for folder in (place / "out", home.home()) for path in folder.rglob("*") if path.is_file())
    return {str(path): path.read_bytes() for path in files}


@pytest.mark.parametrize("words", ["fine", "fit_motion=crash"])
def test_secrets_of_the_environment_are_nowhere(words: str, place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    found = left_by(words, place)
    assert any(name.endswith(".db") for name in found) and any("results" in name for name in found)
    key = (place / MARKER / "key.pem").read_bytes().splitlines()[1]
    assert [name for name, content in found.items() if MARKER.encode() in content or key in content] == []
    assert MARKER not in "".join(capfd.readouterr())
    if words == "fine":
        assert any(b"Test company" in content for content in found.values())  # it was signed with that key
    else:
        assert not (place / "out").exists()


def forms(secret: str) -> tuple[bytes, ...]:
    """Return the ways in which a secret NAME:PASSWORD may be written down."""
    password = secret.partition(":")[2].encode()
    return password, base64.b64encode(secret.encode()), base64.b64encode(password)


def answers(server: Server) -> dict[str, bytes]:
    """Return everything that the server shows to whoever is signed in."""
    found = {}
    with get_client(sync_client=True) as client:
        for kind in ("artifacts", "logs", "flow_runs", "task_runs", "events", "deployments", "work_pools", "variables"):
            found[kind] = client.request("POST", f"/{kind}/filter", json={}).content
    for page in ("/", "/ui-settings", "/dg4d/login", "/api/admin/settings", "/api/health", "/openapi.json"):
        asked = urllib.request.Request(
            f"{server.address()}{page}", headers={"Authorization": basic(server.auth_string())}
        )
        with urllib.request.urlopen(asked) as answer:
            found[page] = answer.read() + str(answer.headers).encode()
    return found


@pytest.mark.parametrize("words", ["fine fit_motion=environment", "fit_motion=environment fit_motion=crash"])
def test_the_secret_of_the_server_is_in_its_file_alone(
    words: str, place: Path, server: Server, capfd: pytest.CaptureFixture[str]
) -> None:
    found = left_by(words, place)
    shown = answers(server)
    assert b"prepare_subject" in shown["task_runs"] and b"asset" in shown["artifacts"]
    environment = (place / "ran.environment").read_bytes()
    assert b"FAKE_LOG=" in environment
    printed = "".join(capfd.readouterr()).encode()
    everything = {**found, **shown, "environment of a step": environment, "printed": printed}
    secret = server.auth_string()
    named = {name for name, content in everything.items() if any(form in content for form in forms(secret))}
    assert named == {str(server.folder / "auth")}
