"""RO-Crate of a package: its provenance in a standard format.

The profile is Process Run Crate 0.5 (https://w3id.org/ro/wfrun/process/0.5) on top of RO-Crate 1.1: every step is an
action with its tool, inputs, settings and outputs. The crate lists every other file of the package with its digest, and
the digest of the rest of itself, so that any changed byte is detected. Author and agent are whom `$DG4D_AUTHOR` names.
"""

import functools
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from datetime import datetime, timedelta
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import quote

from flows.inputs.package_record import RECORD
from flows.packages.publish import Files
from steps.contract import canonical, digest_of
from steps.runtime.environment_info import installed_distributions

AUTHOR = "DG4D_AUTHOR"  # environment variable: NAME <URL>
ORCID = "https://orcid.org/"  # of persons; other addresses are of organizations
PACKAGE_INDEX = "https://pypi.org/"
CRATE = "ro-crate-metadata.json"
OWN_DIGEST = "#sha256-of-this-document"
PROFILE = "https://w3id.org/ro/wfrun/process/0.5"
SPECIFICATION = "https://w3id.org/ro/crate/1.1"
CONTEXT = [f"{SPECIFICATION}/context", "https://w3id.org/ro/terms/workflow-run/context"]
COMPLETED = "http://schema.org/CompletedActionStatus"
DOCKER_IMAGE = "https://w3id.org/ro/terms/workflow-run#DockerImage"
USAGE = {"duration_s": "https://qudt.org/vocab/unit/SEC", "peak_memory_mb": "https://qudt.org/vocab/unit/MebiBYTE"}
QUANTITIES = "urn:dg4d:"  # followed by the name of the quantity
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


def crate_text(record: Mapping[str, Any], beside: Files, about: str, author: str = "") -> str:
    """Return the crate of a package as JSON-LD; equal arguments give equal text.

    Args:
        record: provenance.
        beside: digests of the files beside the package, including the record.
        about: description of the asset.
        author: person with an ORCID, or organization, that made it, as "NAME <URL>" or "NAME"; "" if unknown.
    """
    entities = _entities(record, beside, about, _author(author))
    graph = list({entity["@id"]: _without_empty(entity) for entity in entities}.values())
    document = {"@context": CONTEXT, "@graph": graph}
    _stated(document)[0]["value"] = crate_digest(document)
    return render_crate(document)


def render_crate(document: Mapping[str, Any]) -> str:
    """Serialize a crate in its canonical form."""
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"


def crate_digest(document: Mapping[str, Any]) -> str:
    """Return the sha256 of a crate without the digest that it states itself, as 64 digits."""
    place, key = _stated(document)
    bare = {name: value for name, value in place.items() if name != key}
    graph = [bare if entity is place else entity for entity in document["@graph"]]
    return digest_of({**document, "@graph": graph}).removeprefix("sha256:")


def stated_digest(document: Mapping[str, Any]) -> str:
    """Return the digest that a crate states of itself, as 64 digits.

    Raises:
        LookupError: it states none.
    """
    place, key = _stated(document)
    return str(place[key])


def _stated(document: Mapping[str, Any]) -> tuple[Entity, str]:
    """Return the entity and the field of a crate's own digest: `sha256` of the descriptor before November 2026."""
    graph = document["@graph"]
    return next(((entity, "value") for entity in graph if entity["@id"] == OWN_DIGEST), (graph[0], "sha256"))


def files_in(document: Mapping[str, Any]) -> dict[str, tuple[str, int]]:
    """Return digest and size of every file that a crate lists."""
    files = (entity for entity in document["@graph"] if entity["@type"] == "File")
    return {entity["name"]: (f"sha256:{entity['sha256']}", int(entity["contentSize"])) for entity in files}


