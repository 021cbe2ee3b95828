"""What was made of an item, version by version: a record of every finished job, beside its artifacts in the store."""

import hashlib
from collections.abc import Mapping
from datetime import UTC, datetime

from pydantic import ValidationError

from dg4d_lib.errors import BadInput
from flows.engine.leases import wait_for_collecting
from flows.inputs.conversion_job import ConversionJob
from flows.packages.flow_result import FlowResult
from steps.contract import ArtifactRef, Digest, Frozen
from steps.store.artifact_store import ArtifactMissing, ArtifactStore

FOLDER = "versions"


class StepDone(Frozen):
    """One step of a version.

    Attributes:
        label: the step, and the part of its work where it was divided.
        record: digest of its provenance record.
        inputs: by port.
        outputs: by port.
    """

    label: str
    record: Digest
    inputs: dict[str, Digest]
    outputs: dict[str, Digest]


class Version(Frozen):
    """One finished job.

    Attributes:
        item: name of the asset.
        order: digest of what was asked for; the same job again is the same version.
        package: what came out.
        finished: when it was last made or found to be made, ISO 8601 in UTC.
        source: the picture, video or words.
        bank: true views, if there were any.
        steps: in the order in which they were asked for.
    """

    item: str
    order: Digest
    package: ArtifactRef
    finished: str
    profile: str
    seed: int
    source: ArtifactRef
    bank: ArtifactRef | None = None
    steps: tuple[StepDone, ...]

    @property
    def name(self) -> str:
        """Its place in the store: a folder per item, a file per job."""
        return _name(self.item, self.order)

    def artifacts(self) -> dict[str, str]:
        """What the version needs, by digest: what it is to the version."""
        found = {self.package.digest: "package", self.source.digest: "source"}
        if self.bank is not None:
            found.setdefault(self.bank.digest, "bank")
        for step in self.steps:
            for port, digest in step.outputs.items():
                found.setdefault(digest, f"{step.label}: {port}")
        for step in self.steps:
            for port, digest in step.inputs.items():
                found.setdefault(digest, f"{port} for {step.label}")
        return found


def keep_version(store: ArtifactStore, job: ConversionJob, result: FlowResult) -> Version:
    """Record that a job is finished; from now on nothing removes what it needs.

    Raises:
        ArtifactMissing: something it needs was removed at this very moment; the same job again makes it again.
        StoreUnreachable: the store does not answer.
        DiskFull: there is no room.
    """
    version = Version(
        item=job.item,
        order=job.digest(),
        package=result.package,
        finished=datetime.now(UTC).isoformat(timespec="seconds"),
        profile=job.profile,
        seed=job.seed,
        source=job.source,
        bank=job.bank,
        steps=tuple(
            StepDone(
                label=done.label,
                record=done.result.provenance.digest(),
                inputs=done.result.provenance.inputs,
                outputs=done.result.provenance.outputs,
            )
            for done in result.steps
        ),
    )
    store.write(version.name, version.model_dump_json(indent=1) + "\n")
    if wait_for_collecting(store):  # it may have read the records before this one was there
        here = {entry.name for entry in store.artifacts()}
        if gone := [what for digest, what in version.artifacts().items() if digest not in here]:
            store.remove([version.name])
            raise ArtifactMissing(f"{', '.join(gone)} of {job.item} was removed from {store.address} meanwhile")
        store.write(version.name, version.model_dump_json(indent=1) + "\n")  # an older one of this name may have gone
    return version


def has_version(store: ArtifactStore, job: ConversionJob) -> bool:
    """Whether this job was finished before.

    Raises:
        StoreUnreachable: the store does not answer.
    """
    return store.read(_name(job.item, job.digest())) is not None


def versions(store: ArtifactStore) -> list[Version]:
    """Every version: items by name, the newest of each first.

    Raises:
        BadInput: a record cannot be read, so that nobody knows what it needs.
        StoreUnreachable: the store does not answer.
    """
    found = []
    for entry in store.entries(FOLDER):
        content = store.read(entry.name)
        try:
            found += [] if content is None else [Version.model_validate_json(content)]
        except ValidationError as error:
            raise BadInput(
                f"the record {entry.name} in {store.address} is damaged, or of another version of dg4d: use that one, "
                "or remove the record if nobody needs what it was about"
            ) from error
    newest_first = sorted(found, key=lambda version: (version.finished, version.order), reverse=True)
    return sorted(newest_first, key=lambda version: version.item)


def users(of: list[Version]) -> dict[str, list[tuple[Version, str]]]:
    """Which of these versions need an artifact, by digest, and what it is to each."""
    found: dict[str, list[tuple[Version, str]]] = {}
    for version in of:
        for digest, what in version.artifacts().items():
            found.setdefault(digest, []).append((version, what))
    return found


def faults(store: ArtifactStore, of: list[Version], sizes: Mapping[str, int]) -> dict[str, str]:
    """Read every artifact again: what is damaged, and what versions need and is not there, by digest.

    Args:
        store: where they are.
        of: the versions that must be whole.
        sizes: of the artifacts that are there, by digest.

    Raises:
        StoreUnreachable: the store does not answer.
    """
    wrong = dict.fromkeys(users(of).keys() - sizes.keys(), "is missing")
    wrong.update({digest: "is damaged" for digest in sizes if store.content_digest(digest) not in (digest, None)})
    return wrong


def _name(item: str, job: Digest) -> str:
    return f"{FOLDER}/{_key(item)}/{job.removeprefix('sha256:')}.json"


def _key(item: str) -> str:
    """A folder's name that differs for different items, whatever is in their names."""
    slug = "".join(letter if letter.isascii() and letter.isalnum() else "-" for letter in item)[:40]
    return f"{slug}-{hashlib.sha256(item.encode()).hexdigest()[:12]}"
