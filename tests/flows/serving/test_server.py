import fcntl
import http.server
import socket
import subprocess
import threading
import time
from pathlib import Path

import pytest

from dg4d_lib.errors import BadInput
from flows.serving import server as module
from flows.serving.server import Server, ServerUnavailable, answers


@pytest.fixture
def lasting() -> "subprocess.Popen[bytes]":
    return subprocess.Popen(["sleep", "60"])


def test_a_server_ends_when_nobody_has_used_it_for_a_while(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lasting: "subprocess.Popen[bytes]"
) -> None:
    monkeypatch.setattr(module, "LOOK_S", 0.05)
    with (tmp_path / "in-use").open("a") as user:
        fcntl.flock(user, fcntl.LOCK_SH)
        watch = threading.Thread(target=module._watch, args=(lasting, tmp_path, 0.3))
        watch.start()
        time.sleep(0.8)
        assert lasting.poll() is None
    watch.join(60)
    assert lasting.poll() is not None


def test_a_server_that_is_kept_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lasting: "subprocess.Popen[bytes]"
) -> None:
    monkeypatch.setattr(module, "LOOK_S", 0.05)
    Server(tmp_path, tmp_path).keep()
    watch = threading.Thread(target=module._watch, args=(lasting, tmp_path, 0.1))
    watch.start()
    time.sleep(0.6)
    assert lasting.poll() is None
    assert not Server(tmp_path, tmp_path).stop()  # takes the mark away; there is no guard here to end
    watch.join(60)
    assert lasting.poll() is not None


def test_a_server_that_cannot_start_is_unavailable_and_says_where_to_look(tmp_path: Path) -> None:
    (tmp_path / "prefect").write_text("a file where a folder should be")
    broken = Server(tmp_path / "server", tmp_path / "prefect")
    broken.start()
    with pytest.raises(ServerUnavailable, match=r"server\.log"):
        broken.wait(timeout_s=15)
    assert "FileExistsError" in broken.log.read_text()


def test_a_port_is_kept_while_it_is_free(tmp_path: Path) -> None:
    def bound() -> int:
        with module._listener(tmp_path / "server.json") as listener:
            return int(listener.getsockname()[1])

    port = bound()
    assert bound() == port
    with http.server.HTTPServer(("127.0.0.1", port), http.server.BaseHTTPRequestHandler):
        assert bound() != port


def test_no_other_program_can_listen_on_the_port_of_a_server_that_starts(tmp_path: Path) -> None:
    with module._listener(tmp_path / "server.json") as listener, socket.socket() as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        with pytest.raises(OSError, match="in use"):
            other.bind(listener.getsockname())
        assert not answers(f"http://127.0.0.1:{listener.getsockname()[1]}", timeout_s=0.1)  # open, but no server yet


@pytest.mark.parametrize("idle", ["30min", "nan", "-1"])
def test_an_idle_time_that_is_no_number_of_seconds_is_refused_where_the_server_is_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, idle: str
) -> None:
    monkeypatch.setattr(module, "spawn_guard", lambda *_: pytest.fail("the guard is started"))
    monkeypatch.setenv(module.IDLE, idle)
    with pytest.raises(BadInput, match=rf"\$DG4D_SERVER_IDLE_S is '{idle}'; set it to a number of seconds"):
        Server(tmp_path, tmp_path).start()


def test_what_does_not_answer_or_is_something_else_is_not_our_server() -> None:
    class Other(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_error(404)

        def log_message(self, *_: object) -> None:
            pass

    with http.server.HTTPServer(("127.0.0.1", 0), Other) as other:
        threading.Thread(target=other.handle_request).start()
        address = f"http://127.0.0.1:{other.server_port}"
        assert not answers(address, timeout_s=5)
    assert not answers(address, timeout_s=1)


def test_state_of_a_dead_guard_is_not_believed(tmp_path: Path) -> None:
    (tmp_path / "server.json").write_text('{"guard": 1, "port": 80}')
    assert Server(tmp_path, tmp_path).address() is None
    assert not Server(tmp_path, tmp_path).stop()
