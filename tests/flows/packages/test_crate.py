"""The crate, read by rocrate, and checked against the tables of requirements of its profile."""

import hashlib
import json
import re
from collections.abc import Iterator
from email.message import Message
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pytest
from made_package import MACHINE, STEPS, WEIGHTS, made_package, record_in
from rocrate.rocrate import ROCrate
from signing import identity

from flows.packages.crate import CRATE, crate_digest, crate_text, files_in, project_url, render_crate, stated_digest

ADA = "https://orcid.org/0000-0002-1825-0097"
TIME = re.compile(r"\d{4}-\d{2}-\d{2}T\d{2}:\d{2}:\d{2}\.\d{3}\+\d{2}:\d{2}")
FORMAT = re.compile(r"\w*/\w[\w.-]*(\+\w[\w.-]*)?")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_package(tmp_path_factory.mktemp("made"), weights=WEIGHTS)


@pytest.fixture(scope="module")
def crate(folder: Path) -> ROCrate:
    return ROCrate(str(folder))


def document(folder: Path) -> Any:
    return json.loads((folder / CRATE).read_text())


def entities(folder: Path, kind: str) -> list[dict[str, Any]]:
    return [entity for entity in document(folder)["@graph"] if entity["@type"] == kind]


def references(value: Any) -> Iterator[str]:
    match value:
        case {"@id": str(name), **others} if not others:
            yield name
        case dict():
            for its in value.values():
                yield from references(its)
        case list():
            for its in value:
                yield from references(its)


