import hashlib
import json
import os
import shutil
from pathlib import Path

import pytest

from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.weights import locate
from dg4d_lib.weights.locate import content_name, digests, find_problems, find_weights, identity
from dg4d_lib.weights.lock import LOCK, LockedFile, LockEntry, read_lock, write_lock
from dg4d_lib.weights.registry import KNOWN

PARTS = KNOWN["svd"].parts


@pytest.fixture
def home(tmp_path: Path) -> Path:
    return tmp_path / "weights"


@pytest.fixture(autouse=True)
def no_hub_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    return tmp_path / "hub"


def fill(folder: Path, parts: tuple[str, ...] = PARTS) -> Path:
    for part in parts:
        (folder / part).mkdir(parents=True)
        if part == "scheduler":
            (folder / part / "scheduler_config.json").write_text("{}")
        else:
            (folder / part / "config.json").write_text("{}")
            (folder / part / "diffusion_pytorch_model.safetensors").write_bytes(part.encode())
    return folder


def locked(folder: Path) -> LockEntry:
    files = {
        name: LockedFile(sha256=digest, size=(folder / name).stat().st_size) for name, digest in digests(folder).items()
    }
    return LockEntry(hub_id=KNOWN["svd"].hub_id, revision="c" * 40, files=files)


def pulled(home: Path) -> Path:
    folder = fill(home / "svd")
    write_lock(home, "svd", locked(folder))
    return folder


def test_a_folder_and_a_file_are_taken_as_they_are(tmp_path: Path) -> None:
    folder = tmp_path / "anything"
    folder.mkdir()
    (folder / "model.safetensors").touch()
    assert find_weights(folder) == folder
    assert find_weights(str(folder)) == folder
    assert find_weights(folder / "model.safetensors") == folder / "model.safetensors"


def test_a_relative_folder_becomes_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine").mkdir()
    assert find_weights("mine") == tmp_path / "mine"
    (tmp_path / "svd").mkdir()
    with pytest.raises(BackendUnavailable):
        find_weights("svd")  # a name of the registry means the registry's


@pytest.mark.parametrize("name", ["svd", "stabilityai/stable-video-diffusion-img2vid", "somebody/pictures"])
def test_missing_weights_name_the_command_that_gets_them(name: str, home: Path) -> None:
    with pytest.raises(BackendUnavailable, match=f"`dg4d weights pull {name}`"):
        find_weights(name, home)


@pytest.mark.parametrize("name", ["svt", "./nowhere", "/nowhere", "some/where/else", "~/nowhere"])
def test_what_can_be_neither_a_name_nor_a_folder_is_refused(name: str, home: Path) -> None:
    with pytest.raises(BadInput):
        find_weights(name, home)


def test_pulled_weights_are_found_by_name_and_by_hub_id(home: Path) -> None:
    folder = pulled(home)
    assert find_weights("svd", home) == folder
    assert find_weights(KNOWN["svd"].hub_id, home) == folder


def test_a_folder_that_was_copied_into_the_home_needs_no_lock(home: Path) -> None:
    fill(home / "svd")
    assert find_weights("svd", home) == home / "svd"
    fill(home / "somebody--pictures", ("unet",))
    assert find_weights("somebody/pictures", home) == home / "somebody--pictures"


@pytest.mark.parametrize("change", ["drop a file", "cut a file", "alter a byte", "drop a part"])
def test_damage_is_one_clear_message(change: str, home: Path) -> None:
    folder = pulled(home)
    find_weights("svd", home)  # digests are remembered now
    file = folder / "unet" / "diffusion_pytorch_model.safetensors"
    match change:
        case "drop a file":
            file.unlink()
        case "cut a file":
            file.write_bytes(b"un")
        case "alter a byte":
            file.write_bytes(b"unex")
        case "drop a part":
            (folder / "scheduler" / "scheduler_config.json").unlink()
    with pytest.raises(
        BackendUnavailable, match=r"incomplete or changed: .*`dg4d weights check svd`.*`dg4d weights pull svd`"
    ) as told:
        find_weights("svd", home)
    assert len(str(told.value).splitlines()) == 1


def test_without_a_lock_missing_parts_tensors_and_shards_are_told(tmp_path: Path) -> None:
    folder = fill(tmp_path / "svd")
    assert find_problems(folder, KNOWN["svd"]) == {}
    (folder / "unet" / "diffusion_pytorch_model.safetensors").unlink()
    assert list(find_problems(folder, KNOWN["svd"])) == ["unet"]
    index = {"weight_map": {"x": "model-00001-of-00002.safetensors", "y": "model-00002-of-00002.safetensors"}}
    (folder / "unet" / "model.safetensors.index.json").write_text(json.dumps(index))
    (folder / "unet" / "model-00001-of-00002.safetensors").touch()
    assert find_problems(folder, KNOWN["svd"]) == {"unet/model-00002-of-00002.safetensors": "is missing"}
    (folder / "unet" / "model-00002-of-00002.safetensors").touch()
    (folder / "vae").rename(folder / "vea")
    assert list(find_problems(folder, KNOWN["svd"])) == ["vae"]
    assert "has no tensors" in find_problems(tmp_path / "empty", KNOWN["lgm"])["empty"]


def test_without_a_lock_absent_folders_of_a_pipeline_are_told(tmp_path: Path) -> None:
    folder = fill(tmp_path / "imagedream", ("vae",))
    index = {"_class_name": ["mvdream", "MVDreamPipeline"], "vae": ["diffusers", "A"], "unet": ["mvdream", "B"]}
    (folder / "model_index.json").write_text(json.dumps({**index, "safety_checker": [None, None]}))
    assert find_problems(folder, KNOWN["imagedream"]) == {"unet": "is missing"}


