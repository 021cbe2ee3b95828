import json
import shutil
import sys
from pathlib import Path

import c2pa
import numpy as np
import pytest
from PIL import Image
from signing import MAKERS, Identity, identity

from dg4d_lib.errors import BackendUnavailable, BadInput
from flows.packages import credentials
from flows.packages.credentials import (
    ALGORITHMIC,
    TRAINED,
    Claim,
    Signer,
    check_signature,
    configured_signer,
    sidecar_name,
)
from flows.packages.publish import file_digest

CLAIM = Claim(trained=False, about="Preview: a guess. Order sha256:1.")


@pytest.fixture(scope="module")
def company(tmp_path_factory: pytest.TempPathFactory) -> Identity:
    return identity(tmp_path_factory.mktemp("keys"))


@pytest.fixture
def signer(company: Identity) -> Signer:
    with company.configured():
        found = configured_signer()
    assert found is not None
    return found


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    path = tmp_path / "contact_sheet.png"
    Image.fromarray(np.arange(3 * 64 * 64, dtype=np.uint32).astype(np.uint8).reshape(64, 64, 3)).save(path)
    return path


def signed(signer: Signer, path: Path, claim: Claim = CLAIM) -> Path:
    _, marks = signer.sign_package(path.parent, {path.name: file_digest(path)}, claim)
    assert path.name in marks
    return path


def test_nobody_signs_without_a_key(monkeypatch: pytest.MonkeyPatch) -> None:
    assert configured_signer() is None
    monkeypatch.setattr(credentials, "import_module", None)  # nothing of signing is even looked for
    assert configured_signer() is None


@pytest.mark.parametrize("kind", MAKERS)
def test_a_picture_signed_with_any_kind_of_key_is_trusted_by_those_who_trust_the_root(
    kind: str, picture: Path, tmp_path: Path
) -> None:
    who = identity(tmp_path / kind, kind)
    with who.configured():
        signer = configured_signer()
    assert signer is not None
    assert signer.algorithm == kind
    pixels = np.asarray(Image.open(picture)).copy()
    found = check_signature(signed(signer, picture), anchors=who.root.read_text())
    assert (found.state, found.signer) == ("trusted", "Test studio, Test company")
    assert np.array_equal(np.asarray(Image.open(picture)), pixels)


def test_an_animated_webp_keeps_its_frames_when_it_is_signed(signer: Signer, company: Identity, tmp_path: Path) -> None:
    path, frames = tmp_path / "preview.webp", [Image.new("RGB", (16, 16), color) for color in ("red", "green", "blue")]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=100, loop=0, lossless=True)
    assert check_signature(signed(signer, path), anchors=company.root.read_text()).state == "trusted"
    with Image.open(path) as shown:
        assert shown.n_frames == 3
        shown.seek(2)
        shown.load()
        assert shown.info["duration"] == 100
        assert shown.convert("RGB").getpixel((0, 0)) == (0, 0, 255)
    content = bytearray(path.read_bytes())
    content[content.index(b"ANMF") + 20] ^= 4
    path.write_bytes(content)
    assert check_signature(path).state == "invalid"


def test_who_is_vouched_for_by_nobody_here_is_untrusted(signer: Signer, picture: Path, tmp_path: Path) -> None:
    assert check_signature(signed(signer, picture)).state == "untrusted"
    stranger = identity(tmp_path / "stranger")
    assert check_signature(picture, anchors=stranger.root.read_text()).state == "untrusted"


def test_who_vouches_for_himself_is_untrusted(picture: Path, tmp_path: Path) -> None:
    with identity(tmp_path / "own", own=True).configured():
        alone = configured_signer()
    assert alone is not None
    assert check_signature(signed(alone, picture)).state == "untrusted"


def test_one_flipped_bit_of_the_picture_is_noticed(signer: Signer, picture: Path) -> None:
    content = bytearray(signed(signer, picture).read_bytes())
    pixels = content.index(b"IDAT")  # what comes before holds the credentials, of which some bytes mean nothing
    places = np.random.default_rng(0).integers(pixels, len(content), 40)
    for place in (0, *places.tolist(), len(content) - 1):
        content[place] ^= 4
        picture.write_bytes(content)
        assert check_signature(picture).state == "invalid", place
        content[place] ^= 4


