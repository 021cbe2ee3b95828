import json
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_package import WEIGHTS, made_package, record_in
from signing import Identity, identity

from dg4d_lib.errors import BadInput
from flows.packages.crate import CRATE, OWN_DIGEST, crate_digest, render_crate
from flows.packages.publish import bytes_digest, load_verified
from flows.packages.verify import Verification, verify


@pytest.fixture
def package(tmp_path: Path) -> Path:
    return made_package(tmp_path, weights=WEIGHTS)


@pytest.fixture(scope="module")
def company(tmp_path_factory: pytest.TempPathFactory) -> Identity:
    return identity(tmp_path_factory.mktemp("keys"))


@pytest.fixture
def signed(tmp_path: Path, company: Identity) -> Path:
    with company.configured():
        return made_package(tmp_path)


def faults(verdict: Verification) -> dict[str, str]:
    return {check.name: check.state for check in verdict.checks if check.fault}


def test_a_package_as_it_was_made_is_whole(package: Path) -> None:
    verdict = verify(package)
    assert verdict.exit_code == 0
    assert list(verdict.rows()) == [("10 files", "unchanged", ""), ("4 step records", "unchanged", "")]


def test_a_changed_byte_in_any_file_is_noticed_and_the_file_named(package: Path) -> None:
    generator = np.random.default_rng(0)
    for path in sorted(path for path in package.rglob("*") if path.is_file()):
        content = path.read_bytes()
        places = {0, len(content) - 1, *generator.integers(0, len(content), 8).tolist()}
        for place in places:
            path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
            name = path.relative_to(package).as_posix()
            try:
                verdict = verify(package)
            except BadInput as error:
                assert name == "provenance.json", place  # broken JSON
                assert re.search("no valid provenance.json|provenance.json of format", str(error))
            else:
                assert faults(verdict).get(name) == "altered", (name, place)
                assert verdict.exit_code == 65
        path.write_bytes(content)
    assert verify(package).exit_code == 0


@pytest.mark.parametrize("name", ["asset.glb", "report.html", CRATE, "splats/000.ply"])
def test_a_missing_file_is_named(package: Path, name: str) -> None:
    (package / name).unlink()
    verdict = verify(package)
    assert faults(verdict)[name] == "missing"
    assert verdict.exit_code == 65


def test_a_file_that_nobody_recorded_is_named_and_no_fault(package: Path) -> None:
    (package / "mine").mkdir()
    (package / "mine" / "notes.txt").write_text("mine")
    verdict = verify(package)
    assert ("mine/notes.txt", "extra", "not in any record") in list(verdict.rows())
    assert verdict.exit_code == 0


def test_a_link_is_no_file_of_a_package(package: Path) -> None:
    content = (package / "asset.glb").read_bytes()
    (package / "asset.glb").unlink()
    (package.parent / "elsewhere").write_bytes(content)
    (package / "asset.glb").symlink_to(package.parent / "elsewhere")
    assert faults(verify(package)) == {"asset.glb": "altered"}


@pytest.mark.parametrize("name", ["asset.glb", CRATE])
def test_a_pipe_in_place_of_a_file_is_a_fault(package: Path, name: str) -> None:
    (package / name).unlink()
    os.mkfifo(package / name)
    assert faults(verify(package)) == {name: "altered"}


def with_new_crate(package: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Change the record, and the crate's digests of it, as somebody would who knows how."""
    record = record_in(package)
    change(record)
    text = json.dumps(record)
    (package / "provenance.json").write_text(text)
    crate = json.loads((package / CRATE).read_text())
    fact = bytes_digest(text.encode())
    (entity,) = [entity for entity in crate["@graph"] if entity["@id"] == "provenance.json"]
    entity |= {"sha256": fact["digest"].removeprefix("sha256:"), "contentSize": str(fact["size_bytes"])}
    (own,) = [entity for entity in crate["@graph"] if entity["@id"] == OWN_DIGEST]
    own["value"] = crate_digest(crate)
    (package / CRATE).write_text(render_crate(crate))


def test_records_that_contradict_each_other_are_named(package: Path) -> None:
    def change(record: dict[str, Any]) -> None:
        record["steps"][1]["settings"]["size"] = 512
        record["seed"] = 4
        record["package"] = "sha256:" + "0" * 64
        del record["files"]["asset.json"]

    with_new_crate(package, change)
    assert faults(verify(package)) == {
        "2. drive_video": "altered",
        "seed": "altered",
        "package": "altered",
        CRATE: "altered",
    }


@pytest.mark.parametrize("damage", [{"steps": 1}, {"recipe": None}, {"signatures": []}, {"files": {"asset.glb": 0}}])
def test_a_record_of_another_form_is_altered_and_breaks_nothing(package: Path, damage: dict[str, object]) -> None:
    with_new_crate(package, lambda record: record.update(damage))
    assert "provenance.json" in faults(verify(package))


def test_a_record_of_another_version_is_named_as_that(package: Path) -> None:
    record = json.loads((package / "provenance.json").read_text())
    (package / "provenance.json").write_text(json.dumps({**record, "format": 1}))
    with pytest.raises(BadInput, match="of format 1; this version checks format 2"):
        verify(package)


def test_a_path_that_is_no_folder_is_refused_with_what_to_give(package: Path, tmp_path: Path) -> None:
    for check in (verify, load_verified):
        with pytest.raises(BadInput, match=r"nowhere does not exist; give a folder that `dg4d make` wrote"):
            check(tmp_path / "nowhere")
        with pytest.raises(BadInput, match=rf"asset\.glb is a file; give its folder {re.escape(str(package))}$"):
            check(package / "asset.glb")


def test_a_folder_without_a_package_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="is not an asset"):
        verify(tmp_path)


