"""What a Kubernetes cluster answers a worker that may do what its role says; it runs nothing."""

import json
import re
import threading
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, NamedTuple
from urllib.parse import parse_qs, urlsplit

PATH = re.compile(
    r"/(?:api|apis/(?P<group>[\w.]+))/v1(?:/namespaces/(?P<space>[\w-]+))?/(?P<kind>\w+)(?:/(?P<name>[^/]+)(?P<sub>/\w+)?)?"
)
RESOURCES = {
    "/api/v1": {"pods": "Pod", "events": "Event", "namespaces": "Namespace"},
    "/apis/batch/v1": {"jobs": "Job"},
}
BATCH = {"groupVersion": "batch/v1", "version": "v1"}
WATCH_S = 0.5


class Asked(NamedTuple):
    """What somebody wanted: a word of RBAC, of which kind of thing, in which namespace ("" for all of them)."""

    verb: str
    group: str
    resource: str
    namespace: str


class Cluster(ThreadingHTTPServer):
    """A cluster with one account.

    Args:
        role: what this may do, as a `Role`.
    """

    def __init__(self, role: dict[str, Any]) -> None:
        super().__init__(("127.0.0.1", 0), _Answer)
        self.role = role
        self.allowed: list[Asked] = []
        self.forbidden: list[Asked] = []
        self.created: list[dict[str, Any]] = []

    @property
    def access(self) -> dict[str, Any]:
        """The content of a kubeconfig."""
        server = {"server": f"http://127.0.0.1:{self.server_port}"}
        return {
            "apiVersion": "v1",
            "kind": "Config",
            "clusters": [{"name": "c", "cluster": server}],
            "users": [{"name": "u", "user": {"token": "t"}}],
            "contexts": [{"name": "x", "context": {"cluster": "c", "user": "u"}}],
            "current-context": "x",
        }

    def allows(self, asked: Asked) -> bool:
        """Whether the role covers it."""
        return asked.namespace == self.role["metadata"]["namespace"] and any(
            asked.group in rule["apiGroups"] and asked.resource in rule["resources"] and asked.verb in rule["verbs"]
            for rule in self.role["rules"]
        )


@contextmanager
def cluster(role: dict[str, Any]) -> Iterator[Cluster]:
    """A cluster while the block runs."""
    with Cluster(role) as running:
        threading.Thread(target=running.serve_forever).start()
        try:
            yield running
        finally:
            running.shutdown()


class _Answer(BaseHTTPRequestHandler):
    server: Cluster

    def do_GET(self) -> None:
        path = urlsplit(self.path).path
        group = {"name": "batch", "versions": [BATCH], "preferredVersion": BATCH}
        groups = {"/api": {"versions": ["v1"]}, "/apis": {"groups": [group]}}
        if path in groups:
            self._say(200, groups[path])
        elif path in RESOURCES:
            verbs = ["get", "list", "watch", "create", "delete", "patch"]
            kinds = [
                {"name": name, "singularName": "", "kind": kind, "namespaced": name != "namespaces", "verbs": verbs}
                for name, kind in RESOURCES[path].items()
            ]
            self._say(200, {"resources": kinds})
        elif "watch" in parse_qs(urlsplit(self.path).query):
            if self._may("watch"):
                self._say(200, None)
                time.sleep(WATCH_S)
        elif self._may("list"):
            self._say(200, {"metadata": {"resourceVersion": "1"}, "items": []})

    def do_POST(self) -> None:
        thing = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        if self._may("create"):
            self.server.created.append(thing)
            given = {"name": thing["metadata"]["generateName"] + "1", "uid": str(uuid.uuid4())}
            self._say(201, {**thing, "metadata": {**thing["metadata"], **given}})

    def log_message(self, *_: object) -> None:
        """Silence."""

    def _may(self, verb: str) -> bool:
        found = PATH.fullmatch(urlsplit(self.path).path)
        assert found, self.path
        asked = Asked(verb, found["group"] or "", found["kind"] + (found["sub"] or ""), found["space"] or "")
        if self.server.allows(asked):
            self.server.allowed.append(asked)
            return True
        self.server.forbidden.append(asked)
        self._say(403, {"kind": "Status", "apiVersion": "v1", "status": "Failure", "reason": "Forbidden", "code": 403})
        return False

    def _say(self, status: int, content: Any) -> None:
        body = b"" if content is None else json.dumps(content).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        if content is not None:
            self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)