def several(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


def test_another_reader_finds_every_file_with_its_content(crate: ROCrate, folder: Path) -> None:
    parts = [part for part in crate.data_entities if part.type == "File"]
    on_disk = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert {part["name"] for part in parts} == on_disk - {CRATE}
    for part in parts:
        content = (folder / part["name"]).read_bytes()
        assert part["sha256"] == hashlib.sha256(content).hexdigest()
        assert part["contentSize"] == str(len(content))
        assert "/" in part["encodingFormat"]


def test_the_package_is_what_ro_crate_and_the_profile_require(crate: ROCrate) -> None:
    root = crate.root_dataset
    assert crate.version == "1.1"
    assert root["conformsTo"].id == "https://w3id.org/ro/wfrun/process/0.5"
    assert root["conformsTo"].type == "CreativeWork"
    assert root["name"] == "red fox"
    assert "predicted" in root["description"]
    assert root["datePublished"] == "2026-11-22T10:00:04.750+00:00"
    assert {its.id for its in root["license"]} == {"#license", "#license-svd"}
    assert [action.id for action in root["mentions"]] == [f"#{i}-{step}" for i, step in enumerate(STEPS, 1)]


def test_every_step_is_an_action_with_tool_times_parameters_and_results(crate: ROCrate) -> None:
    for action in crate.root_dataset["mentions"]:
        assert action.type == "CreateAction"
        tool = action["instrument"]
        assert tool.type == "SoftwareApplication"
        assert tool["softwareVersion"] == "0.1.0+abc"
        assert tool["softwareRequirements"]["softwareVersion"] == MACHINE["packages"]
        assert action["startTime"] < action["endTime"]
        parameters = {its["name"]: its["value"] for its in action["object"] if its.type == "PropertyValue"}
        assert parameters == {"settings": '{"share":0.5,"size":256}', "seed": "3", "backend": "cpu"}
        usage = {its["name"]: its for its in action["resourceUsage"]}
        assert all(its["propertyID"] == f"urn:dg4d:{name}" for name, its in usage.items())
        assert (usage["duration_s"]["value"], usage["duration_s"]["unitCode"]) == (
            "1.25",
            "https://qudt.org/vocab/unit/SEC",
        )
        assert (usage["processor"]["value"], usage["cores"]["value"]) == ("Abacus 9", "2")
        image = action["containerImage"]
        assert (image["registry"], image["name"], image["tag"]) == ("registry.example:5000", "dg4d/cpu", "1.2")
        assert image["sha256"] == "e" * 64


def test_actions_lead_from_the_source_to_the_files_of_the_package(crate: ROCrate, folder: Path) -> None:
    actions = crate.root_dataset["mentions"]
    files = {part["name"] for part in crate.data_entities if part.type == "File"}
    given = [{its.id for its in action["object"]} for action in actions]
    results = [{its.id for its in several(action["result"])} for action in actions]
    assert f"#{record_in(folder)['source'].replace(':', '-')}" in given[0]
    for made, needed in zip(results, given[1:], strict=False):
        assert made & needed
    assert {"asset.glb", "splats/000.ply"} <= results[-1] & files


def test_weights_have_their_digest_and_license(crate: ROCrate) -> None:
    (weights,) = [its for its in crate.root_dataset["mentions"][1]["object"] if its.id.startswith("#weights-")]
    assert weights["name"] == "weights svd/unet.safetensors"
    assert weights["sha256"] == "c" * 64
    assert weights["license"]["description"] == "Some License: with terms"


def test_every_reference_leads_to_an_entity_and_every_entity_has_one_name(folder: Path) -> None:
    graph = document(folder)["@graph"]
    names = [entity["@id"] for entity in graph]
    assert len(names) == len(set(names))
    assert (
        not set(references(graph))
        - {*names, "https://w3id.org/ro/crate/1.1"}
        - {"https://w3id.org/ro/terms/workflow-run#DockerImage"}
    )


def unmet(graph: list[dict[str, Any]]) -> set[str]:
    """Recommendations of RO-Crate 1.1 and Process Run Crate 0.5 that a graph leaves open, after rocrate-validator."""
    known = {entity["@id"]: entity for entity in graph}
    root = known["./"]

    def kinds(value: Any) -> set[str]:
        return {known.get(name, {}).get("@type", "") for name in references(value)} if value else {"none"}

    rules: dict[str, list[bool]] = {
        "license": [kinds(root.get("license")) == {"CreativeWork"}],
        "author": [kinds(root.get("author")) <= {"Person", "Organization"}],
        "publisher": [kinds(root.get("publisher")) == {"Organization"}],
        "date": [bool(TIME.fullmatch(root.get("datePublished", "")))],
        "organization": [{"name", "url"} <= its.keys() for its in graph if its["@type"] == "Organization"],
        "format": [bool(FORMAT.fullmatch(its["encodingFormat"])) for its in graph if its["@type"] == "File"],
        "image": [{"additionalType", "registry", "name"} <= its.keys() for its in graph if "registry" in its],
    }
    tools = [entity for entity in graph if entity["@type"] == "SoftwareApplication"]
    rules |= {f"tool's {name}": [name in its for its in tools] for name in ("name", "url", "softwareVersion")}
    rules["tool's address"] = [its["@id"].startswith("http") for its in tools]
    actions = [entity for entity in graph if entity["@type"] == "CreateAction"]
    rules |= {f"action's {name}": [name in its for its in actions] for name in ("name", "description", "result")}
    rules["action's times"] = [bool(TIME.fullmatch(its[name])) for its in actions for name in ("startTime", "endTime")]
    rules["action's agent"] = [kinds(its.get("agent")) <= {"Person", "Organization"} for its in actions]
    rules["mentions"] = [its["@id"] in references(root["mentions"]) for its in actions]
    rules["object and result"] = [
        kinds([its["object"], its["result"]]) <= {"File", "Dataset", "CreativeWork", "PropertyValue"} for its in actions
    ]
    return {name for name, met in rules.items() if not all(met)}


def test_all_recommendations_are_met_where_author_and_home_page_are_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DG4D_AUTHOR", raising=False)
    monkeypatch.setattr("flows.packages.crate.project_url", lambda: "")
    assert unmet(document(made_package(tmp_path / "bare", weights=WEIGHTS))["@graph"]) == {
        *("author", "publisher", "action's agent"),  # nobody said who runs dg4d
        *("tool's url", "tool's address"),  # the installed package names no home page
    }
    monkeypatch.setenv("DG4D_AUTHOR", "Test studio <https://studio.example/about>")
    monkeypatch.setattr("flows.packages.crate.project_url", lambda: "https://dg4d.example/")
    graph = document(made_package(tmp_path / "told", weights=WEIGHTS))["@graph"]
    assert unmet(graph) == set()
    (studio,) = [entity for entity in graph if entity["@type"] == "Organization"]
    assert (studio["@id"], studio["name"]) == ("https://studio.example/about", "Test studio")


@pytest.mark.parametrize(
    ("text", "author"),
    [
        ("", None),
        (" ", None),
        ("Test studio", {"@id": "#author", "@type": "Organization", "name": "Test studio"}),
        ("Test <studio>", {"@id": "#author", "@type": "Organization", "name": "Test <studio>"}),
        (f"Ada <{ADA}>", {"@id": ADA, "@type": "Person", "name": "Ada", "url": ADA}),
    ],
)
def test_an_author_is_a_person_by_orcid_or_an_organization(
    folder: Path, text: str, author: dict[str, str] | None
) -> None:
    graph = json.loads(crate_text(record_in(folder), {}, "about", text))["@graph"]
    assert [entity for entity in graph if entity["@type"] in {"Person", "Organization"}] == ([author] if author else [])
    assert graph[1].get("author") == (author and {"@id": author["@id"]})
    assert ("publisher" in graph[1]) == (author is not None and author["@type"] == "Organization")


def test_a_home_page_is_read_from_the_metadata(monkeypatch: pytest.MonkeyPatch) -> None:
    message = Message()
    message["Project-URL"] = "Issues, https://dg4d.example/issues"
    message["Project-URL"] = "Homepage, https://dg4d.example/"
    monkeypatch.setattr("flows.packages.crate.metadata", {"dg4d": message}.__getitem__)
    assert project_url.__wrapped__() == "https://dg4d.example/"


def test_names_of_files_are_quoted_where_they_are_addresses(tmp_path: Path) -> None:
    record = record_in(made_package(tmp_path))
    record["files"]["splats/a b#1.ply"] = record["files"]["asset.glb"]
    text = crate_text(record, {}, "about")
    assert "splats/a%20b%231.ply" in {part["@id"] for part in json.loads(text)["@graph"]}
    assert "splats/a b#1.ply" in files_in(json.loads(text))


def test_equal_runs_give_equal_crates(folder: Path, tmp_path: Path) -> None:
    again = made_package(tmp_path, weights=WEIGHTS)
    assert (again / CRATE).read_bytes() == (folder / CRATE).read_bytes()


def test_a_crate_names_its_own_digest(folder: Path) -> None:
    crate = document(folder)
    assert stated_digest(crate) == crate_digest(crate)
    assert render_crate(crate) == (folder / CRATE).read_text()
    crate["@graph"][1]["name"] = "blue fox"
    assert stated_digest(crate) != crate_digest(crate)


def test_every_sha256_of_a_file_is_that_of_its_content(folder: Path) -> None:
    stated = {entity["@id"]: entity["sha256"] for entity in document(folder)["@graph"] if "sha256" in entity}
    files = {name: folder / unquote(name) for name in stated if (folder / unquote(name)).is_file()}
    assert "asset.glb" in files
    assert {name: stated[name] for name in files} == {
        name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in files.items()
    }


def test_a_crate_of_an_earlier_version_states_its_digest_in_its_descriptor(folder: Path) -> None:
    crate = document(folder)
    first, *others = crate["@graph"]
    del first["identifier"]
    crate["@graph"] = [first, *(entity for entity in others if not entity["@id"].startswith("#sha256-of-this"))]
    first["sha256"] = crate_digest(crate)
    assert stated_digest(crate) == crate_digest(crate)
    first["sha256"] = "0" * 64
    assert stated_digest(crate) != crate_digest(crate)


def test_no_field_beside_the_stated_digest_is_left_out_of_it(folder: Path) -> None:
    crate = document(folder)
    crate["@graph"][0]["sha256"] = "0" * 64
    assert stated_digest(crate) != crate_digest(crate)


def test_a_package_without_weights_says_so_and_names_no_license_of_a_model(tmp_path: Path) -> None:
    folder = made_package(tmp_path)
    (license_,) = [entity for entity in document(folder)["@graph"] if entity["@id"].startswith("#license")]
    assert "No downloaded weights were used" in license_["description"]


def test_signed_files_say_what_they_were_before_and_where_their_credentials_are(tmp_path: Path) -> None:
    plain = record_in(made_package(tmp_path / "plain"))["files"]["contact_sheet.png"]["digest"]
    with identity(tmp_path / "keys").configured():
        folder = made_package(tmp_path / "signed")
    files = {entity["name"]: entity for entity in entities(folder, "File")}
    assert plain in files["contact_sheet.png"]["description"]
    assert files["asset.glb"]["subjectOf"] == {"@id": "asset.c2pa"}
    assert files["asset.c2pa"]["encodingFormat"] == "application/c2pa"
