"""Result records of steps in Prefect's format, checked before Prefect decodes them; imports no Prefect.

A record names the serializer and the classes that decode it, and Prefect imports both. Records are exchanged through
shared stores, so only those are read that Prefect's JSON serializer wrote and that hold the result of a step.
"""

import json
import re
from importlib.metadata import version
from pathlib import Path
from typing import Any

from steps.contract import StepRequest, StepResult
from steps.store.artifact_store import ArtifactStore
from steps.store.files import write_atomically

RESULT_CLASS = re.compile(r"(flows\.step_calls|flows\.tasks|steps\.contract)\.[A-Z][A-Za-z]*")
DECODED = {"__class__", "__exc_type__"}  # keys by which Prefect's decoder imports a class
SERIALIZER = {  # of Prefect's `JSONSerializer`
    "type": "json",
    "jsonlib": "json",
    "object_encoder": "prefect.serializers.prefect_json_object_encoder",
    "object_decoder": "prefect.serializers.prefect_json_object_decoder",
    "dumps_kwargs": {},
    "loads_kwargs": {},
}


def record_key(request: StepRequest) -> str:
    """Return the name of the record of a request's result."""
    return f"{request.step}-{request.digest().removeprefix('sha256:')}"


def parse_record(text: str) -> StepResult | None:
    """Return the result in a record; None where it is unreadable, or would have Prefect import anything else."""
    try:
        record = json.loads(text)
        content = json.loads(record["result"])
        expected = record["metadata"]["serializer"] == SERIALIZER and RESULT_CLASS.fullmatch(content["__class__"])
        if not expected or content.keys() != {"__class__", "data"} or _names_a_class(content["data"]):
            return None
        return StepResult.model_validate(content["data"])
    except (ValueError, KeyError, TypeError, RecursionError):  # pydantic's is a ValueError
        return None


def read_record(path: Path) -> StepResult | None:
    """Return the result in the file of a record; None where there is none, or `parse_record` refuses it."""
    try:
        return parse_record(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def recorded(path: Path, store: ArtifactStore) -> StepResult | None:
    """Return the result in a record, if all its artifacts are in the store and intact; else None.

    Raises:
        StoreUnreachable: the store does not answer.
    """
    result = read_record(path)
    return result if result and all(store.is_sound(ref) for ref in result.outputs.values()) else None


def write_record(path: Path, result: StepResult) -> None:
    """Write the record of a result as Prefect writes it, so that runs with and without a server share their steps."""
    content = {
        "__class__": f"{type(result).__module__}.{type(result).__qualname__}",
        "data": result.model_dump(mode="json"),
    }
    metadata = {
        "storage_key": str(path.absolute()),
        "expiration": None,
        "serializer": SERIALIZER,
        "prefect_version": version("prefect"),
        "storage_block_id": None,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, json.dumps({"metadata": metadata, "result": json.dumps(content)}))


def _names_a_class(value: Any) -> bool:
    """Return true if a value contains an object that Prefect's decoder would turn into an instance."""
    if isinstance(value, dict):
        return not DECODED.isdisjoint(value) or any(map(_names_a_class, value.values()))
    return isinstance(value, list) and any(map(_names_a_class, value))
