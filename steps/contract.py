"""Contract of a step: references, requests, results, records and exit statuses, as plain JSON. Imports no torch."""

import hashlib
import importlib
import json
import re
from collections.abc import Mapping, Sequence
from itertools import takewhile
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from dg4d_lib.errors import quoted

CONTRACT_VERSION = 1
LARGEST_SEED = 2**63 - 1  # limit of torch's generators

FailureKind = Literal["bad_input", "missing", "lost", "unreachable", "diverged", "out_of_memory", "crashed"]

EXIT_DONE = 0
EXIT_CRASHED = 1
EXIT_BAD_INPUT = 65  # the same request will fail again
EXIT_MISSING = 69
EXIT_DIVERGED = 70
EXIT_UNREACHABLE = 75
EXIT_OUT_OF_MEMORY = 137
EXIT_STATUS: dict[FailureKind, int] = {
    "bad_input": EXIT_BAD_INPUT,
    "missing": EXIT_MISSING,
    "lost": EXIT_MISSING,
    "unreachable": EXIT_UNREACHABLE,
    "diverged": EXIT_DIVERGED,
    "out_of_memory": EXIT_OUT_OF_MEMORY,
    "crashed": EXIT_CRASHED,
}

RUN_ONLY = frozenset(  # fields of a record that its digest leaves out
    ["started", "duration_s", "cpu_s", "peak_memory_mb", "flops", "run_notes", "machine"]
)

NO_LIST = {"list_type", "tuple_type"}  # errors of pydantic, as the next ones
NO_NUMBER = {
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float"), "is not a whole number"),
    **dict.fromkeys(("float_type", "float_parsing"), "is not a number"),
}
OUT_OF_RANGE = {"greater_than", "greater_than_equal", "less_than", "less_than_equal"}
NUMBERS = re.compile(r"[-+.,0-9e ]{1,60}")  # one or several, with commas

Digest = Annotated[str, StringConstraints(pattern=r"^sha256:[0-9a-f]{64}$")]


class Frozen(BaseModel):
    """Base of immutable models that refuse unknown fields."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class ArtifactRef(Frozen):
    """Reference to a file by the digest of its content, which never changes."""

    digest: Digest
    media_type: str
    size_bytes: int = Field(ge=0)


class Port(Frozen):
    """One input or output of a step."""

    media_type: str
    suffix: str = Field(description="suffix of the file while a step works on it, for example .png")
    optional: bool = False
    many: bool = Field(False, description="an input given once or more, as NAME_000, NAME_001, ...")


class StepSpec(Frozen):
    """Name, inputs, outputs and settings class of a step; its code is not imported."""

    name: str
    version: str = Field("1", description="raised when the same request should give another result")
    entry: str = Field(pattern=r"^[\w.]+:\w+$", description="module:function of the step's code")
    settings: str = Field(
        "dg4d_lib.settings:Settings", pattern=r"^[\w.]+:\w+$", description="module:class of the step's own settings"
    )
    sections: tuple[str, ...] = Field((), description="fields of PipelineSettings that the step reads, may be dotted")
    inputs: dict[str, Port]
    outputs: dict[str, Port]
    resource: Literal["cpu", "gpu"] = Field(
        "cpu", description="gpu: the step has a GPU to itself where its settings use one; cpu: it only renders on one"
    )
    timeout_s: float = Field(3600, gt=0)
    late_imports: tuple[str, ...] = Field(
        (), description="modules, or module:function that imports some, which the step needs only while it runs"
    )

    def input_port(self, name: str) -> str:
        """Return the name of an input's port; empty if there is none."""
        port, _, number = name.rpartition("_")
        if port in self.inputs and self.inputs[port].many and number.isdecimal():
            return port
        return name if name in self.inputs and not self.inputs[name].many else ""


class StepRequest(Frozen):
    """Everything that a step depends on; its digest is the cache key."""

    step: str
    version: str
    inputs: dict[str, ArtifactRef]
    settings: dict[str, Any]
    seed: int = Field(ge=0, le=LARGEST_SEED)
    weights: dict[str, Digest] = Field({}, description="digest of the weights that the settings name, by name")

    def digest(self) -> str:
        """Return the SHA-256 of the canonical JSON; it depends on neither file names nor the order of keys."""
        return digest_of({"contract": CONTRACT_VERSION, **self.model_dump(mode="json")})


