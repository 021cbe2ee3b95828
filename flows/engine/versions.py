"""Versions of items: records of finished jobs, beside their artifacts in the store."""

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


class VersionStep(Frozen):
    """Digests of one step of a version: its provenance record, and its inputs and outputs by port."""

    label: str
    record: Digest
    inputs: dict[str, Digest]
    outputs: dict[str, Digest]


class Version(Frozen):
    """Finished job.

    Attributes:
        item: name of the asset.
        order: digest of the job; the same job again is the same version.
        package: result of the conversion.
        finished: time of the last run that made or found it, ISO 8601 in UTC.
        source: picture, video or text.
        bank: ground-truth views, if given.
        mask: of the subject, if given.
        depth: picture of the subject's depth, if given.
        layers: picture of the order of its parts in depth, if given.
        views: pictures of other sides, if given.
        steps: in pipeline order.
    """

    item: str
    order: Digest
    package: ArtifactRef
    finished: str
    profile: str
    seed: int
    source: ArtifactRef
    bank: ArtifactRef | None = None
    mask: ArtifactRef | None = None
    depth: ArtifactRef | None = None
    layers: ArtifactRef | None = None
    views: ArtifactRef | None = None
    steps: tuple[VersionStep, ...]

    @property
    def name(self) -> str:
        """Name of its file in the store: a folder per item, a file per job."""
        return _name(self.item, self.order)

    def artifacts(self) -> dict[str, str]:
        """Return the digests of all artifacts of the version with their role."""
        found = {self.package.digest: "package", self.source.digest: "source"}
        for role in ("bank", "mask", "depth", "layers", "views"):
            given: ArtifactRef | None = getattr(self, role)
            if given is not None:
                found.setdefault(given.digest, role)
        for step in self.steps:
            for port, digest in step.outputs.items():
                found.setdefault(digest, f"{step.label}: {port}")
        for step in self.steps:
            for port, digest in step.inputs.items():
                found.setdefault(digest, f"{port} for {step.label}")
        return found


def keep_version(store: ArtifactStore, job: ConversionJob, result: FlowResult) -> Version:
    """Write the version of a finished job, which protects its artifacts from garbage collection.

    Raises:
        ArtifactMissing: a collection removed an artifact meanwhile; run the job again.
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
        mask=job.mask,
        depth=job.depth,
        layers=job.layers,
        views=job.views,
        steps=tuple(
            VersionStep(
                label=done.label,
                record=done.result.provenance.digest(),
                inputs=done.result.provenance.inputs,
                outputs=done.result.provenance.outputs,
            )
            for done in result.steps
        ),
    )
    store.write(version.name, version.model_dump_json(indent=1) + "\n")
    if wait_for_collecting(store):  # it may have listed the versions before this one was written
        here = {entry.name for entry in store.artifacts()}
        if gone := [what for digest, what in version.artifacts().items() if digest not in here]:
            store.remove([version.name])
            raise ArtifactMissing(f"{', '.join(gone)} of {job.item} was removed from {store.address} meanwhile")
        store.write(
            version.name, version.model_dump_json(indent=1) + "\n"
        )  # the collection may have removed an older file of this name
    return version


def has_version(store: ArtifactStore, job: ConversionJob) -> bool:
    """Return true if the job was finished before.

    Raises:
        StoreUnreachable: the store does not answer.
    """
    return store.read(_name(job.item, job.digest())) is not None


def versions(store: ArtifactStore) -> list[Version]:
    """Return all versions: items by name, the newest of each first.

    Raises:
        BadInput: a version cannot be read, so the artifacts it needs are unknown.
        StoreUnreachable: the store does not answer.
    """
    found = []
    for entry in store.entries(FOLDER):
        content = store.read(entry.name)
        try:
            found += [] if content is None else [Version.model_validate_json(content)]
        except ValidationError as error:
            raise BadInput(
                f"the record {entry.name} in {store.address} is damaged, or of another version of dg4d: use that "
                "version, or remove the record if its asset is not needed"
            ) from error
    newest_first = sorted(found, key=lambda version: (version.finished, version.order), reverse=True)
    return sorted(newest_first, key=lambda version: version.item)


def users(of: list[Version]) -> dict[str, list[tuple[Version, str]]]:
    """Return the versions that need an artifact, with its role in each, by digest."""
    found: dict[str, list[tuple[Version, str]]] = {}
    for version in of:
        for digest, what in version.artifacts().items():
            found.setdefault(digest, []).append((version, what))
    return found


def faults(store: ArtifactStore, of: list[Version], sizes: Mapping[str, int]) -> dict[str, str]:
    """Read every artifact again and return the damaged and missing ones by digest.

    Args:
        store: store to check.
        of: versions whose artifacts must exist.
        sizes: existing artifacts, by digest.

    Raises:
        StoreUnreachable: the store does not answer.
    """
    wrong = dict.fromkeys(users(of).keys() - sizes.keys(), "is missing")
    wrong.update({digest: "is damaged" for digest in sizes if store.content_digest(digest) not in (digest, None)})
    return wrong


def _name(item: str, job: Digest) -> str:
    return f"{FOLDER}/{_key(item)}/{job.removeprefix('sha256:')}.json"


def _key(item: str) -> str:
    """Return a folder name for an item, unique for any characters in its name."""
    slug = "".join(letter if letter.isascii() and letter.isalnum() else "-" for letter in item)[:40]
    return f"{slug}-{hashlib.sha256(item.encode()).hexdigest()[:12]}"
