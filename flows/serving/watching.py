"""Watched folder: sends an event to the server when its files have changed and come to rest."""

import hashlib
import stat
from contextlib import suppress
from pathlib import Path
from uuid import uuid4

from prefect.client.orchestration import get_client
from prefect.events import Event, Resource
from prefect.exceptions import ObjectNotFound

from dg4d_lib.errors import BackendUnavailable, BadInput
from flows.serving.results import visible_files
from steps.contract import digest_of
from steps.store.files import write_atomically

CHANGED = "dg4d.folder.changed"  # event of the trigger in deploy/prefect.yaml
DEPLOYMENT, TRIGGER = "catalog-to-4d/Catalog to 4D", "dg4d catalog of a dropped folder"  # names, likewise

Stamps = dict[str, tuple[int, int]]


class Watcher:
    """Watcher of a folder.

    Args:
        folder: watched folder with its subfolders; hidden files do not count.
        out: output folder; its files do not count.
        rest_s: seconds without a change before files count as complete.
        memory: file with the last announced digest, so that no state is announced twice.
    """

    def __init__(self, folder: Path, out: Path, rest_s: float, memory: Path) -> None:
        if not folder.is_dir():
            raise BadInput(f"{folder} is not a folder; give one into which pictures, videos or a manifest are dropped")
        self.folder, self.out, self.rest_s, self.memory = folder.resolve(), out.resolve(), rest_s, memory
        self._stamps: Stamps = {}
        self._since = 0.0
        self._contents: dict[tuple[str, int, int], str] = {}

    def look(self, now: float) -> str | None:
        """Return the digest of the folder if it is at rest and was not announced yet; else None.

        Args:
            now: time of a monotonic clock in seconds.
        """
        stamps = self._stamp()
        if stamps != self._stamps:
            self._stamps, self._since = stamps, now
        if not stamps or now - self._since < self.rest_s:
            return None
        try:
            digest = digest_of({name: self._content(name, *stamp) for name, stamp in stamps.items()})
        except OSError:  # a file was removed meanwhile
            return None
        return None if self.memory.exists() and self.memory.read_text(encoding="ascii") == digest else digest

    def told(self, digest: str) -> None:
        """Remember that a digest was announced."""
        self.memory.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(self.memory, digest)

    def _stamp(self) -> Stamps:
        stamps: Stamps = {}
        for path in sorted(visible_files(self.folder)):
            if self.out in path.parents:
                continue
            with suppress(OSError):  # it was removed meanwhile
                facts = path.lstat()
                if stat.S_ISREG(facts.st_mode):
                    stamps[path.relative_to(self.folder).as_posix()] = (facts.st_size, facts.st_mtime_ns)
        return stamps

    def _content(self, name: str, size: int, modified: int) -> str:
        key = (name, size, modified)
        if key not in self._contents:
            with (self.folder / name).open("rb") as file:
                self._contents[key] = hashlib.file_digest(file, "sha256").hexdigest()
        return self._contents[key]


def check_registered() -> None:
    """Refuse a server without the deployment that an announcement starts, or without its trigger.

    Raises:
        BackendUnavailable: it has none, so that announced files would be lost.
    """
    with get_client(sync_client=True) as client:
        try:
            client.read_deployment_by_name(DEPLOYMENT)
            is_there = client.find_automation(TRIGGER) is not None
        except ObjectNotFound:
            is_there = False
    if not is_there:
        raise BackendUnavailable(f"the Prefect server lacks {DEPLOYMENT!r} or its trigger; run `dg4d up` first")


def announce(folder: Path, out: Path, digest: str) -> None:
    """Send the event that a folder has changed; raise the client's error if the server rejects it."""
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
