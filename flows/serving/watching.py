"""Watched folder: sends an event to the server when its files have changed and come to rest."""

import stat
from contextlib import suppress
from pathlib import Path
from uuid import UUID, uuid4

from prefect.client.orchestration import get_client
from prefect.client.schemas.filters import (
    DeploymentFilter,
    DeploymentFilterName,
    FlowRunFilter,
    FlowRunFilterState,
    FlowRunFilterStateType,
)
from prefect.client.schemas.objects import FlowRun, StateType
from prefect.client.schemas.sorting import FlowRunSort
from prefect.events import Event, Resource
from prefect.exceptions import ObjectNotFound

from dg4d_lib.errors import BackendUnavailable, BadInput, listed
from flows.formatting.escaping import visible
from flows.inputs.listing import SUFFIXES
from flows.inputs.rows import MANIFESTS
from flows.serving.results import check_watched, visible_files
from steps.contract import digest_of
from steps.sources.media_types import MODEL_SUFFIXES

CHANGED = "dg4d.folder.changed"  # event of the trigger in deploy/prefect.yaml
DEPLOYMENT, TRIGGER = "catalog-to-4d/Catalog to 4D", "dg4d catalog of a dropped folder"  # names, likewise
LONGEST_RESTS = 30  # times `rest_s` that a file at rest waits for others which still change
NAMED = {*SUFFIXES, *MANIFESTS, *MODEL_SUFFIXES}  # suffixes of files that the rows of a manifest may name

Stamp = tuple[int, int]  # size in bytes, time of the last change in nanoseconds


class Watcher:
    """Watcher of a folder for files that a batch has not converted yet.

    Only files that the batch reads count: pictures and videos; with a manifest directly in the folder, the manifest and
    models too. All files of a new watcher are new: a batch skips the items that are finished.

    Args:
        folder: watched folder with its subfolders; hidden files do not count.
        out: output folder; its files do not count.
        rest_s: seconds without a change before files count as complete.

    Raises:
        BadInput: there is no such folder, or it is in the output folder.
    """

    def __init__(self, folder: Path, out: Path, rest_s: float) -> None:
        check_watched(folder, out)
        self.folder, self.out, self.rest_s = folder.resolve(), out.resolve(), rest_s
        self._seen: dict[str, tuple[Stamp, float]] = {}  # with the time of the poll that found it first
        self._announced: dict[str, Stamp] = {}

    def poll(self, now: float) -> str | None:
        """Return a digest of the folder's state if there are new, complete files; else None.

        Files are announced when all new ones are at rest, or when one has waited `LONGEST_RESTS * rest_s` seconds for
        the others. What is incomplete then fails or is converted as it is, and is announced again when it is at rest.

        Args:
            now: time of a monotonic clock in seconds.
        """
        stamps, before = self._stamps(), self._seen
        self._seen = {
            name: before[name] if name in before and before[name][0] == stamp else (stamp, now)
            for name, stamp in stamps.items()
        }
        new = [since for name, (stamp, since) in self._seen.items() if self._announced.get(name) != stamp]
        if not new or (now - max(new) < self.rest_s and now - min(new) < LONGEST_RESTS * self.rest_s):
            return None
        return digest_of(stamps)

    def inputs(self) -> Path:
        """Return the input of the batch: the manifest directly in the folder, else the folder.

        Raises:
            BadInput: there are several manifests.
        """
        found = sorted(name for name in self._seen if _is_manifest(Path(name)))
        if len(found) > 1:
            raise BadInput(
                f"{self.folder} holds several manifests ({listed(found, 3)}), and a batch reads one: keep one there, "
                "move the other files with these endings into a folder below it"
            )
        return self.folder / found[0] if found else self.folder

    def mark_announced(self) -> None:
        """Mark the files of the last poll as announced."""
        self._announced = {name: stamp for name, (stamp, _) in self._seen.items()}

    def _stamps(self) -> dict[str, Stamp]:
        names = [path.relative_to(self.folder) for path in visible_files(self.folder) if self.out not in path.parents]
        read = NAMED if any(map(_is_manifest, names)) else SUFFIXES
        stamps: dict[str, Stamp] = {}
        for name in sorted(names):
            if name.suffix.lower() in read:
                with suppress(OSError):  # it was removed meanwhile
                    facts = (self.folder / name).lstat()
                    if stat.S_ISREG(facts.st_mode):
                        stamps[name.as_posix()] = facts.st_size, facts.st_mtime_ns
        return stamps


class FailedRuns:
    """Failed runs of the deployment that announcements start; those that exist at the start are not reported.

    Args:
        out: output folder of the runs.
    """

    def __init__(self, out: Path) -> None:
        self.out = str(out)
        self._known: set[UUID] = {run.id for run in self._failed()}

    def poll(self) -> list[str]:
        """Return a line for every run that failed since the last poll.

        Raises:
            TransportError, PrefectHTTPStatusError: the server does not answer, or refuses.
        """
        new = [run for run in self._failed() if run.id not in self._known]
        self._known |= {run.id for run in new}
        return [visible(f"failed: run {run.name}: {run.state.message if run.state else ''}") for run in reversed(new)]

    def _failed(self) -> list[FlowRun]:
        """Return the last failed runs, latest first."""
        with get_client(sync_client=True) as client:
            runs = client.read_flow_runs(
                deployment_filter=DeploymentFilter(name=DeploymentFilterName(any_=[DEPLOYMENT.partition("/")[2]])),
                flow_run_filter=FlowRunFilter(
                    state=FlowRunFilterState(type=FlowRunFilterStateType(any_=[StateType.FAILED]))
                ),
                sort=FlowRunSort.END_TIME_DESC,
            )
        return [run for run in runs if run.parameters.get("out") == self.out]


def _is_manifest(name: Path) -> bool:
    """Return True for a manifest directly in the watched folder."""
    return name.parent == Path() and name.suffix.lower() in MANIFESTS


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
        raise BackendUnavailable(
            f'the Prefect server has no deployment "{DEPLOYMENT.partition("/")[2]}" with its trigger, which converts '
            "the files; run `dg4d up` first"
        )


def announce(folder: Path, inputs: Path, out: Path, digest: str) -> None:
    """Send the event that a folder has changed.

    Args:
        folder: watched folder.
        inputs: input of the batch, `Watcher.inputs`.
        out: output folder.
        digest: of the state of the folder.

    Raises:
        TransportError, PrefectHTTPStatusError: the server does not answer, or rejects it.
    """
    event = Event(
        id=uuid4(),
        event=CHANGED,
        resource=Resource.model_validate(
            {
                "prefect.resource.id": f"dg4d.folder.{digest_of(str(folder)).removeprefix('sha256:')[:16]}",
                "prefect.resource.name": str(folder),
            }
        ),
        payload={"folder": str(folder), "inputs": str(inputs), "out": str(out), "digest": digest},
    )
    with get_client(sync_client=True) as client:
        client.request("POST", "/events", json=[event.model_dump(mode="json")]).raise_for_status()
