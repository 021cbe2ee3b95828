"""JSON schema of the provenance record of a package."""

from typing import Any

from flows.inputs.conversion_job import NAMES, ConversionJob
from flows.inputs.package_record import FORMAT
from steps.contract import RUN_ONLY, ProvenanceRecord

DIALECT = "https://json-schema.org/draft/2020-12/schema"
DIGEST = {"type": "string", "pattern": "^sha256:[0-9a-f]{64}$"}
TEXT, FLAG, SIZE = {"type": "string"}, {"type": "boolean"}, {"type": "integer", "minimum": 0}
FILE_NAME = {"type": "string", "minLength": 1, "description": "path in the package, with slashes"}

Schema = dict[str, Any]


def record_schema() -> Schema:
    """Return the schema of the record that this version writes (draft 2020-12); it allows no other fields."""
    step, run = _step_schemas()
    file = _record({"digest": DIGEST, "size_bytes": SIZE})
    unsigned = _record({"unsigned": file}, "digest before the credentials were embedded")
    sidecar = _record({"sidecar": FILE_NAME}, "file that holds the credentials")
    signed = {
        "certificate": {**DIGEST, "description": "of the signer's certificate"},
        "subject": {**TEXT, "description": "of the certificate, RFC 4514"},
        "files": {"type": "object", "additionalProperties": {"anyOf": [unsigned, sidecar]}},
    }
    fields = {
        "format": {"const": FORMAT, "description": "version of this format"},
        "order": {**DIGEST, "description": "of the request: inputs, settings, seed, weights and code"},
        "item": {**TEXT, "description": "name of the asset"},
        "profile": TEXT,
        "source": {**DIGEST, "description": "of the source picture, video or text"},
        "seed": SIZE,
        "commercial_only": {**FLAG, "description": "whether weights for non-commercial use were refused"},
        "recipe": _recipe(),
        "licenses": _map(TEXT, "terms by name of the weights"),
        "package": {**DIGEST, "description": "of the package before signatures and the files beside it"},
        "artifacts": {
            "type": "object",
            "description": "source, inputs and outputs of steps, by digest",
            "propertyNames": DIGEST,
            "additionalProperties": _record({"media_type": TEXT, "size_bytes": SIZE}),
        },
        "files": {
            "type": "object",
            "description": "files of the package",
            "propertyNames": FILE_NAME,
            "additionalProperties": file,
        },
        "signatures": {"description": "empty if unsigned", "anyOf": [_record({}), _record(signed)]},
        "beside": {"type": "array", "items": FILE_NAME, "description": "files whose digests are in the RO-Crate only"},
        "steps": {"type": "array", "items": step, "description": "equal in equal runs"},
        "run": _record(
            {
                "flow_run": {**TEXT, "description": "id of the Prefect flow run; may be empty"},
                "names": _record({"source_name": TEXT, "picture_name": TEXT}, "names of the files that were given"),
                "steps": {"type": "array", "items": run, "description": "in the order of `steps` above"},
            },
            "facts of a single run",
        ),
    }
    about = "Record of a dg4d package (provenance.json): recipe, steps, and the digest of every file."
    return {"$schema": DIALECT, "title": "dg4d provenance record", **_record(fields, about)}


def _step_schemas() -> tuple[Schema, Schema]:
    """Return the schemas of a step's record and of its facts in a single run."""
    fields = ProvenanceRecord.model_json_schema(mode="serialization")["properties"]
    bare = {
        name: {key: value for key, value in field.items() if key not in ("title", "default")}
        for name, field in fields.items()
    }
    step = {name: field for name, field in bare.items() if name not in RUN_ONLY}
    run = {name: bare[name] for name in sorted(RUN_ONLY)}
    return (
        _record({"digest": {**DIGEST, "description": "of the other fields"}, **step}),
        _record({"step": TEXT, "cached": {**FLAG, "description": "whether an earlier run had made it"}, **run}),
    )


def _recipe() -> Schema:
    """Return the schema of the recipe; settings are described in docs/settings.md."""
    names = [name for name in ConversionJob.model_fields if name not in NAMES]
    return {
        "type": "object",
        "description": "all inputs that determine the package with given code",
        "properties": {name: {} for name in names}
        | {"settings": {"type": "object", "description": "see settings.md"}, "seed": SIZE},
        "required": names,
        "additionalProperties": False,
    }


def _record(fields: Schema, about: str = "") -> Schema:
    """Return the schema of an object that has exactly these fields."""
    described = {"description": about} if about else {}
    return {
        "type": "object",
        **described,
        "properties": fields,
        "required": list(fields),
        "additionalProperties": False,
    }


def _map(values: Schema, about: str) -> Schema:
    return {"type": "object", "description": about, "additionalProperties": values}
