"""Result records of steps as Prefect stores them, checked before Prefect decodes them.

A record names the serializer and the classes that decode it, and Prefect imports both. Records are exchanged through
shared stores, so only those are read that Prefect's JSON serializer wrote and that hold the result of a step.
"""

import json
import re
from pathlib import Path
from typing import Any

from prefect.serializers import JSONSerializer

from steps.contract import StepRequest, StepResult

RESULT_CLASS = re.compile(r"(flows\.tasks|steps\.contract)\.[A-Z][A-Za-z]*")
DECODED = {"__class__", "__exc_type__"}  # keys by which Prefect's decoder imports a class
SERIALIZER = JSONSerializer().model_dump()


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


def _names_a_class(value: Any) -> bool:
    """Return true if a value contains an object that Prefect's decoder would turn into an instance."""
    if isinstance(value, dict):
        return not DECODED.isdisjoint(value) or any(map(_names_a_class, value.values()))
    return isinstance(value, list) and any(map(_names_a_class, value))
