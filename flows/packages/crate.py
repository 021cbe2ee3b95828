"""The RO-Crate of a package: what was made from what, how, when and by which machine, for other people's tools.

It follows Process Run Crate 0.5 of the family Workflow Run RO-Crate (https://w3id.org/ro/wfrun/process/0.5) on top of
RO-Crate 1.1: every step is an action with the tool, its inputs, settings and outputs. It names every other file of the
package with its digest, and itself with the digest of the rest of it, so that any changed byte can be told.
"""

import json
from collections.abc import Iterable, Iterator, Mapping
from datetime import datetime, timedelta
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import quote

from flows.inputs.package_record import RECORD
from flows.packages.publish import Files
from steps.contract import canonical, digest_of
from steps.runtime.environment_info import installed_distributions

CRATE = "ro-crate-metadata.json"
PROFILE = "https://w3id.org/ro/wfrun/process/0.5"
SPECIFICATION = "https://w3id.org/ro/crate/1.1"
CONTEXT = [f"{SPECIFICATION}/context", "https://w3id.org/ro/terms/workflow-run/context"]
COMPLETED = "http://schema.org/CompletedActionStatus"
DOCKER_IMAGE = "https://w3id.org/ro/terms/workflow-run#DockerImage"
USAGE = {"duration_s": "https://qudt.org/vocab/unit/SEC", "peak_memory_mb": "https://qudt.org/vocab/unit/MebiBYTE"}
QUANTITIES = "urn:dg4d:"  # followed by the name of what was measured
MEDIA_TYPES = {
    ".c2pa": "application/c2pa",
    ".glb": "model/gltf-binary",
    ".html": "text/html",
    ".json": "application/json",
    ".mp4": "video/mp4",
    ".png": "image/png",
    ".usdz": "model/vnd.usdz+zip",
    ".webm": "video/webm",
    ".webp": "image/webp",
}

Entity = dict[str, Any]


def crate_text(record: Mapping[str, Any], beside: Files, about: str) -> str:
    """The crate of a package as JSON-LD; equal arguments give equal text.

    Args:
        record: the provenance.
        beside: the facts of the other files that go with the package, the record's own included.
        about: a sentence on the asset.
    """
    entities = _entities(record, beside, about)
    graph = list({entity["@id"]: _plain(entity) for entity in entities}.values())
    document = {"@context": CONTEXT, "@graph": graph}
    graph[0]["sha256"] = own_digest(document)
    return rendered(document)


def rendered(document: Mapping[str, Any]) -> str:
    """The one way in which a crate is written."""
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"


def own_digest(document: Mapping[str, Any]) -> str:
    """The sha256 of a crate without the place where it says it, as 64 digits."""
    first, *others = document["@graph"]
    bare = {name: value for name, value in first.items() if name != "sha256"}
    return digest_of({**document, "@graph": [bare, *others]}).removeprefix("sha256:")


def files_in(document: Mapping[str, Any]) -> dict[str, tuple[str, int]]:
    """The digest and the size of every file that a crate names."""
    files = (entity for entity in document["@graph"] if entity["@type"] == "File")
    return {entity["name"]: (f"sha256:{entity['sha256']}", int(entity["contentSize"])) for entity in files}


def _entities(record: Mapping[str, Any], beside: Files, about: str) -> Iterator[Entity]:
    """The descriptor first, then the package; an entity may come more than once."""
    files = {**record["files"], **beside}
    runs = list(zip(record["steps"], record["run"]["steps"], strict=True))
    names = _names(record)
    actions = [_reference(_action_id(number, step)) for number, step in enumerate(record["steps"], 1)]
    yield {
        "@id": CRATE,
        "@type": "CreativeWork",
        "conformsTo": _reference(SPECIFICATION),
        "about": _reference("./"),
    }
    yield {
        "@id": "./",
        "@type": "Dataset",
        "conformsTo": _reference(PROFILE),
        "identifier": record["order"],
        "name": record["item"],
        "description": about,
        "datePublished": max((_end(run) for _, run in runs if run["started"]), default=""),
        "license": [_reference(name) for name in ("#license", *map(_license_id, record["licenses"]))],
        "hasPart": [_reference(quote(name)) for name in files],
        "mentions": actions,
    }
    yield {"@id": PROFILE, "@type": "CreativeWork", "name": "Process Run Crate", "version": "0.5"}
    yield {
        "@id": "#license",
        "@type": "CreativeWork",
        "name": "The rights in the source",
        "description": "Whoever holds the rights in the source says what may be done with the asset. "
        + ("The licenses of the weights that were used follow it." if record["licenses"] else "No weights were used."),
    }
    for name, terms in record["licenses"].items():
        yield {"@id": _license_id(name), "@type": "CreativeWork", "name": f"License of {name}", "description": terms}
    for name, fact in files.items():
        yield _file(name, fact, record)
    for digest in sorted({digest for step in record["steps"] for digest in _digests(step)} - set(names)):
        yield _artifact(digest, record)
    for number, (step, run) in enumerate(runs, 1):
        yield from _action(number, step, run, names, record)


