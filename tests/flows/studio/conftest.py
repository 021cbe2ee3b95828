"""A server of its own for the studio, with deployments, fake steps and a worker that runs them."""

import http.client
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
import trimesh
from prefect.settings import PREFECT_API_AUTH_STRING, PREFECT_API_URL, temporary_settings
from waiting import wait_until

from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.assets.formats.glb import write_glb
from dg4d_lib.mesh.textured import TexturedMesh
from flows import home
from flows.serving import background, registering
from flows.serving.auth import basic
from flows.serving.pools import read_pools
from flows.serving.roots import SOURCES
from flows.serving.server import Server
from flows.serving.workers import Worker, running


@dataclass(frozen=True)
class Client:
    """A program that asks the studio.

    Attributes:
        server: the background server.
        log: file in which fake steps note that they ran.
    """

    server: Server
    log: Path

    def ask(
        self, path: str, method: str = "GET", body: bytes | dict[str, Any] | None = None, **headers: str
    ) -> tuple[int, Mapping[str, str], bytes]:
        """Send a request to a path of the studio without the secret; underscores in names of headers are dashes."""
        host = str(self.server.address()).removeprefix("http://")
        connection = http.client.HTTPConnection(host, timeout=60)
        content = json.dumps(body).encode() if isinstance(body, dict) else body
        try:
            named = {name.replace("_", "-"): value for name, value in headers.items()}
            connection.request(method, path if path.startswith("/api") else f"/dg4d/studio{path}", content, named)
            answer = connection.getresponse()
            return answer.status, dict(answer.getheaders()), answer.read()
        finally:
            connection.close()

    @property
    def secret(self) -> dict[str, str]:
        """Header with the secret."""
        return {"Authorization": basic(self.server.auth_string())}

    @property
    def token(self) -> dict[str, str]:
        """Headers with Prefect's token against forged requests."""
        _, _, content = self.ask("/api/csrf-token?client=test", **self.secret)
        return {"Prefect_Csrf_Token": json.loads(content)["token"], "Prefect_Csrf_Client": "test"}

    def read(self, path: str) -> tuple[int, bytes]:
        """Read as the user."""
        status, _, content = self.ask(path, **self.secret)
        return status, content

    def post(self, path: str, body: bytes | dict[str, Any] | None = None) -> tuple[int, dict[str, Any]]:
        """Change as the user's page does."""
        status, _, content = self.ask(path, "POST", body, **self.secret, **self.token)
        return status, json.loads(content)

    def draft(self, *files: tuple[str, bytes]) -> str:
        """Make a draft of these files, and return its id."""
        identifier = str(self.post("/drafts")[1]["id"])
        for name, content in files:
            status, said = self.post(f"/drafts/{identifier}/files?name={name}", content)
            assert status == 201, said
        return identifier

    def ended(self, run: str) -> dict[str, Any]:
        """Wait for the end of a run, and return its status."""

        def look() -> dict[str, Any] | None:
            status = json.loads(self.read(f"/runs/{run}/status")[1])
            return status if status["has_ended"] else None

        found = wait_until(look)
        assert found is not None
        return found


def egg() -> bytes:
    """Return the GLB of an egg that swells."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    vertices = torch.tensor(ball.vertices, dtype=torch.float32)
    mesh = TexturedMesh(vertices, torch.tensor(ball.faces), vertices[:, :2] + 0.5, torch.full((8, 8, 3), 0.6))
    return write_glb(Asset4D(mesh, torch.linspace(0, 0.3, 3)[:, None, None] * vertices, 7.0))


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    """The studio of a server of its own: its steps are fake, and run in the processes of server and worker."""
    place = tmp_path_factory.mktemp("studio")
    (place / "egg.glb").write_bytes(egg())
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {
            "DG4D_HOME": str(place / "home"),
            "DG4D_CATALOG": "fake_steps:STEPS",
            "DG4D_CODE_VERSION": "test",
            "DG4D_EXECUTOR": "in_process",
            "DG4D_STUDIO_UPLOAD_MB": "1",
            "FAKE_LOG": str(place / "ran"),
            "FAKE_GLB": str(place / "egg.glb"),
            "PYTHONPATH": str(Path(__file__).parents[1]),
        }.items():
            patch.setenv(name, value)
        server = background.background_server()
        server.start()
        address = server.wait()
        patch.setenv("PREFECT_API_URL", address)
        patch.setenv("PREFECT_API_AUTH_STRING", server.auth_string())
        home.uploads().mkdir(parents=True)
        with temporary_settings({PREFECT_API_URL: address, PREFECT_API_AUTH_STRING: server.auth_string()}):
            registering.register(read_pools(), ["process-cpu"])
            patch.setenv(SOURCES, str(home.uploads()))
            worker = Worker("process-cpu", server.folder)
            worker.start(address)
            try:
                wait_until(lambda: running(server.folder))
                yield Client(server, place / "ran")
            finally:
                worker.stop()
                server.release()
                server.stop()
    assert os.environ.get("DG4D_CATALOG") is None