def test_a_file_that_cannot_carry_credentials_has_them_beside_it(
    signer: Signer, company: Identity, tmp_path: Path
) -> None:
    asset = tmp_path / "asset.glb"
    asset.write_bytes(b"mesh" * 1000)
    files, marks = signer.sign_package(tmp_path, {"asset.glb": file_digest(asset)}, CLAIM)
    assert asset.read_bytes() == b"mesh" * 1000
    assert marks == {"asset.glb": {"sidecar": "asset.c2pa"}}
    assert files["asset.c2pa"] == file_digest(tmp_path / "asset.c2pa")
    root = company.root.read_text()
    assert check_signature(asset, tmp_path / "asset.c2pa", root).state == "trusted"
    asset.write_bytes(b"mesh" * 999 + b"mash")
    found = check_signature(asset, tmp_path / "asset.c2pa", root)
    assert (found.state, found.detail) == ("invalid", "assertion.dataHash.mismatch")
    (tmp_path / "asset.c2pa").write_bytes(b"no credentials")
    assert check_signature(asset, tmp_path / "asset.c2pa", root).state == "invalid"


def test_the_two_assets_of_a_package_have_sidecars_of_different_names() -> None:
    assert sidecar_name("asset.glb") == "asset.c2pa"
    assert sidecar_name("asset.usdz") == "asset.usdz.c2pa"


def test_only_files_at_the_top_are_signed_and_their_facts_before_are_kept(signer: Signer, picture: Path) -> None:
    (picture.parent / "input").mkdir()
    inner = picture.parent / "input" / "subject.png"
    shutil.copy(picture, inner)
    (picture.parent / "asset.json").write_text("{}")
    names = ("contact_sheet.png", "input/subject.png", "asset.json")
    before = {name: file_digest(picture.parent / name) for name in names}
    after, marks = signer.sign_package(picture.parent, before, CLAIM)
    assert marks == {"contact_sheet.png": {"unsigned": before["contact_sheet.png"]}}
    assert after == {**before, "contact_sheet.png": file_digest(picture)}
    assert after != before
    assert check_signature(inner).state == "missing"


@pytest.mark.parametrize(("trained", "kind"), [(True, TRAINED), (False, ALGORITHMIC)])
def test_credentials_say_whether_a_model_made_it(signer: Signer, picture: Path, trained: bool, kind: str) -> None:
    signed(signer, picture, Claim(trained, "words"))
    with picture.open("rb") as file:
        found = json.loads(c2pa.Reader("image/png", file).json())
    (action,) = found["manifests"][found["active_manifest"]]["assertions"][-1]["data"]["actions"]
    assert action["digitalSourceType"] == kind
    assert kind.endswith("/trainedAlgorithmicMedia") == trained
    assert action["softwareAgent"]["name"] == "dg4d"
    assert action["description"] == "words"


def test_a_key_is_in_no_representation(signer: Signer, company: Identity) -> None:
    secret = company.key.read_text().splitlines()[1]
    assert secret not in repr(signer)
    assert secret.encode() in signer.key


def test_a_key_in_another_form_of_pem_signs_too(company: Identity, picture: Path, tmp_path: Path) -> None:
    from cryptography.hazmat.primitives import serialization

    key = serialization.load_pem_private_key(company.key.read_bytes(), None)
    old = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.TraditionalOpenSSL, serialization.NoEncryption()
    )
    (tmp_path / "old.pem").write_bytes(old)
    with Identity(tmp_path / "old.pem", company.chain, company.root).configured():
        signer = configured_signer()
    assert signer is not None
    assert check_signature(signed(signer, picture)).state == "untrusted"


def test_what_cannot_sign_is_refused_with_the_reason_and_without_the_key(
    company: Identity, picture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = identity(tmp_path / "other")
    (tmp_path / "broken.pem").write_text(company.key.read_text()[:80])
    cases = {
        "does not match the first certificate": Identity(other.key, company.chain, company.root),
        "one of them is something else": Identity(tmp_path / "broken.pem", company.chain, company.root),
        "without a certificate": Identity(company.key, company.key, company.root),
        "cannot be read: No such file": Identity(tmp_path / "none.pem", company.chain, company.root),
    }
    for says, who in cases.items():
        with who.configured(), pytest.raises(BadInput, match=says) as caught:
            configured_signer()
        assert company.key.read_text().splitlines()[1] not in str(caught.value)
    monkeypatch.setenv("DG4D_SIGNING_KEY", str(company.key))
    with pytest.raises(BadInput, match="go together"):
        configured_signer()
    with identity(tmp_path / "useless", usage=False).configured():
        useless = configured_signer()
    assert useless is not None
    with pytest.raises(BadInput, match="emailProtection"):
        signed(useless, picture)


def test_without_the_library_one_is_told_what_to_install(company: Identity, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "c2pa", None)
    with company.configured(), pytest.raises(BackendUnavailable, match="c2pa-python; run `make setup`"):
        configured_signer()
