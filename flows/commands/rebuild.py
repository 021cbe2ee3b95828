"""A package made again from its record, and how it compares; behind `dg4d rebuild`."""

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

from dg4d_lib.errors import BackendUnavailable, BadInput
from flows import home
from flows.convert import run_flow
from flows.exit_status import EXIT_FAILED
from flows.inputs.conversion_job import ConversionJob
from flows.packages.credentials import configured_signer
from flows.packages.publish import Files, file_digest, unpacked
from flows.packages.report import deliver
from steps.artifacts.artifact_diff import TOLERANCE, difference
from steps.contract import ArtifactRef, Frozen, StepResult
from steps.runtime.installed_code import catalog
from steps.store.artifact_store import ArtifactMissing

Outcome = Literal["identical", "within tolerance", "different", "not compared"]


class Likeness(Frozen):
    """How one thing came out the second time.

    Attributes:
        kind: what sort of thing.
        name: of the step, or of the file in the package.
        outcome: "within tolerance": no difference above `steps.artifacts.artifact_diff.TOLERANCE`; "not compared":
            other bytes, and the first result is not in the store, or its format is unknown.
        difference: the largest, as a share of the range of values; None where none was measured.
        detail: for people.
    """

    kind: Literal["step", "file"]
    name: str
    outcome: Outcome
    difference: float | None = None
    detail: str = ""


class Rebuilt(Frozen):
    """What came of making a package again.

    Attributes:
        package: the one that was made first.
        circumstances: what was not as it was then: code, installed packages, processor.
        likenesses: of every step and every file.
    """

    package: str
    circumstances: tuple[str, ...]
    likenesses: tuple[Likeness, ...]

    @property
    def exit_code(self) -> int:
        """0 if nothing that was compared is different, else 1."""
        return EXIT_FAILED if any(likeness.outcome == "different" for likeness in self.likenesses) else 0

    def rows(self) -> Iterator[tuple[str, str, str]]:
        """What, how it came out, why: every step, then files; those that are identical in one row."""
        yield from ((found.name, found.outcome, found.detail) for found in self.likenesses if found.kind == "step")
        files = [found for found in self.likenesses if found.kind == "file"]
        if same := sum(found.outcome == "identical" for found in files):
            yield f"{same} file{'s' * (same != 1)}", "identical", ""
        yield from ((found.name, found.outcome, found.detail) for found in files if found.outcome != "identical")
        yield from ((text, "another then", "") for text in self.circumstances)


def rebuild(folder: Path, record: Mapping[str, Any], job: ConversionJob, out: Path | None = None) -> Rebuilt:
    """Do every step of a package again, none from what was kept, and compare.

    Args:
        folder: the package.
        record: its provenance.
        job: what it was made from (`conversion_job.job_from_record`).
        out: where to put the new package; None: nowhere.

    Raises:
        StepError: a step did not finish.
        BadInput: `out` cannot be written.
    """
    signer = configured_signer() if out else None
    labels = [run["step"] for run in record["run"]["steps"]]
    if len(labels) != len(record["steps"]):
        raise BadInput(
            f"{folder} cannot be made again: its record has {len(record['steps'])} steps, its run {len(labels)}"
        )
    first = dict(zip(labels, record["steps"], strict=True))
    machines = {run["step"]: run.get("machine", {}) for run in record["run"]["steps"]}
    made = run_flow(job, refresh=True, mesh_parts=sum(label.startswith("extract_mesh ") for label in labels))
    again = {done.label: done.result for done in made.steps}
    if out is not None:
        deliver(job, made, out, signer).keep()
    with TemporaryDirectory(prefix="dg4d-rebuild-") as scratch:
        new = Path(scratch) / "new"
        new.mkdir()
        files = unpacked(home.store().path(made.package), new)
        likenesses = [*_steps(record, first, again, Path(scratch)), *_files(record, folder, files, new)]
    circumstances = dict.fromkeys(_circumstances(first, machines, again))
    return Rebuilt(package=str(folder), circumstances=tuple(circumstances), likenesses=tuple(likenesses))


