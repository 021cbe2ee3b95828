"""A Hugging Face hub of one repository, to which the real client talks over HTTP. Every test may import it."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread

REPOSITORY = "me/pictures"
COMMIT = "c" * 40
LARGE = ".safetensors"  # kept as large files are, with a sha256 that the hub tells


@dataclass
class TinyHub:
    """What the repository holds, and how the hub misbehaves.

    Attributes:
        files: content by path.
        served: content by path where it is not what the hub says of it.
        license: of the model card.
        status: the answer to questions about the repository, with `error` as the hub's name for it.
        broken_after: bytes of a large file after which its first download breaks off.
        asked: methods, paths and ranges of all requests so far.
    """

    files: dict[str, bytes]
    served: Mapping[str, bytes] = field(default_factory=dict)
    license: str = "mit"
    status: HTTPStatus = HTTPStatus.OK
    error: str = ""
    broken_after: int | None = None
    asked: list[tuple[str, str, str]] = field(default_factory=list)

    @contextmanager
    def running(self) -> Iterator[str]:
        """The address of the hub while the block runs."""

        class Handler(_Handler):
            hub = self

        server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        thread = Thread(target=server.serve_forever, args=(0.05,))
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()
            server.server_close()

    def about(self) -> bytes:
        """What the hub says of the repository."""
        siblings = []
        for path, content in self.files.items():
            large = {"sha256": hashlib.sha256(content).hexdigest(), "size": len(content), "pointerSize": 130}
            siblings.append({"rfilename": path, "size": len(content), **({"lfs": large} if _is_large(path) else {})})
        card = {"license": self.license}
        return json.dumps({"id": REPOSITORY, "sha": COMMIT, "siblings": siblings, "cardData": card}).encode()

    def tree(self) -> bytes:
        """All files with their sizes."""
        listed = [
            {"type": "file", "oid": "0" * 40, "size": len(content), "path": path}
            for path, content in self.files.items()
        ]
        return json.dumps(listed).encode()


class _Handler(BaseHTTPRequestHandler):
    hub: TinyHub

    def do_HEAD(self) -> None:
        self._answer()

    def do_GET(self) -> None:
        self._answer()

    def log_message(self, format: str, *args: object) -> None:
        """Nothing is printed."""

    def _answer(self) -> None:
        hub, path = self.hub, self.path.partition("?")[0]
        hub.asked.append((self.command, path, self.headers.get("Range", "")))
        api, resolved = f"/api/models/{REPOSITORY}", f"/{REPOSITORY}/resolve/{COMMIT}/"
        if hub.status != HTTPStatus.OK:
            self._send(b"", {"X-Error-Code": hub.error}, hub.status)
        elif path in (api, f"{api}/revision/{COMMIT}"):
            self._send(hub.about(), {"Content-Type": "application/json"})
        elif path.startswith(f"{api}/tree/"):
            self._send(hub.tree(), {"Content-Type": "application/json"})
        elif (name := path.removeprefix(resolved)) in hub.files:
            content = hub.served.get(name, hub.files[name])
            digest = hashlib.sha256(hub.files[name]).hexdigest()
            self._send(content, {"X-Repo-Commit": COMMIT, "ETag": f'"{digest}"'}, large=_is_large(name))
        else:
            self._send(b"", {}, HTTPStatus.NOT_FOUND)

    def _send(
        self, content: bytes, headers: dict[str, str], status: HTTPStatus = HTTPStatus.OK, large: bool = False
    ) -> None:
        whole = len(content)
        if given := self.headers.get("Range"):
            start = int(given.removeprefix("bytes=").partition("-")[0])
            content, status = content[start:], HTTPStatus.PARTIAL_CONTENT
            headers = {**headers, "Content-Range": f"bytes {start}-{whole - 1}/{whole}"}
        self.send_response(status)
        for name, value in {**headers, "Content-Length": str(len(content))}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command == "GET":
            if large and self.hub.broken_after is not None:
                content, self.hub.broken_after = content[: self.hub.broken_after], None
            self.wfile.write(content)


def _is_large(path: str) -> bool:
    return path.endswith(LARGE)
