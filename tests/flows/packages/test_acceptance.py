import json
import re
from pathlib import Path
from typing import Any

import pytest

from flows.packages import acceptance, report
from flows.packages.summary import NOT_ACCEPTED, Row, Writer, with_verdict
from steps.contract import ArtifactRef, ProvenanceRecord, StepResult
from steps.store.artifact_store import ArtifactStore


def gate(name: str, value: float, least: float | None, most: float | None, passed: bool) -> dict[str, Any]:
    about = {"unit": "dB", "form": "mesh", "values": {"mesh": value}, "meaning": "how <well>", "advice": "try <again>"}
    return {"name": name, "value": value, "least": least, "most": most, "passed": passed, **about}


def verdict(*failing: str) -> dict[str, Any]:
    gates = [gate(name, 12.5, 16.0, None, name not in failing) for name in ("fidelity", "floaters")]
    return {"accepted": not failing, "failing": list(failing), "gates": gates}


def result(step: str, **outputs: ArtifactRef) -> StepResult:
    record = ProvenanceRecord(
        step=step,
        code_version="1",
        request_digest="sha256:" + "b" * 64,
        inputs={},
        outputs={name: ref.digest for name, ref in outputs.items()},
        settings={},
        seed=0,
        backend="cpu",
        duration_s=1.0,
        peak_memory_mb=1.0,
    )
    return StepResult(outputs=outputs, provenance=record)


@pytest.fixture
def store(tmp_path: Path) -> ArtifactStore:
    return ArtifactStore(tmp_path / "store")


def package(folder: Path, *failing: str) -> Path:
    folder.mkdir(parents=True)
    (folder / "report.json").write_text(json.dumps({"acceptance": verdict(*failing)}))
    return folder


def test_the_verdict_and_its_picture_are_found_among_the_steps(store: ArtifactStore) -> None:
    kept = {
        "gates": store.put_bytes(json.dumps(verdict("floaters")).encode(), "application/vnd.dg4d.gates+json"),
        "picture": store.put_bytes(b"the right picture", "image/png"),
    }
    other = result("fit_gaussians", picture=store.put_bytes(b"another picture", "image/png"))
    results = [other, result("check_asset", **kept)]
    assert acceptance.load_verdict(results, store) == verdict("floaters")
    assert acceptance.load_picture(results, store) == b"the right picture"
    assert acceptance.load_verdict([other], store) is None
    assert acceptance.load_picture([other], store) is None


def test_a_verdict_whose_file_is_gone_is_none(store: ArtifactStore) -> None:
    gone = ArtifactRef(digest="sha256:" + "0" * 64, media_type="application/vnd.dg4d.gates+json", size_bytes=1)
    assert acceptance.load_verdict([result("check_asset", gates=gone)], store) is None


BARE = {
    "item": "fox", "banner": "", "notes": [], "steps": [], "wall_s": 1.0, "compute_s": 1.0, "files": {},
    "licenses": {}, "profile": "preview", "seed": 0, "source": "fox.png", "settings": {}, "acceptance": None,
}  # fmt: skip


def test_only_gates_that_fail_give_advice() -> None:
    page = report.report_page({**BARE, "acceptance": verdict("floaters")}, b"png")
    assert page.count("try &lt;again&gt;") == 1
    assert page.count("how &lt;well&gt;") == 2
    assert "floaters failed, 1 of 2 gates passed" in page
    assert "data:image/png;base64,cG5n" in page
    accepted = report.report_page({**BARE, "acceptance": verdict()})
    assert "Accepted: all 2 gates passed." in accepted
    assert "again" not in accepted and "<img" not in accepted


def test_the_report_has_a_section_on_gates_only_where_there_is_a_verdict() -> None:
    assert "<h2>Acceptance" in report.report_page({**BARE, "acceptance": verdict()})
    assert "<h2>Acceptance" not in report.report_page(BARE)


def test_markdown_has_a_row_per_gate() -> None:
    lines = acceptance.markdown(verdict("fidelity"))
    assert [line.split(" | ")[0] for line in lines if "dB" in line] == ["| **failed**", "| passed"]


@pytest.mark.parametrize(
    ("least", "most", "text"),
    [(1.0, None, "at least 1 dB"), (None, 0.02, "at most 0.02 dB"), (0.75, 1.25, "0.75 to 1.25 dB")],
)
def test_bounds_are_said_as_they_are(least: float | None, most: float | None, text: str) -> None:
    assert acceptance.format_bounds(gate("any", 1.0, least, most, passed=True)) == text


@pytest.mark.parametrize("content", [None, "", "{}", "[]", '{"acceptance": null}'])
def test_a_package_without_a_verdict_has_no_list_of_failing_gates(tmp_path: Path, content: str | None) -> None:
    if content is not None:
        (tmp_path / "report.json").write_text(content)
    assert acceptance.failing_gates(tmp_path) is None
    row = Row(item="a", status="done")
    assert with_verdict(row, tmp_path, strict=True) == row


def test_only_a_strict_batch_makes_a_failure_of_a_failing_gate(tmp_path: Path) -> None:
    row = Row(item="a", status="unchanged")
    bad, good = package(tmp_path / "bad", "floaters"), package(tmp_path / "good")
    lenient, strict = (with_verdict(row, bad, strict) for strict in (False, True))
    assert (lenient.status, lenient.failing) == ("unchanged", ["floaters"])
    assert (strict.status, strict.kind, strict.failing) == ("failed", NOT_ACCEPTED, ["floaters"])
    assert "floaters" in strict.message
    assert with_verdict(row, good, strict=True) == row.model_copy(update={"failing": []})


def test_the_overview_marks_what_is_not_accepted_and_links_it_all_the_same(tmp_path: Path) -> None:
    rows = [
        Row(item="fine", status="done", failing=[]),
        Row(item="old", status="done"),
        Row(item="bad", status="done", failing=["floaters", "motion"]),
        Row(item="worse", status="failed", kind=NOT_ACCEPTED, failing=["motion"]),
        Row(item="later", status="skipped"),
    ]
    Writer(tmp_path).write(rows, 1.0)
    page = (tmp_path / "index.html").read_text()
    cards = {re.search(r"<h2>(\w+)", card)[1]: card for card in page.split("<article")[1:]}  # type: ignore[index]
    assert list(cards) == ["worse", "bad", "fine", "later", "old"]
    assert "not accepted: floaters, motion" in cards["bad"]
    assert "worse/report.html" in cards["worse"]
    assert "<p>accepted" in cards["fine"]
    assert "accepted" not in cards["old"] + cards["later"]
    assert "report.html" not in cards["later"]
    assert "2 not accepted" in page
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["not_accepted"] == ["bad", "worse"]
    assert [row["failing"] for row in summary["items"]] == [[], None, ["floaters", "motion"], ["motion"], None]