def _steps(
    record: Mapping[str, Any],
    first: Mapping[str, Mapping[str, Any]],
    again: Mapping[str, StepResult],
    scratch: Path,
) -> Iterator[Likeness]:
    """Every step by its label, in order."""
    for label, step in first.items():
        outputs = again[label].outputs if label in again else {}
        if {port: ref.digest for port, ref in outputs.items()} == step["outputs"]:
            yield Likeness(kind="step", name=label, outcome="identical")
        elif outputs.keys() == step["outputs"].keys():
            yield _step(label, step, record["artifacts"], outputs, scratch)
        else:
            detail = "it gave other outputs" if outputs else "it was not done the second time"
            yield Likeness(kind="step", name=label, outcome="different", detail=detail)
    for label in again.keys() - first.keys():
        yield Likeness(kind="step", name=label, outcome="different", detail="it was not done the first time")


def _step(
    label: str,
    step: Mapping[str, Any],
    artifacts: Mapping[str, Any],
    outputs: Mapping[str, ArtifactRef],
    scratch: Path,
) -> Likeness:
    """A step of which an output has other bytes."""
    found = {}
    for port, ref in outputs.items():
        digest = step["outputs"][port]
        if ref.digest == digest:
            continue
        suffix = catalog()[step["step"]].outputs[port].suffix
        one, two = scratch / f"one{suffix}", scratch / f"two{suffix}"
        try:
            home.store().get(ArtifactRef(digest=digest, **artifacts[digest]), one)
            home.store().get(ref, two)
        except ArtifactMissing:
            detail = f"{port} has other bytes, and the first result is not in the store"
            return Likeness(kind="step", name=label, outcome="not compared", detail=detail)
        found[port] = _difference(one, two)
    return _judged("step", label, found)


def _files(record: Mapping[str, Any], folder: Path, files: Files, new: Path) -> Iterator[Likeness]:
    """Every file of the package that steps made; signatures never come out twice the same and do not count."""
    signed = record["signatures"].get("files", {})
    sidecars = {how.get("sidecar") for how in signed.values()}
    for name, fact in record["files"].items():
        if name in sidecars:
            continue
        first = signed.get(name, {}).get("unsigned", fact)
        if name not in files:
            yield Likeness(kind="file", name=name, outcome="different", detail="it was not made the second time")
        elif files[name] == first:
            yield Likeness(kind="file", name=name, outcome="identical")
        elif not (folder / name).is_file() or file_digest(folder / name) != fact:
            detail = "it has other bytes, and the first file is not as it was made"
            yield Likeness(kind="file", name=name, outcome="not compared", detail=detail)
        else:
            yield _judged("file", name, {name: _difference(folder / name, new / name)})
    for name in files.keys() - record["files"].keys():
        yield Likeness(kind="file", name=name, outcome="different", detail="it was not made the first time")


def _difference(one: Path, two: Path) -> float | None:
    try:
        return difference(one, two)
    except (BadInput, BackendUnavailable):
        return None


def _judged(kind: Literal["step", "file"], name: str, found: Mapping[str, float | None]) -> Likeness:
    """The verdict on differences, by what differs."""
    largest = max((value for value in found.values() if value is not None), default=None)
    unknown = [what for what, value in found.items() if value is None]
    parts = [what for what in found if what != name]
    detail = f"in {', '.join(parts)}" if parts else ""
    if largest is not None and largest > TOLERANCE:
        apart = "other shapes, counts or texts" if math.isinf(largest) else f"{largest:.2%} apart"
        finite = None if math.isinf(largest) else largest
        return Likeness(
            kind=kind, name=name, outcome="different", difference=finite, detail=f"{apart} {detail}".strip()
        )
    if unknown:
        detail = f"other bytes, and no measure for {', '.join(unknown)}"
        return Likeness(kind=kind, name=name, outcome="not compared", difference=largest, detail=detail)
    detail = f"at most {largest:.2%} apart {detail}".strip()
    return Likeness(kind=kind, name=name, outcome="within tolerance", difference=largest, detail=detail)


def _circumstances(
    first: Mapping[str, Mapping[str, Any]], machines: Mapping[str, Mapping[str, str]], again: Mapping[str, StepResult]
) -> Iterator[str]:
    """What was another then: code, backend, weights, machine; each said once."""
    for label in [label for label in first if label in again]:
        step, now = first[label], again[label].provenance
        then = {"code": step["code_version"], "backend": step["backend"], **step["weights"], **machines[label]}
        here = {"code": now.code_version, "backend": now.backend, **now.weights, **now.machine}
        for what in sorted({*then, *here}):
            if then.get(what) != here.get(what):
                yield f"{what}: {then.get(what, 'none')} then, {here.get(what, 'none')} now"
