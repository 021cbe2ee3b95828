"""Reproduction of a package from its record, compared step by step; behind `dg4d rebuild`."""

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

from dg4d_lib.errors import BackendUnavailable, BadInput
from flows import home
from flows.convert import run_flow
from flows.engine.events import remark_on_output
from flows.engine.leases import running
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


class Comparison(Frozen):
    """Comparison of a step or file with its first run.

    Attributes:
        kind: of the compared object.
        name: of the step, or of the file in the package.
        outcome: "within tolerance": no difference above `steps.artifacts.artifact_diff.TOLERANCE`; "not compared":
            other bytes, and the first result is not in the store, or its format is unknown.
        difference: largest one, relative to the range of values; None if none was measured.
        detail: for people.
    """

    kind: Literal["step", "file"]
    name: str
    outcome: Outcome
    difference: float | None = None
    detail: str = ""


class RebuildReport(Frozen):
    """Result of `rebuild`.

    Attributes:
        package: the first package.
        environment_changes: code, installed packages and processor that changed since the record.
        comparisons: of every step and every file.
    """

    package: str
    environment_changes: tuple[str, ...]
    comparisons: tuple[Comparison, ...]

    @property
    def exit_code(self) -> int:
        """Exit status: 1 if a step or file differs, else 0."""
        return EXIT_FAILED if any(found.outcome == "different" for found in self.comparisons) else 0

    def rows(self) -> Iterator[tuple[str, str, str]]:
        """Yield name, outcome and detail: of every step, then of files, with one row for identical ones."""
        yield from ((found.name, found.outcome, found.detail) for found in self.comparisons if found.kind == "step")
        files = [found for found in self.comparisons if found.kind == "file"]
        if same := sum(found.outcome == "identical" for found in files):
            yield f"{same} file{'s' * (same != 1)}", "identical", ""
        yield from ((found.name, found.outcome, found.detail) for found in files if found.outcome != "identical")
        yield from ((text, "changed since the record", "") for text in self.environment_changes)


def rebuild(folder: Path, record: Mapping[str, Any], job: ConversionJob, out: Path | None = None) -> RebuildReport:
    """Run every step of a package again, without cached results, and compare.

    Args:
        folder: the package.
        record: its provenance.
        job: of its record (`conversion_job.job_from_record`).
        out: folder for the new package; None: it is not kept.

    Raises:
        StepError: a step failed.
        BadInput: `out` cannot be written.
    """
    signer = configured_signer() if out else None
    labels = [run["step"] for run in record["run"]["steps"]]
    if len(labels) != len(record["steps"]):
        raise BadInput(
            f"{folder} cannot be rebuilt: its record has {len(record['steps'])} steps, and its run {len(labels)}; make "
            "the asset again"
        )
    first = dict(zip(labels, record["steps"], strict=True))
    machines = {run["step"]: run.get("machine", {}) for run in record["run"]["steps"]}
    with running(home.store(), job.item, job.given().values()):
        made = run_flow(job, refresh=True, mesh_parts=sum(label.startswith("extract_mesh ") for label in labels))
        again = {done.label: done.result for done in made.steps}
        if out is not None:
            deliver(job, made, out, signer, remark_on_output(job.item))
        with TemporaryDirectory(prefix="dg4d-rebuild-") as scratch:
            new = Path(scratch) / "new"
            new.mkdir()
            files = unpacked(home.store().path(made.package), new)
            comparisons = [*_steps(record, first, again, Path(scratch)), *_files(record, folder, files, new)]
    changes = dict.fromkeys(_environment_changes(first, machines, again))
    return RebuildReport(package=str(folder), environment_changes=tuple(changes), comparisons=tuple(comparisons))