@pytest.mark.parametrize("name", ["model_index.json", "unet/model.safetensors.index.json"])
@pytest.mark.parametrize("text", ['{"metadata": {"tot', "[]"])
def test_a_list_of_files_that_cannot_be_read_is_told(name: str, text: str, home: Path) -> None:
    folder = fill(home / "imagedream")
    (folder / name).write_text(text)
    assert find_problems(folder, KNOWN["imagedream"]) == {name: "cannot be read"}
    with pytest.raises(BackendUnavailable, match=f"{name} cannot be read; .*`dg4d weights pull imagedream`"):
        find_weights("imagedream", home)


def test_the_hub_cache_is_used_as_other_programs_left_it(no_hub_cache: Path, home: Path) -> None:
    repository = no_hub_cache / "models--stabilityai--stable-video-diffusion-img2vid"
    snapshot = fill(repository / "snapshots" / "abc")
    with pytest.raises(BackendUnavailable):
        find_weights("svd", home)
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text("abc")
    assert find_weights("svd", home) == snapshot
    assert find_weights("svd") == snapshot
    pinned = fill(repository / "snapshots" / str(KNOWN["svd"].revision))
    assert find_weights("svd", home) == pinned
    shutil.rmtree(pinned)
    (snapshot / "vae" / "diffusion_pytorch_model.safetensors").unlink()
    with pytest.raises(BackendUnavailable, match="dg4d weights pull svd"):
        find_weights("svd", home)


def test_digests_are_sha256_of_what_loading_reads(tmp_path: Path) -> None:
    folder = fill(tmp_path / "svd")
    for ignored in ("README.md", ".cache/x.json"):
        (folder / ignored).parent.mkdir(exist_ok=True)
        (folder / ignored).write_text("ignored")
    found = digests(folder)
    assert found["unet/diffusion_pytorch_model.safetensors"] == hashlib.sha256(b"unet").hexdigest()
    assert len(found) == 7  # three models of two files, and the scheduler's
    assert list(digests(folder, ("vae",))) == ["vae/config.json", "vae/diffusion_pytorch_model.safetensors"]
    file = folder / "vae" / "config.json"
    assert digests(file) == {"config.json": hashlib.sha256(b"{}").hexdigest()}


def test_an_unchanged_file_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, memory = fill(tmp_path / "svd"), tmp_path / "memory.json"
    read: list[Path] = []
    honest = locate._sha256
    monkeypatch.setattr(locate, "_sha256", lambda path: read.append(path) or honest(path))
    first = digests(folder, cache=memory)
    assert len(read) == 7
    assert digests(folder, cache=memory) == first
    assert len(read) == 7
    file = folder / "unet" / "diffusion_pytorch_model.safetensors"
    file.write_bytes(b"more than before")
    assert digests(folder, cache=memory) != first
    assert read[7:] == [file]
    os.utime(file, ns=(1, 1))
    digests(folder, cache=memory)
    assert read[8:] == [file]
    memory.write_text("not json")
    assert len(digests(folder, cache=memory)) == 7


def test_the_identity_is_of_content_and_not_of_place(tmp_path: Path) -> None:
    one, two = fill(tmp_path / "one"), fill(tmp_path / "two")
    assert identity(digests(one)) == identity(digests(two))
    (two / "vae" / "config.json").write_text("{} ")
    assert identity(digests(one)) != identity(digests(two))


def test_a_users_folder_is_called_by_its_content_wherever_it_lies(tmp_path: Path, home: Path) -> None:
    one, two = fill(tmp_path / "one" / "mine"), fill(tmp_path / "two" / "mine")
    name = content_name(one, home)
    assert name.startswith("mine@")
    assert str(tmp_path) not in name
    assert content_name(two, home) == name
    assert find_weights(name, home) == two
    assert content_name(one, home) == name
    assert find_weights(name, home) == one
    (one / "vae" / "config.json").write_text("{} ")
    assert content_name(one, home) != name


def test_a_users_folder_that_is_gone_is_asked_for_once_more(tmp_path: Path, home: Path) -> None:
    folder = fill(tmp_path / "mine")
    name = content_name(folder, home)
    folder.rename(tmp_path / "elsewhere")
    with pytest.raises(BackendUnavailable, match="give its new path"):
        find_weights(name, home)


def test_a_single_file_is_called_by_its_content_too(tmp_path: Path, home: Path) -> None:
    file = tmp_path / "lgm.safetensors"
    file.write_bytes(b"tensors")
    assert find_weights(content_name(file, home), home) == file


def test_the_lock_keeps_what_else_was_pulled(home: Path) -> None:
    folder = pulled(home)
    write_lock(home, "other", locked(folder))
    assert set(read_lock(home)) == {"other", "svd"}
    assert read_lock(home)["svd"] == locked(folder)
    before = (home / LOCK).read_bytes()
    write_lock(home, "other", locked(folder))
    assert (home / LOCK).read_bytes() == before


@pytest.mark.parametrize("text", ["{", "[]", '{"svd": {}}', '{"svd": 3}'])
def test_a_broken_lock_is_refused(text: str, home: Path) -> None:
    home.mkdir()
    (home / LOCK).write_text(text)
    with pytest.raises(BadInput, match="pull the weights again"):
        read_lock(home)
