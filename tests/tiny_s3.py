"""As much of an S3 server as the store asks for, in memory: one bucket, which may go away and come back."""

import re
import threading
import time
from email.utils import formatdate
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, unquote, urlsplit
from xml.sax.saxutils import escape, unescape

BUCKET = "bucket"


class TinyS3:
    """Starts at once; `objects` outlive `stop`, so that `start` brings them back on the same port."""

    def __init__(self) -> None:
        self.objects: dict[str, tuple[bytes, float]] = {}
        self.port = 0
        self.start()

    @property
    def environment(self) -> dict[str, str]:
        """What a client needs."""
        return {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{self.port}",
            "AWS_ACCESS_KEY_ID": "key",
            "AWS_SECRET_ACCESS_KEY": "a secret that nobody may see",
            "AWS_REGION": "somewhere-1",
        }

    def start(self) -> None:
        objects = self.objects
        handler = type("Handler", (_Handler,), {"objects": objects, "parts": {}})
        self._server = ThreadingHTTPServer(("127.0.0.1", self.port), handler)
        self._server.daemon_threads = True
        self.port = self._server.server_port
        threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True).start()

    def stop(self) -> None:
        self._server.shutdown()
        self._server.server_close()


class _Handler(BaseHTTPRequestHandler):
    objects: dict[str, tuple[bytes, float]]
    parts: dict[int, bytes]

    def log_message(self, *_: object) -> None:
        return

    def _name(self) -> str | None:
        bucket, _, name = unquote(urlsplit(self.path).path).lstrip("/").partition("/")
        if bucket == BUCKET:
            return name
        self._answer(404, b"<Error><Code>NoSuchBucket</Code></Error>")
        return None

    def _query(self) -> dict[str, list[str]]:
        return parse_qs(urlsplit(self.path).query, keep_blank_values=True)

    def _answer(self, status: int, body: bytes = b"", **headers: str) -> None:
        self.send_response(status)
        for name, value in {"Content-Length": str(len(body)), **headers}.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def _body(self) -> bytes:
        return self.rfile.read(int(self.headers.get("Content-Length") or 0))

    def do_PUT(self) -> None:
        content = self._body()
        if (name := self._name()) is None:
            return
        if "partNumber" in self._query():
            self.parts[int(self._query()["partNumber"][0])] = content
            self._answer(200, ETag='"part"')
            return
        if self.headers.get("If-None-Match") == "*" and name in self.objects:
            self._answer(412)
            return
        self.objects[name] = content, time.time()
        self._answer(200, ETag=f'"{len(content)}"')

    def do_HEAD(self) -> None:
        if (name := self._name()) is None:
            return
        if name not in self.objects:
            self._answer(404)
            return
        content, written = self.objects[name]
        facts = {"ETag": f'"{len(content)}"', "Last_Modified": formatdate(written, usegmt=True)}
        found = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range") or "")
        if found is None or self.command == "HEAD":
            self._answer(200, content, **facts)
            return
        first, last = int(found[1]), min(int(found[2]), len(content) - 1)
        facts["Content_Range"] = f"bytes {first}-{last}/{len(content)}"
        self._answer(206, content[first : last + 1], **facts)

    def do_GET(self) -> None:
        if self._name():
            self.do_HEAD()
            return
        prefix = self._query().get("prefix", [""])[0]
        rows = [
            f"<Contents><Key>{escape(name)}</Key><Size>{len(content)}</Size><ETag>e</ETag>"
            f"<LastModified>{time.strftime('%Y-%m-%dT%H:%M:%S.000Z', time.gmtime(written))}</LastModified></Contents>"
            for name, (content, written) in sorted(self.objects.items())
            if name.startswith(prefix)
        ]
        self._answer(200, f"<ListBucketResult>{''.join(rows)}</ListBucketResult>".encode())

    def do_DELETE(self) -> None:
        self.objects.pop(self._name() or "", None)
        self._answer(204)

    def do_POST(self) -> None:
        """Begin or end an upload in parts, or delete many; one upload at a time is enough."""
        if "uploads" in self._query():
            self.parts.clear()
            self._answer(200, b"<InitiateMultipartUploadResult><UploadId>u</UploadId></InitiateMultipartUploadResult>")
            return
        if "uploadId" in self._query():
            self._body()
            whole = b"".join(self.parts[number] for number in sorted(self.parts))
            self.objects[self._name() or ""] = whole, time.time()
            self._answer(200, b"<CompleteMultipartUploadResult><ETag>e</ETag></CompleteMultipartUploadResult>")
            return
        names = re.findall(r"<Key>(.*?)</Key>", self._body().decode())
        for name in names:
            self.objects.pop(unescape(name), None)
        rows = "".join(f"<Deleted><Key>{name}</Key></Deleted>" for name in names)
        self._answer(200, f"<DeleteResult>{rows}</DeleteResult>".encode())
