from dataclasses import replace
from pathlib import Path

import pytest

from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.weights.locate import digests
from dg4d_lib.weights.lock import LockedFile, LockEntry, write_lock
from dg4d_lib.weights.registry import KNOWN
from steps.contract import StepRequest
from steps.runtime.perform import perform
from steps.runtime.weights import (
    check_unchanged,
    identities,
    license_note,
    license_of,
    open_weights,
    require_weights,
    weights_home,
    weights_in,
    without_paths,
)
from steps.store.artifact_store import ArtifactStore


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DG4D_WEIGHTS", str(tmp_path / "weights"))
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    return tmp_path / "weights"


def fill(folder: Path, content: str = "tensors") -> Path:
    folder.mkdir(parents=True)
    (folder / "model_fp16_fixrot.safetensors").write_text(content)
    return folder


def test_the_weights_lie_under_the_home_folder_unless_a_variable_says_else(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert weights_home() == home
    monkeypatch.delenv("DG4D_WEIGHTS")
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "place"))
    assert weights_home() == tmp_path / "place" / "weights"


def test_weights_are_named_by_their_knobs_at_any_depth() -> None:
    tree = {
        "prior": {"weights": "svd", "color_weight": 3.0, "kind": "weights"},
        "static": {"start": {"lgm_weights": "lgm", "weights": ""}},
        "weights": "svd",
    }
    assert list(weights_in(tree)) == ["svd", "lgm"]


def test_a_folder_loses_its_path_and_a_name_stays(tmp_path: Path, home: Path) -> None:
    folder = fill(tmp_path / "mine")
    tree = without_paths({"a": {"weights": str(folder)}, "b": {"weights": "svd"}, "c": {"weights": "me/pictures"}})
    assert tree["b"] == {"weights": "svd"}
    assert tree["c"] == {"weights": "me/pictures"}
    name = tree["a"]["weights"]
    assert str(tmp_path) not in name
    assert open_weights(name).folder == folder
    with pytest.raises(BadInput, match="no such folder"):
        without_paths({"weights": str(tmp_path / "nowhere")})


def test_opened_weights_come_with_digests_and_licenses(home: Path) -> None:
    folder = fill(home / "lgm")
    opened = open_weights("lgm")
    assert opened.folder == folder
    assert list(opened.digests) == ["lgm/model_fp16_fixrot.safetensors"]
    assert all(digest.startswith("sha256:") for digest in opened.digests.values())
    assert opened.licenses == {"lgm": str(license_of("lgm"))}


def test_a_model_card_that_was_pulled_is_the_license_of_unknown_weights(home: Path) -> None:
    assert not license_of("me/pictures").allows_commercial_use
    home.mkdir()
    locked = LockEntry(hub_id="me/pictures", revision="", license="mit", files={"a": LockedFile(sha256="", size=0)})
    write_lock(home, "me/pictures", locked)
    assert license_of("me/pictures").commercial == "yes"


def test_the_identity_follows_the_content_and_missing_weights_have_none(home: Path) -> None:
    fill(home / "lgm")
    before = identities(["lgm", "svd"])
    assert set(before) == {"lgm"}
    (home / "lgm" / "model_fp16_fixrot.safetensors").write_text("other")
    assert identities(["lgm"]) != before
    check_unchanged(identities(["lgm"]))
    with pytest.raises(BadInput, match="the weights lgm changed in between"):
        check_unchanged(before)


def test_a_request_for_other_weights_is_another_and_is_not_performed(home: Path, tmp_path: Path) -> None:
    fill(home / "lgm")
    one = StepRequest(step="draw_picture", version="1", inputs={}, settings={}, seed=0, weights=identities(["lgm"]))
    (home / "lgm" / "model_fp16_fixrot.safetensors").write_text("other")
    two = one.model_copy(update={"weights": identities(["lgm"])})
    assert one.digest() != two.digest()
    store = ArtifactStore(tmp_path / "store")
    ref = store.put_bytes(b"a newt", "text/plain")
    failure, error = perform(one.model_copy(update={"inputs": {"text": ref}}), store)
    assert isinstance(error, BadInput)
    assert "changed in between" in str(error)
    assert failure.step == "draw_picture"


def test_missing_weights_are_missing_and_not_bad_input() -> None:
    with pytest.raises(BackendUnavailable, match="`dg4d weights pull svd`"):
        open_weights("svd")


def test_all_missing_weights_are_named_at_once(home: Path) -> None:
    fill(home / "lgm")
    with pytest.raises(BackendUnavailable, match=r"svd \(about .* GB\), .*`dg4d weights pull svd some/body`"):
        require_weights(["svd", "lgm", "some/body"])
    require_weights(["lgm"])


def test_the_license_of_a_folder_is_that_of_its_card_under_its_path_and_its_stored_name(
    tmp_path: Path, home: Path
) -> None:
    folder = fill(tmp_path / "mine")
    assert license_of(str(folder)).commercial == "unverified"
    (folder / "README.md").write_text("---\nlicense: apache-2.0\n---\n")
    stored = without_paths({"weights": str(folder)})["weights"]
    assert license_of(str(folder)).commercial == license_of(stored).commercial == "yes"
    assert license_note(stored) == f"License found for {stored}: apache-2.0: commercial use is allowed."
    copy = fill(tmp_path / "stable-zero123-copy")
    (copy / "README.md").write_text("---\nlicense: mit\n---\n")
    assert license_of(str(copy)).commercial == "no"  # a copy inherits the license of the original
    part = fill(tmp_path / "stable-zero123" / "v1.diffusers")
    (part / "README.md").write_text("---\nlicense: mit\n---\n")
    stored = without_paths({"weights": str(part)})["weights"]
    assert license_of(str(part)) == license_of(stored) == license_of("stable-zero123")


def test_a_copy_with_published_files_has_the_license_of_the_original(
    tmp_path: Path, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = fill(tmp_path / "mine")
    (folder / "README.md").write_text("---\nlicense: mit\n---\n")
    (digest,) = digests(folder).values()
    original = replace(KNOWN["stable-zero123"], published={"unet/model.safetensors": digest})
    monkeypatch.setitem(KNOWN, original.name, original)
    assert license_of(str(folder)) == original.license
    locked = LockEntry(hub_id="me/mine", revision="", license="mit", files={"a": LockedFile(sha256=digest, size=0)})
    home.mkdir()
    write_lock(home, "me/mine", locked)
    assert license_of("me/mine") == original.license