def _plain(entity: Entity) -> Entity:
    """Without what is empty, and a list of one as the one: so RO-Crate wants it."""
    single = {
        name: value[0] if isinstance(value, list) and len(value) == 1 else value for name, value in entity.items()
    }
    return {name: value for name, value in single.items() if value not in ("", [])}


def _names(record: Mapping[str, Any]) -> dict[str, str]:
    """The file of the package that has a digest, or had it before it was signed."""
    names = {fact["digest"]: quote(name) for name, fact in record["files"].items()}
    for name, how in record["signatures"].get("files", {}).items():
        if "unsigned" in how:
            names[how["unsigned"]["digest"]] = quote(name)
    return names


def _file(name: str, fact: Mapping[str, Any], record: Mapping[str, Any]) -> Entity:
    entity = {
        "@id": quote(name),
        "@type": "File",
        "name": name,
        "encodingFormat": MEDIA_TYPES.get(PurePosixPath(name).suffix, "application/octet-stream"),
        "contentSize": str(fact["size_bytes"]),
        "sha256": fact["digest"].removeprefix("sha256:"),
    }
    how = record["signatures"].get("files", {}).get(name, {})
    if "unsigned" in how:
        entity["description"] = f"holds content credentials; before it was signed: {how['unsigned']['digest']}"
    if "sidecar" in how:
        entity["subjectOf"] = _reference(quote(how["sidecar"]))
    if name == RECORD:
        entity["description"] = "the record of every step and the recipe of the whole"
    return entity


def _artifact(digest: str, record: Mapping[str, Any]) -> Entity:
    """Something that steps read or wrote and that is no file of the package."""
    fact = record["artifacts"].get(digest, {"media_type": "", "size_bytes": ""})
    return {
        "@id": _artifact_id(digest),
        "@type": "CreativeWork",
        "name": "the source" if digest == record["source"] else "between steps",
        "encodingFormat": fact["media_type"],
        "contentSize": str(fact["size_bytes"]),
        "sha256": digest.removeprefix("sha256:"),
    }


