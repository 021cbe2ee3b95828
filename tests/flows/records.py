"""Results of steps and their records, as Prefect writes them."""

import json
from pathlib import Path
from typing import Any

from prefect.serializers import JSONSerializer

from steps.contract import ArtifactRef, ProvenanceRecord, StepResult


def result_with(ref: ArtifactRef, request_digest: str = "sha256:" + "0" * 64) -> StepResult:
    """Return the result of a step that made one artifact."""
    facts: dict[str, Any] = {"inputs": {}, "settings": {}, "seed": 0, "backend": "cpu", "duration_s": 0}
    record = ProvenanceRecord(
        step="s",
        code_version="1",
        request_digest=request_digest,
        outputs={"o": ref.digest},
        peak_memory_mb=0,
        **facts,
    )
    return StepResult(outputs={"o": ref}, provenance=record)


def write_record(path: Path, value: StepResult) -> None:
    """Write the record of a result."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(record_of(value))


def record_of(value: Any) -> str:
    """Return the record of a task's result."""
    serializer = JSONSerializer()
    return json.dumps({"metadata": {"serializer": serializer.model_dump()}, "result": serializer.dumps(value).decode()})