def _entities(record: Mapping[str, Any], beside: Files, about: str, authors: list[Entity]) -> Iterator[Entity]:
    """Yield the descriptor with an empty digest, the package, then the rest; an entity may come more than once."""
    files = {**record["files"], **beside}
    runs = list(zip(record["steps"], record["run"]["steps"], strict=True))
    names = _ids_by_digest(record)
    digests = {digest for step in record["steps"] for ports in ("inputs", "outputs") for digest in step[ports].values()}
    actions = [_reference(_action_id(number, step)) for number, step in enumerate(record["steps"], 1)]
    yield {
        "@id": CRATE,
        "@type": "CreativeWork",
        "conformsTo": _reference(SPECIFICATION),
        "about": _reference("./"),
        "identifier": _reference(OWN_DIGEST),
    }
    yield {
        "@id": "./",
        "@type": "Dataset",
        "conformsTo": _reference(PROFILE),
        "identifier": record["order"],
        "name": record["item"],
        "description": about,
        "author": _references(authors),
        "publisher": _references([author for author in authors if author["@type"] == "Organization"]),
        "datePublished": max((_end(run) for _, run in runs if run["started"]), default=""),
        "license": [_reference(name) for name in ("#license", *map(_license_id, record["licenses"]))],
        "hasPart": [_reference(quote(name)) for name in files],
        "mentions": actions,
    }
    yield from authors
    yield _property(OWN_DIGEST, "SHA-256 of this document without this value, in canonical JSON", "")
    yield {"@id": PROFILE, "@type": "CreativeWork", "name": "Process Run Crate", "version": "0.5"}
    yield {
        "@id": "#license",
        "@type": "CreativeWork",
        "name": "Rights in the source",
        "description": "The holder of the rights in the source decides on the use of the asset. "
        + ("The licenses of the weights apply as well." if record["licenses"] else "No downloaded weights were used."),
    }
    for name, terms in record["licenses"].items():
        yield {"@id": _license_id(name), "@type": "CreativeWork", "name": f"License of {name}", "description": terms}
    for name, fact in files.items():
        yield _file(name, fact, record)
    for digest in sorted(digests - set(names)):
        yield _artifact(digest, record)
    for number, (step, run) in enumerate(runs, 1):
        yield from _action(number, step, run, names, record, authors)


def _without_empty(entity: Entity) -> Entity:
    """Remove empty values and unwrap lists of one, as RO-Crate requires."""
    single = {
        name: value[0] if isinstance(value, list) and len(value) == 1 else value for name, value in entity.items()
    }
    return {name: value for name, value in single.items() if value not in ("", [])}


def _ids_by_digest(record: Mapping[str, Any]) -> dict[str, str]:
    """Return the id of the file with a digest; of a signed file also by the digest before signing."""
    names = {fact["digest"]: quote(name) for name, fact in record["files"].items()}
    for name, how in record["signatures"].get("files", {}).items():
        if "unsigned" in how:
            names[how["unsigned"]["digest"]] = quote(name)
    return names


def _file(name: str, fact: Mapping[str, Any], record: Mapping[str, Any]) -> Entity:
    entity: Entity = {
        "@id": quote(name),
        "@type": "File",
        "name": name,
        "encodingFormat": MEDIA_TYPES.get(PurePosixPath(name).suffix, "application/octet-stream"),
        "contentSize": str(fact["size_bytes"]),
        "sha256": _digits(fact["digest"]),
    }
    how = record["signatures"].get("files", {}).get(name, {})
    if "unsigned" in how:
        entity["description"] = f"with content credentials; digest before signing: {how['unsigned']['digest']}"
    if "sidecar" in how:
        entity["subjectOf"] = _reference(quote(how["sidecar"]))
    if name == RECORD:
        entity["description"] = "records of all steps, and the recipe of the package"
    return entity


def _artifact(digest: str, record: Mapping[str, Any]) -> Entity:
    """Describe an input or output of steps that is not a file of the package."""
    fact = record["artifacts"].get(digest, {"media_type": "", "size_bytes": ""})
    return {
        "@id": _artifact_id(digest),
        "@type": "CreativeWork",
        "name": "source" if digest == record["source"] else "intermediate artifact",
        "encodingFormat": fact["media_type"],
        "contentSize": str(fact["size_bytes"]),
        "sha256": _digits(digest),
    }


