"""A folder into which people drop files: the server is told when what is in it is new and has come to rest."""

import hashlib
from pathlib import Path
from uuid import uuid4

from prefect.client.orchestration import get_client
from prefect.events import Event, Resource

from dg4d_lib.errors import BadInput
from steps.contract import digest_of
from steps.store.files import write_atomically

CHANGED = "dg4d.folder.changed"  # the event that the trigger in deploy/prefect.yaml waits for

Stamps = dict[str, tuple[int, int]]


class Watcher:
    """Looks at a folder now and then.

    Args:
        folder: with its folders, without hidden files.
        out: whose files do not count.
        rest_s: seconds for which nothing may change before it counts: a large file takes time to arrive.
        memory: a file that keeps the digest of what was told last, so that nothing is told twice.
    """

    def __init__(self, folder: Path, out: Path, rest_s: float, memory: Path) -> None:
        if not folder.is_dir():
            raise BadInput(f"{folder} is no folder; give one into which pictures, videos or a manifest are dropped")
        self.folder, self.out, self.rest_s, self.memory = folder.resolve(), out.resolve(), rest_s, memory
        self._stamps: Stamps = {}
        self._since = 0.0
        self._contents: dict[tuple[str, int, int], str] = {}

    def look(self, now: float) -> str | None:
        """The digest of what is in the folder if it is at rest and was not told yet; None otherwise.

        Args:
            now: seconds of a clock that only goes forward.
        """
        stamps = self._stamp()
        if stamps != self._stamps:
            self._stamps, self._since = stamps, now
        if not stamps or now - self._since < self.rest_s:
            return None
        try:
            digest = digest_of({name: self._content(name, *stamp) for name, stamp in stamps.items()})
        except OSError:  # it went away while it was read
            return None
        return None if self.memory.exists() and self.memory.read_text(encoding="ascii") == digest else digest

    def told(self, digest: str) -> None:
        """Remember that the server knows."""
        self.memory.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(self.memory, digest)

    def _stamp(self) -> Stamps:
        stamps: Stamps = {}
        for path in sorted(self.folder.rglob("*")):
            name = path.relative_to(self.folder)
            if self.out in (path, *path.parents) or any(part.startswith(".") for part in name.parts):
                continue
            if path.is_file() and not path.is_symlink():
                facts = path.stat()
                stamps[name.as_posix()] = (facts.st_size, facts.st_mtime_ns)
        return stamps

    def _content(self, name: str, size: int, modified: int) -> str:
        key = (name, size, modified)
        if key not in self._contents:
            with (self.folder / name).open("rb") as file:
                self._contents[key] = hashlib.file_digest(file, "sha256").hexdigest()
        return self._contents[key]


def announce(folder: Path, out: Path, digest: str) -> None:
    """Tell the server that a folder has changed; raises what its client raises when it does not take it."""
    event = Event(
        id=uuid4(),
        event=CHANGED,
        resource=Resource.model_validate(
            {
                "prefect.resource.id": f"dg4d.folder.{digest_of(str(folder)).removeprefix('sha256:')[:16]}",
                "prefect.resource.name": str(folder),
            }
        ),
        payload={"folder": str(folder), "out": str(out), "digest": digest},
    )
    with get_client(sync_client=True) as client:
        client.request("POST", "/events", json=[event.model_dump(mode="json")]).raise_for_status()
