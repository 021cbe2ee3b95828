"""`dg4d weights pull` with the real client of the hub, over HTTP."""

import os
import subprocess
import sys
from http import HTTPStatus
from pathlib import Path

import pytest
from tiny_hub import COMMIT, REPOSITORY, TinyHub

from dg4d_lib.weights.lock import read_lock

TENSORS = "unet/diffusion_pytorch_model.safetensors"
LARGE = bytes(range(256)) * 12_000  # bytes that tell where they belong


@pytest.fixture
def hub() -> TinyHub:
    return TinyHub({"README.md": b"card", "model_index.json": b"{}", "unet/config.json": b"{}", TENSORS: LARGE})


@pytest.fixture
def home(tmp_path: Path) -> Path:
    return tmp_path / "weights"


def dg4d(hub: TinyHub, home: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A command of its own: the client reads the address of the hub when it is imported."""
    with hub.running() as address:
        environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith("HF_")},
            "HF_ENDPOINT": address,
            "HF_HOME": str(home.parent / "cache"),
            "HF_HUB_DISABLE_TELEMETRY": "1",
            "DG4D_WEIGHTS": str(home),
            "NO_PROXY": "127.0.0.1",
        }
        command = [sys.executable, "-m", "flows.cli", "weights", *arguments]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=120)


def test_what_is_pulled_is_written_down_and_checked(hub: TinyHub, home: Path) -> None:
    done = dg4d(hub, home, "pull", REPOSITORY)
    assert done.returncode == 0, done.stderr
    assert f"revision {COMMIT}; mit: commercial use is allowed" in done.stdout
    folder = home / "me--pictures"
    assert (folder / TENSORS).read_bytes() == LARGE
    assert not (folder / "README.md").exists()
    locked = read_lock(home)[REPOSITORY]
    assert set(locked.files) == {"model_index.json", "unet/config.json", TENSORS}
    (folder / "unet" / "config.json").write_text("[]")
    hub.asked.clear()
    assert dg4d(hub, home, "pull", REPOSITORY).returncode == 0
    assert [path for method, path, _ in hub.asked if method == "GET" and "/resolve/" in path] == [
        f"/{REPOSITORY}/resolve/{COMMIT}/unet/config.json"
    ]
    assert "intact, 3 files" in dg4d(hub, home, "check", REPOSITORY).stdout


def test_a_download_that_breaks_off_goes_on_where_it_was(hub: TinyHub, home: Path) -> None:
    hub.broken_after = 1_000_000
    done = dg4d(hub, home, "pull", REPOSITORY)
    assert done.returncode == 0, done.stderr
    assert (home / "me--pictures" / TENSORS).read_bytes() == LARGE
    starts = [given for method, path, given in hub.asked if method == "GET" and path.endswith(TENSORS)]
    assert len(starts) == 2 and starts[0] == "" and starts[1] != "bytes=0-"


def test_content_that_is_not_what_the_hub_says_is_refused(hub: TinyHub, home: Path) -> None:
    hub.served = {TENSORS: bytes(len(LARGE))}
    done = dg4d(hub, home, "pull", REPOSITORY)
    assert done.returncode == 69
    assert f"{TENSORS} is damaged" in done.stderr
    assert not (home / "me--pictures" / TENSORS).exists()
    assert read_lock(home) == {}


@pytest.mark.parametrize(
    ("status", "error", "says"),
    [
        (HTTPStatus.UNAUTHORIZED, "GatedRepo", "accept its license at https"),
        (HTTPStatus.NOT_FOUND, "RepoNotFound", "or correct the id"),
        (HTTPStatus.SERVICE_UNAVAILABLE, "", "connect this machine to the network"),
    ],
)
def test_a_hub_that_refuses_is_one_message(status: HTTPStatus, error: str, says: str, hub: TinyHub, home: Path) -> None:
    hub.status, hub.error = status, error
    done = dg4d(hub, home, "pull", REPOSITORY)
    assert done.returncode == 69
    assert says in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
