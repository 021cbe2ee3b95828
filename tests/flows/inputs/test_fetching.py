import functools
import http.server
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from dg4d_lib.errors import BadInput
from flows.inputs import fetching
from flows.inputs.fetching import at_hand


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def site(tmp_path: Path) -> Iterator[str]:
    (tmp_path / "a b.png").write_bytes(b"picture")
    handler = functools.partial(Quiet, directory=str(tmp_path))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_a_path_stays_where_it_is(tmp_path: Path) -> None:
    with at_hand(str(tmp_path / "a.png")) as path:
        assert path == tmp_path / "a.png"


def test_a_file_of_a_web_server_is_here_under_its_name_for_a_while(site: str) -> None:
    with at_hand(f"{site}/a%20b.png?signature=1") as path:
        assert path.name == "a b.png" and path.read_bytes() == b"picture"
    assert not path.exists()


def test_what_is_too_large_is_refused(site: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fetching, "LARGEST_FILE_BYTES", 3)
    with pytest.raises(BadInput, match="more than 3 bytes"), at_hand(f"{site}/a%20b.png"):
        pass


@pytest.mark.parametrize("address", ["ftp://host/a.png", "file:///etc/passwd", "https://host/", "s3://bucket"])
def test_other_addresses_are_refused(address: str) -> None:
    with pytest.raises(BadInput, match="names no file"), at_hand(address):
        pass


def test_what_is_not_there_is_said_without_its_signature(site: str) -> None:
    with pytest.raises(BadInput, match=r"no\.png cannot be fetched") as caught, at_hand(f"{site}/no.png?secret=1"):
        pass
    assert "secret" not in str(caught.value)