def test_signatures_are_trusted_with_the_certificate_of_who_vouches(signed: Path, company: Identity) -> None:
    verdict = verify(signed, company.root)
    found = {check.name: check.state for check in verdict.checks if check.kind == "signature"}
    assert found == {"asset.glb": "trusted", "contact_sheet.png": "trusted", CRATE: "trusted"}
    assert verdict.exit_code == 0
    assert "Test studio" in str(list(verdict.rows()))


def test_signatures_without_anybody_to_trust_are_untrusted_and_no_fault(signed: Path) -> None:
    verdict = verify(signed)
    rows = [row for row in verdict.rows() if row[0] == "asset.glb"]
    assert [state for _, state, _ in rows] == ["untrusted"]
    assert verdict.exit_code == 0


def test_somebody_else_cannot_sign_in_ones_place(signed: Path, tmp_path: Path, company: Identity) -> None:
    with identity(tmp_path / "stranger").configured():
        other = made_package(tmp_path / "forged")
    verdict = verify(other, company.root)
    assert set(faults(verdict).values()) == {"invalid"}
    assert verdict.exit_code == 65


def test_a_package_that_nobody_signed_is_at_fault_where_signers_are_asked_for(package: Path, company: Identity) -> None:
    assert faults(verify(package, company.root)) == {"the package": "unsigned"}


def test_who_rewrites_the_records_cannot_rewrite_the_signature(signed: Path, company: Identity) -> None:
    with_new_crate(signed, lambda record: record["run"].update(flow_run="another"))
    assert faults(verify(signed, company.root)) == {CRATE: "invalid"}
    assert faults(verify(signed)) == {CRATE: "invalid"}


@pytest.mark.parametrize("name", ["asset.c2pa", f"{CRATE}.c2pa"])
def test_a_signature_that_was_taken_away_is_missed(signed: Path, name: str) -> None:
    (signed / name).unlink()
    assert verify(signed).exit_code == 65


def test_without_the_library_signatures_are_unchecked_and_that_is_said(
    signed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "c2pa", None)
    verdict = verify(signed)
    assert verdict.exit_code == 69
    assert any("make setup" in detail for _, state, detail in verdict.rows() if state == "unchecked")
    (signed / "asset.glb").write_bytes(b"mash")
    assert verify(signed).exit_code == 65


def test_anchors_that_are_none_are_refused(package: Path, tmp_path: Path) -> None:
    (tmp_path / "empty.pem").touch()
    for path in (tmp_path / "empty.pem", tmp_path / "none.pem"):
        with pytest.raises(BadInput, match=path.name):
            verify(package, path)


def test_a_key_that_is_configured_later_makes_another_order(tmp_path: Path, company: Identity) -> None:
    plain = record_in(made_package(tmp_path / "a"))["order"]
    with company.configured():
        signed = record_in(made_package(tmp_path / "b"))
    assert signed["order"] != plain
    assert signed["signatures"]["subject"] == "CN=Test studio,O=Test company"
    assert record_in(made_package(tmp_path / "c"))["order"] == plain


def test_no_secret_is_in_any_file_of_a_package(signed: Path, company: Identity) -> None:
    secret = company.key.read_bytes().splitlines()[1]
    for path in signed.rglob("*"):
        if path.is_file():
            content = path.read_bytes()
            assert secret not in content
            assert str(company.key).encode() not in content