def _action(
    number: int,
    step: Mapping[str, Any],
    run: Mapping[str, Any],
    names: Mapping[str, str],
    record: Mapping[str, Any],
    agents: list[Entity],
) -> Iterator[Entity]:
    """Describe a step with its tool, parameters, weights and machine."""

    def artifacts(digests: Iterable[str]) -> list[Entity]:
        return [_reference(names.get(digest, _artifact_id(digest))) for digest in digests]

    own = _action_id(number, step)
    machine = run["machine"]
    settings = {"settings": canonical(step["settings"]), "seed": str(step["seed"]), "backend": step["backend"]}
    parameters = [_property(f"{own}-{name}", name, value) for name, value in settings.items()]
    usage = [
        _property(f"{own}-{name}", name, str(run[name]), propertyID=f"{QUANTITIES}{name}", unitCode=unit)
        for name, unit in USAGE.items()
    ]
    machine_id = f"#machine-{_short(digest_of(dict(machine)))}"
    facts = [
        _property(f"{machine_id}-{name}", name, value, propertyID=f"{QUANTITIES}{name}")
        for name, value in machine.items()
        if name not in ("packages", "image")
    ]
    weights = [
        {
            "@id": f"#weights-{_digits(digest)}",
            "@type": "CreativeWork",
            "name": f"weights {name}",
            "sha256": _digits(digest),
            "license": [_reference(_license_id(of)) for of in step["licenses"] if name.startswith(f"{of}/")],
        }
        for name, digest in step["weights"].items()
    ]
    requirements: list[Entity] = [_packages(machine)] if "packages" in machine else []
    images = [_image(machine["image"])] if "image" in machine else []
    tool = {
        "@id": f"{project_url()}#{step['step']}-{step['code_version']}",
        "@type": "SoftwareApplication",
        "name": f"dg4d {step['step']}",
        "url": project_url(),
        "softwareVersion": step["code_version"],
        "softwareRequirements": _references(requirements),
    }
    results = artifacts(step["outputs"].values())
    if record["package"] in step["outputs"].values():
        results += [_reference(quote(name)) for name in record["files"]]
    action = {
        "@id": own,
        "@type": "CreateAction",
        "name": run["step"],
        "description": " ".join([f"Request {step['request_digest']}.", *step["notes"], *run["run_notes"]]),
        "agent": _references(agents),
        "instrument": _reference(tool["@id"]),
        "object": [*artifacts(step["inputs"].values()), *_references(parameters), *_references(weights)],
        "result": results,
        "resourceUsage": _references([*usage, *facts]),
        "actionStatus": COMPLETED,
        "startTime": run["started"],
        "endTime": _end(run) if run["started"] else "",
        "containerImage": _references(images),
    }
    yield from (*requirements, *images, action, tool, *parameters, *usage, *facts, *weights)


def _author(text: str) -> list[Entity]:
    """Describe an author, NAME <URL> or NAME; nothing for an empty text."""
    found = re.fullmatch(r"(.*\S)\s*<(https?://[^\s<>]+)>", text.strip())
    name, url = (found[1], found[2]) if found else (text.strip(), "")
    if not name:
        return []
    kind = "Person" if url.startswith(ORCID) else "Organization"
    return [{"@id": url or "#author", "@type": kind, "name": name, "url": url}]


@functools.cache
def project_url() -> str:
    """Return the home page in the metadata of the installed package; "" if it names none."""
    try:
        entries = metadata("dg4d").get_all("Project-URL") or []
    except PackageNotFoundError:
        return ""
    urls = dict(entry.split(", ", 1) for entry in entries)
    return urls.get("Homepage") or next(iter(urls.values()), "")


def _property(own: str, name: str, value: str, **more: str) -> Entity:
    return {"@id": own, "@type": "PropertyValue", "name": name, **more, "value": value}


def _packages(machine: Mapping[str, str]) -> Entity:
    """Describe the installed distributions; list them if they equal those of this machine."""
    entity = {
        "@id": f"{PACKAGE_INDEX}#packages-{_short(machine['packages'])}",
        "@type": "SoftwareApplication",
        "name": "installed Python distributions",
        "url": PACKAGE_INDEX,
        "softwareVersion": machine["packages"],
    }
    if machine["packages"] == digest_of(installed_distributions()):
        entity["description"] = " ".join(installed_distributions())
    return entity


def _image(image: str) -> Entity:
    """Describe a container image, [REGISTRY/]NAME[:TAG][@sha256:DIGEST]."""
    name, _, digest = image.partition("@sha256:")
    registry, slash, rest = name.partition("/")
    if not slash or not set(registry) & set(".:"):
        registry, rest = "docker.io", name
    path, _, tag = rest.partition(":")
    return {
        "@id": f"#image-{_short(digest_of(image))}",
        "@type": "ContainerImage",
        "additionalType": _reference(DOCKER_IMAGE),
        "registry": registry,
        "name": path,
        "tag": tag,
        "sha256": digest,
    }


def _end(run: Mapping[str, Any]) -> str:
    end = datetime.fromisoformat(run["started"]) + timedelta(seconds=run["duration_s"])
    return end.isoformat(timespec="milliseconds")


def _reference(name: str) -> Entity:
    return {"@id": name}


def _references(entities: list[Entity]) -> list[Entity]:
    return [_reference(entity["@id"]) for entity in entities]


def _action_id(number: int, step: Mapping[str, Any]) -> str:
    return f"#{number}-{step['step']}"


def _artifact_id(digest: str) -> str:
    return f"#{digest.replace(':', '-')}"


def _license_id(name: str) -> str:
    return f"#license-{quote(name, safe='')}"


def _digits(digest: str) -> str:
    return digest.removeprefix("sha256:")


def _short(digest: str) -> str:
    return _digits(digest)[:12]