def _action(
    number: int, step: Mapping[str, Any], run: Mapping[str, Any], names: Mapping[str, str], record: Mapping[str, Any]
) -> Iterator[Entity]:
    """One step, with its tool, its parameters, the weights and the machine."""

    def things(digests: Iterable[str]) -> list[Entity]:
        return [_reference(names.get(digest, _artifact_id(digest))) for digest in digests]

    own = _action_id(number, step)
    tool = f"#{step['step']}-{step['code_version']}"
    machine = run["machine"]
    parameters = {"settings": canonical(step["settings"]), "seed": str(step["seed"]), "backend": step["backend"]}
    results = things(step["outputs"].values())
    if record["package"] in step["outputs"].values():
        results += [_reference(quote(name)) for name in record["files"]]
    facts = [name for name in machine if name not in ("packages", "image")]
    action = {
        "@id": own,
        "@type": "CreateAction",
        "name": run["step"],
        "description": " ".join([f"Request {step['request_digest']}.", *step["notes"], *run["run_notes"]]),
        "instrument": _reference(tool),
        "object": [
            *things(step["inputs"].values()),
            *(_reference(f"{own}-{name}") for name in parameters),
            *(_reference(_weights_id(digest)) for digest in step["weights"].values()),
        ],
        "result": results,
        "resourceUsage": [
            *(_reference(f"{own}-{name}") for name in USAGE),
            *(_reference(_machine_id(machine, name)) for name in facts),
        ],
        "actionStatus": COMPLETED,
    }
    if run["started"]:
        action |= {"startTime": run["started"], "endTime": _end(run)}
    requirements = []
    if "packages" in machine:
        requirements = [_reference(_packages_id(machine))]
        yield _packages(machine)
    if "image" in machine:
        action["containerImage"] = _reference(_image_id(machine))
        yield _image(machine)
    yield action
    yield {
        "@id": tool,
        "@type": "SoftwareApplication",
        "name": f"dg4d {step['step']}",
        "softwareVersion": step["code_version"],
        "softwareRequirements": requirements,
    }
    for name, value in parameters.items():
        yield {"@id": f"{own}-{name}", "@type": "PropertyValue", "name": name, "value": value}
    for name, unit in USAGE.items():
        yield {
            "@id": f"{own}-{name}",
            "@type": "PropertyValue",
            "name": name,
            "propertyID": f"{QUANTITIES}{name}",
            "unitCode": unit,
            "value": str(run[name]),
        }
    for name in facts:
        yield {
            "@id": _machine_id(machine, name),
            "@type": "PropertyValue",
            "name": name,
            "propertyID": f"{QUANTITIES}{name}",
            "value": machine[name],
        }
    for name, digest in step["weights"].items():
        yield {
            "@id": _weights_id(digest),
            "@type": "CreativeWork",
            "name": f"weights {name}",
            "sha256": digest.removeprefix("sha256:"),
            "license": [_reference(_license_id(of)) for of in step["licenses"] if name.startswith(f"{of}/")],
        }


def _packages(machine: Mapping[str, str]) -> Entity:
    """The lock: what was installed, listed where this is the same machine or one set up equally."""
    entity = {
        "@id": _packages_id(machine),
        "@type": "SoftwareApplication",
        "name": "installed Python distributions",
        "softwareVersion": machine["packages"],
    }
    if machine["packages"] == digest_of(installed_distributions()):
        entity["description"] = " ".join(installed_distributions())
    return entity


def _image(machine: Mapping[str, str]) -> Entity:
    """A container image, called [REGISTRY/]NAME[:TAG][@sha256:DIGEST]."""
    name, _, digest = machine["image"].partition("@sha256:")
    registry, slash, rest = name.partition("/")
    if not slash or not set(registry) & set(".:"):
        registry, rest = "docker.io", name
    path, _, tag = rest.partition(":")
    return {
        "@id": _image_id(machine),
        "@type": "ContainerImage",
        "additionalType": _reference(DOCKER_IMAGE),
        "registry": registry,
        "name": path,
        "tag": tag,
        "sha256": digest,
    }


def _digests(step: Mapping[str, Any]) -> list[str]:
    return [*step["inputs"].values(), *step["outputs"].values()]


def _end(run: Mapping[str, Any]) -> str:
    end = datetime.fromisoformat(run["started"]) + timedelta(seconds=run["duration_s"])
    return end.isoformat(timespec="milliseconds")


def _reference(name: str) -> Entity:
    return {"@id": name}


def _action_id(number: int, step: Mapping[str, Any]) -> str:
    return f"#{number}-{step['step']}"


def _artifact_id(digest: str) -> str:
    return f"#{digest.replace(':', '-')}"


def _weights_id(digest: str) -> str:
    return f"#weights-{digest.removeprefix('sha256:')}"


def _license_id(name: str) -> str:
    return f"#license-{quote(name, safe='')}"


def _machine_id(machine: Mapping[str, str], fact: str) -> str:
    return f"#machine-{digest_of(dict(machine)).removeprefix('sha256:')[:12]}-{fact}"


def _packages_id(machine: Mapping[str, str]) -> str:
    return f"#packages-{machine['packages'].removeprefix('sha256:')[:12]}"


def _image_id(machine: Mapping[str, str]) -> str:
    return f"#image-{digest_of(machine['image']).removeprefix('sha256:')[:12]}"