def _steps(
    record: Mapping[str, Any],
    first: Mapping[str, Mapping[str, Any]],
    again: Mapping[str, StepResult],
    scratch: Path,
) -> Iterator[Comparison]:
    """Compare every step by its label, in order."""
    for label, step in first.items():
        outputs = again[label].outputs if label in again else {}
        if {port: ref.digest for port, ref in outputs.items()} == step["outputs"]:
            yield Comparison(kind="step", name=label, outcome="identical")
        elif outputs.keys() == step["outputs"].keys():
            yield _step(label, step, record["artifacts"], outputs, scratch)
        else:
            detail = "it has other outputs" if outputs else "it did not run the second time"
            yield Comparison(kind="step", name=label, outcome="different", detail=detail)
    for label in again.keys() - first.keys():
        yield Comparison(kind="step", name=label, outcome="different", detail="it did not run the first time")


def _step(
    label: str,
    step: Mapping[str, Any],
    artifacts: Mapping[str, Any],
    outputs: Mapping[str, ArtifactRef],
    scratch: Path,
) -> Comparison:
    """Compare a step of which an output has other bytes."""
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
            return Comparison(kind="step", name=label, outcome="not compared", detail=detail)
        found[port] = _difference(one, two)
    return _compared("step", label, found)


def _files(record: Mapping[str, Any], folder: Path, files: Files, new: Path) -> Iterator[Comparison]:
    """Compare every file of the package that steps made; signatures differ in every run and are left out."""
    signed = record["signatures"].get("files", {})
    sidecars = {how.get("sidecar") for how in signed.values()}
    for name, fact in record["files"].items():
        if name in sidecars:
            continue
        first = signed.get(name, {}).get("unsigned", fact)
        if name not in files:
            yield Comparison(kind="file", name=name, outcome="different", detail="it is missing the second time")
        elif files[name] == first:
            yield Comparison(kind="file", name=name, outcome="identical")
        elif not (folder / name).is_file() or file_digest(folder / name) != fact:
            detail = "it has other bytes, and the first file was altered"
            yield Comparison(kind="file", name=name, outcome="not compared", detail=detail)
        else:
            yield _compared("file", name, {name: _difference(folder / name, new / name)})
    for name in files.keys() - record["files"].keys():
        yield Comparison(kind="file", name=name, outcome="different", detail="it is missing the first time")


def _difference(one: Path, two: Path) -> float | None:
    try:
        return difference(one, two)
    except (BadInput, BackendUnavailable):
        return None


def _compared(kind: Literal["step", "file"], name: str, found: Mapping[str, float | None]) -> Comparison:
    """Return the comparison of a step or file from the differences of its parts."""
    largest = max((value for value in found.values() if value is not None), default=None)
    unknown = [what for what, value in found.items() if value is None]
    parts = [what for what in found if what != name]
    detail = f"in {', '.join(parts)}" if parts else ""
    if largest is not None and largest > TOLERANCE:
        apart = "other shapes, counts or texts" if math.isinf(largest) else f"differs by {largest:.2%}"
        finite = None if math.isinf(largest) else largest
        return Comparison(
            kind=kind, name=name, outcome="different", difference=finite, detail=f"{apart} {detail}".strip()
        )
    if unknown:
        detail = f"other bytes, and no metric for {', '.join(unknown)}"
        return Comparison(kind=kind, name=name, outcome="not compared", difference=largest, detail=detail)
    detail = f"differs by at most {largest:.2%} {detail}".strip()
    return Comparison(kind=kind, name=name, outcome="within tolerance", difference=largest, detail=detail)


def _environment_changes(
    first: Mapping[str, Mapping[str, Any]], machines: Mapping[str, Mapping[str, str]], again: Mapping[str, StepResult]
) -> Iterator[str]:
    """Yield changes of code, backend, weights and machine since the record."""
    for label in [label for label in first if label in again]:
        step, now = first[label], again[label].provenance
        then = {"code": step["code_version"], "backend": step["backend"], **step["weights"], **machines[label]}
        here = {"code": now.code_version, "backend": now.backend, **now.weights, **now.machine}
        for what in sorted({*then, *here}):
            if then.get(what) != here.get(what):
                yield f"{what}: {then.get(what, 'none')} recorded, {here.get(what, 'none')} now"
