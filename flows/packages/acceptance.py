"""Results of the quality gates, for reports, summaries and the Prefect UI."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from flows.inputs.package_record import REPORT
from steps.contract import StepResult
from steps.store.artifact_store import ArtifactStore

GATES, PICTURE = "gates", "picture"  # outputs of check_asset
CUTOUT = "subject"  # output of prepare_subject, which has a picture, too


def load_verdict(results: Iterable[StepResult], store: ArtifactStore) -> dict[str, Any] | None:
    """Return the verdict of the gates in a run; None if they did not run, or the artifact is gone."""
    content = _output(results, GATES, store)
    return None if content is None else json.loads(content)


def load_picture(results: Iterable[StepResult], store: ArtifactStore) -> bytes | None:
    """Return the picture of the worst frames, PNG; None as for `load_verdict`."""
    return _output(results, PICTURE, store)


def load_cutout(results: Iterable[StepResult], store: ArtifactStore) -> bytes | None:
    """Return the picture of source, matte and cut-out, PNG; None if the step did not run, or the artifact is gone."""
    refs = [result.outputs[PICTURE] for result in results if CUTOUT in result.outputs and PICTURE in result.outputs]
    return store.path(refs[0]).read_bytes() if refs and store.has(refs[0]) else None


def failing_gates(folder: Path) -> list[str] | None:
    """Return the gates that the package in a folder fails, by its report; None if there is no verdict."""
    try:
        return list(json.loads((folder / REPORT).read_text(encoding="utf-8"))["acceptance"]["failing"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None


def format_bounds(gate: dict[str, Any]) -> str:
    """Return the allowed range of a gate with its unit."""
    least, most, unit = gate["least"], gate["most"], f" {gate['unit']}" if gate["unit"] else ""
    if least is not None and most is not None:
        return f"{least:g} to {most:g}{unit}"
    return f"at most {most:g}{unit}" if least is None else f"at least {least:g}{unit}"


def format_value(gate: dict[str, Any]) -> str:
    """Return the value of a gate with its unit."""
    return f"{gate['value']:.3g} {gate['unit']}".strip()


def markdown(verdict: dict[str, Any]) -> list[str]:
    """Return a verdict as lines of Markdown."""
    rows = [
        f"| {'passed' if gate['passed'] else '**failed**'} | {gate['name']} | {format_value(gate)} "
        f"| {format_bounds(gate)} | {gate['meaning'] if gate['passed'] else gate['advice']} |"
        for gate in verdict["gates"]
    ]
    return [f"**{headline(verdict)}**", "", "| | gate | value | bounds | |", "|---|---|---|---|---|", *rows, ""]


def headline(verdict: dict[str, Any]) -> str:
    """Summarize a verdict in one line."""
    passed = len(verdict["gates"]) - len(verdict["failing"])
    if verdict["accepted"]:
        return f"Accepted: all {passed} gates passed."
    return f"Not accepted: {', '.join(verdict['failing'])} failed, {passed} of {len(verdict['gates'])} gates passed."


def _output(results: Iterable[StepResult], name: str, store: ArtifactStore) -> bytes | None:
    """Return an output of the step that evaluated the gates."""
    refs = [result.outputs[name] for result in results if GATES in result.outputs]
    return store.path(refs[0]).read_bytes() if refs and store.has(refs[0]) else None
