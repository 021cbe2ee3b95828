"""What the gates say about an asset, for reports, summaries and the Prefect UI."""

import base64
import html
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from steps.contract import StepResult
from steps.store.artifact_store import ArtifactStore

GATES, PICTURE = "gates", "picture"  # outputs of check_asset


def verdict_of(results: Iterable[StepResult], store: ArtifactStore) -> dict[str, Any] | None:
    """What the gates said in a run; None if they were not asked, or the answer is gone."""
    content = _output(results, GATES, store)
    return None if content is None else json.loads(content)


def picture_of(results: Iterable[StepResult], store: ArtifactStore) -> bytes | None:
    """The picture that goes with the verdict, PNG."""
    return _output(results, PICTURE, store)


def failing_in(folder: Path) -> list[str] | None:
    """The gates that the package in a folder fails, by its report; None if there is no verdict."""
    try:
        return list(json.loads((folder / "report.json").read_text(encoding="utf-8"))["acceptance"]["failing"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None


def bounds(gate: dict[str, Any]) -> str:
    """What a value may be, for people."""
    least, most, unit = gate["least"], gate["most"], f" {gate['unit']}" if gate["unit"] else ""
    if least is not None and most is not None:
        return f"{least:g} to {most:g}{unit}"
    return f"at most {most:g}{unit}" if least is None else f"at least {least:g}{unit}"


def section(verdict: dict[str, Any], picture: bytes | None) -> str:
    """A verdict as HTML: a row per gate, what to do about those that fail, and the picture."""
    rows = "".join(
        f"<tr class={'passed' if gate['passed'] else 'missed'}><td>{'passed' if gate['passed'] else 'failed'}"
        f"<td>{html.escape(gate['name'])}<td class=number>{gate['value']:.3g}{html.escape(_unit(gate))}"
        f"<td>{html.escape(bounds(gate))}<td>{html.escape(gate['form'])}<td>{html.escape(gate['meaning'])}"
        + ("" if gate["passed"] else f"<br><b>{html.escape(gate['advice'])}</b>")
        for gate in verdict["gates"]
    )
    head = "<tr><th><th>gate<th>value<th>bounds<th>of<th>"
    shown = ""
    if picture is not None:
        address = f"data:image/png;base64,{base64.b64encode(picture).decode()}"
        shown = (
            f'<details><summary>the worst moments</summary><img alt="input, splats, mesh" src="{address}"></details>'
        )
    return f"<p class=verdict>{html.escape(headline(verdict))}</p><table class=gates>{head}{rows}</table>{shown}"


def markdown(verdict: dict[str, Any]) -> list[str]:
    """A verdict as lines of Markdown."""
    rows = [
        f"| {'passed' if gate['passed'] else '**failed**'} | {gate['name']} | {gate['value']:.3g}{_unit(gate)} "
        f"| {bounds(gate)} | {gate['meaning'] if gate['passed'] else gate['advice']} |"
        for gate in verdict["gates"]
    ]
    return [f"**{headline(verdict)}**", "", "| | gate | value | bounds | |", "|---|---|---|---|---|", *rows, ""]


def headline(verdict: dict[str, Any]) -> str:
    """One line."""
    passed = len(verdict["gates"]) - len(verdict["failing"])
    if verdict["accepted"]:
        return f"Accepted: all {passed} gates passed."
    return f"Not accepted: {', '.join(verdict['failing'])} failed, {passed} of {len(verdict['gates'])} gates passed."


def _output(results: Iterable[StepResult], name: str, store: ArtifactStore) -> bytes | None:
    """An output of the step that asked the gates."""
    refs = [result.outputs[name] for result in results if GATES in result.outputs]
    return store.path(refs[0]).read_bytes() if refs and store.has(refs[0]) else None


def _unit(gate: dict[str, Any]) -> str:
    return f" {gate['unit']}" if gate["unit"] else ""