class ProvenanceRecord(Frozen):
    """Record of a run, from which the outputs can be made again; the fields in `RUN_ONLY` differ between machines."""

    step: str
    code_version: str
    request_digest: Digest
    inputs: dict[str, Digest]
    outputs: dict[str, Digest]
    settings: dict[str, Any]
    seed: int
    backend: str
    weights: dict[str, Digest] = {}
    licenses: dict[str, str] = {}
    notes: tuple[str, ...] = ()
    run_notes: tuple[str, ...] = ()
    flops: dict[str, int] = Field({}, description="floating-point operations of networks, by class name")
    started: str = Field("", description="start in UTC, ISO 8601")
    duration_s: float = Field(ge=0)
    cpu_s: float = Field(0.0, ge=0, description="CPU seconds of the step's process and of its children")
    peak_memory_mb: float = Field(ge=0)
    machine: dict[str, str] = Field({}, description="environment (steps/runtime/environment_info.py)")

    def digest(self) -> str:
        """Return the SHA-256 of the record without the fields in `RUN_ONLY`."""
        return digest_of(self.model_dump(mode="json", exclude=set(RUN_ONLY)))


class StepResult(Frozen):
    """References to the outputs, and the provenance record of the run."""

    outputs: dict[str, ArtifactRef]
    provenance: ProvenanceRecord


class StepFailure(Frozen):
    """Reason of a step's failure; written in place of the result."""

    step: str
    kind: FailureKind
    message: str
    pictures: dict[str, ArtifactRef] = {}


def canonical(value: Any) -> str:
    """Return JSON with sorted keys and no spaces; refuse unknown types and numbers that are not finite."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def digest_of(value: Any) -> str:
    """Return the SHA-256 digest of the canonical JSON of a value."""
    return "sha256:" + hashlib.sha256(canonical(value).encode()).hexdigest()


def load_object(name: str) -> Any:
    """Import and return the object that "module:name" names."""
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)


def alternatives(names: Sequence[str]) -> str:
    """Return one or more names for a message, the last one after "or"."""
    return " or ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def settings_errors(error: ValidationError, given: Any = None, lookup: str = "") -> str:
    """Return the wrong fields of settings with their values and the allowed ones, for a message.

    Args:
        error: of pydantic.
        given: settings that were validated, from which kinds are recognized.
        lookup: command that shows the range of a setting whose name follows; empty if there is none.
    """
    lines, numbers = [], set()
    for each in error.errors():
        name = _setting_name(each["loc"], given)  # empty if all settings together are refused
        lines.append(_refusal(name, each) if name else _message(each))
        if name and (each["type"] in NO_NUMBER or each["type"] in OUT_OF_RANGE):
            above_lists = tuple(takewhile(lambda part: isinstance(part, str), each["loc"]))
            numbers.add(_setting_name(above_lists, given))
    if lookup and numbers:
        lines.append(f"`{lookup} {numbers.pop() if len(numbers) == 1 else 'NAME'}` shows what is allowed")
    return "; ".join(lines)


def _refusal(name: str, error: Mapping[str, Any]) -> str:
    """Return what is wrong with one setting, and what is allowed."""
    kind, value = error["type"], error["input"]
    if kind in NO_LIST:
        items = value if NUMBERS.fullmatch(str(value)) else "..."
        return f"{name} = {quoted(value)} is not a list; write for example `--set '{name}=[{items}]'`"
    if kind == "union_tag_invalid":
        known = error["ctx"]["expected_tags"].replace("'", "").split(", ")
        return f"{name}.kind = {quoted(error['ctx']['tag'])}: use {alternatives(known)}"
    if kind in NO_NUMBER:
        return f"{name} = {quoted(value)} {NO_NUMBER[kind]}"
    return f"{name} = {quoted(value)}: {_message(error)}"


def _message(error: Mapping[str, Any]) -> str:
    return str(error["msg"]).removeprefix("Value error, ")


def _setting_name(location: tuple[int | str, ...], given: Any) -> str:
    """Return a dotted name without the kinds, which pydantic names in a location after the section that has them."""
    names, kind = [], None
    for part in location:
        if part == kind:
            kind = None
            continue
        names.append(str(part))
        given = given.get(part) if isinstance(given, dict) else None
        kind = given.get("kind") if isinstance(given, dict) else None
    return ".".join(names)


def is_digest(text: str) -> bool:
    """Return True for a full SHA-256 digest."""
    return re.fullmatch(r"sha256:[0-9a-f]{64}", text) is not None
