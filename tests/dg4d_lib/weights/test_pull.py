import errno
import hashlib
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import huggingface_hub
import pytest
from huggingface_hub.errors import OfflineModeIsEnabled

from dg4d_lib.errors import BackendUnavailable
from dg4d_lib.weights.locate import digests, find_weights
from dg4d_lib.weights.lock import read_lock
from dg4d_lib.weights.pull import needed, plan_pull, pull
from dg4d_lib.weights.registry import KNOWN, lookup_weights

SVD = replace(KNOWN["svd"], revision=None, published={})
REPOSITORY = {
    "README.md": b"card",
    "model_index.json": b"{}",
    "svd.safetensors": b"everything once more",
    "scheduler/scheduler_config.json": b"{}",
    **{
        f"{part}/{name}": f"{part} {name}".encode()
        for part in ("vae", "unet", "image_encoder")
        for name in ("config.json", "model.safetensors", "model.fp16.safetensors", "model.bin", "model.fp16.bin")
    },
}
WANTED = [
    "image_encoder/config.json",
    "image_encoder/model.fp16.safetensors",
    "model_index.json",
    "scheduler/scheduler_config.json",
    "unet/config.json",
    "unet/model.fp16.safetensors",
    "vae/config.json",
    "vae/model.fp16.safetensors",
]


class Hub:
    """The hub, as huggingface_hub shows it; downloads are files of a dictionary."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.files = dict(REPOSITORY)
        self.fails: Exception | None = None
        self.breaks_after: int | None = None
        self.revisions: list[str | None] = []
        self.downloaded: list[str] = []
        self.newest = "a" * 40
        hub = self

        class Api:
            def model_info(self, repo: str, revision: str | None, files_metadata: bool) -> SimpleNamespace:
                return hub.info(revision)

        monkeypatch.setattr(huggingface_hub, "HfApi", Api)
        monkeypatch.setattr(huggingface_hub, "snapshot_download", self.download)

    def info(self, revision: str | None) -> SimpleNamespace:
        if self.fails:
            raise self.fails
        self.revisions.append(revision)
        siblings = [
            SimpleNamespace(
                rfilename=name,
                size=len(content),
                lfs=SimpleNamespace(sha256=hashlib.sha256(content).hexdigest()) if "model." in name else None,
            )
            for name, content in REPOSITORY.items()
        ]
        card = SimpleNamespace(license="openrail++")
        return SimpleNamespace(sha=revision or self.newest, siblings=siblings, card_data=card)

    def download(self, repo: str, revision: str, local_dir: Path, allow_patterns: list[str]) -> None:
        for name in allow_patterns:
            if name in self.files and not (local_dir / name).exists():
                (local_dir / name).parent.mkdir(parents=True, exist_ok=True)
                (local_dir / name).write_bytes(self.files[name])
                self.downloaded.append(name)
                if len(self.downloaded) == self.breaks_after:
                    raise ConnectionError("lost")


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> Hub:
    return Hub(monkeypatch)


def test_only_what_is_needed_is_downloaded_and_every_file_is_written_down(hub: Hub, tmp_path: Path) -> None:
    locked = pull(SVD, tmp_path)
    assert hub.downloaded == WANTED
    assert list(locked.files) == WANTED
    assert locked.revision == "a" * 40
    assert locked.license == "openrail++"
    for name, file in locked.files.items():
        assert file.sha256 == hashlib.sha256(REPOSITORY[name]).hexdigest()
        assert file.size == len(REPOSITORY[name])
    assert read_lock(tmp_path) == {"svd": locked}
    assert find_weights("svd", tmp_path) == tmp_path / "svd"


def test_a_plan_knows_what_is_here_and_what_was_begun(hub: Hub, tmp_path: Path) -> None:
    sizes = {name: len(REPOSITORY[name]) for name in WANTED}
    plan = plan_pull(SVD, tmp_path)
    assert (dict(plan.sizes), plan.present_bytes, plan.missing_bytes) == (sizes, 0, sum(sizes.values()))
    assert hub.downloaded == [] and not plan.folder.exists()
    (plan.folder / "vae").mkdir(parents=True)
    (plan.folder / "vae/config.json").write_bytes(REPOSITORY["vae/config.json"])
    begun = plan.folder / ".cache/huggingface/download/unet/x.incomplete"
    begun.parent.mkdir(parents=True)
    begun.write_bytes(b"1234567")
    assert plan.present_bytes == sizes["vae/config.json"] + 7
    pull(SVD, tmp_path)
    assert plan_pull(SVD, tmp_path).missing_bytes == 0


def test_a_second_pull_stays_with_the_first_revision_and_loads_nothing(hub: Hub, tmp_path: Path) -> None:
    first = pull(SVD, tmp_path)
    hub.downloaded.clear()
    hub.newest = "b" * 40
    assert pull(SVD, tmp_path) == first
    assert hub.downloaded == []
    assert hub.revisions == [None, "a" * 40]


def test_a_pull_goes_on_and_mends_what_is_damaged(hub: Hub, tmp_path: Path) -> None:
    pull(SVD, tmp_path)
    hub.downloaded.clear()
    (tmp_path / "svd" / "vae" / "config.json").unlink()
    file = tmp_path / "svd" / "unet" / "model.fp16.safetensors"
    file.write_bytes(bytes(reversed(file.read_bytes())))
    pull(SVD, tmp_path)
    assert hub.downloaded == ["unet/model.fp16.safetensors", "vae/config.json"]
    find_weights("svd", tmp_path)


def test_a_pull_that_broke_off_is_not_complete_until_it_is_repeated(hub: Hub, tmp_path: Path) -> None:
    pictures = lookup_weights("somebody/pictures")
    hub.breaks_after = 4
    with pytest.raises(BackendUnavailable, match="connect this machine to the network"):
        pull(pictures, tmp_path)
    assert len(hub.downloaded) == 4
    with pytest.raises(BackendUnavailable, match=r"has unfinished files; .*`dg4d weights pull somebody/pictures`"):
        find_weights("somebody/pictures", tmp_path)
    hub.breaks_after = None
    pull(pictures, tmp_path)
    (tmp_path / "weights.lock.json").unlink()
    find_weights("somebody/pictures", tmp_path)


def test_a_list_of_files_that_cannot_be_read_is_downloaded_again(hub: Hub, tmp_path: Path) -> None:
    (tmp_path / "somebody--pictures").mkdir()
    (tmp_path / "somebody--pictures/model_index.json").write_bytes(b'{"vae": [')
    pull(lookup_weights("somebody/pictures"), tmp_path)
    assert "model_index.json" in hub.downloaded


@pytest.mark.parametrize("name", ["../mine.txt", "{folder}/mine.txt", ".."])
def test_a_list_of_files_never_removes_what_lies_outside(name: str, hub: Hub, tmp_path: Path) -> None:
    folder, mine = tmp_path / "somebody--pictures", tmp_path / "mine.txt"
    folder.mkdir()
    mine.write_text("of the user")
    index = {name.format(folder=tmp_path): ["diffusers", "UNet2DConditionModel"]}
    (folder / "model_index.json").write_text(json.dumps(index))
    plan_pull(lookup_weights("somebody/pictures"), tmp_path)
    assert mine.read_text() == "of the user"


def test_a_download_that_is_not_what_the_hub_lists_is_refused(hub: Hub, tmp_path: Path) -> None:
    hub.files["unet/model.fp16.safetensors"] = b"something else"
    with pytest.raises(BackendUnavailable, match=r"unet/model\.fp16\.safetensors is damaged"):
        pull(SVD, tmp_path)
    assert read_lock(tmp_path) == {}
    hub.files = dict(REPOSITORY)
    pull(SVD, tmp_path)
    assert read_lock(tmp_path)


def test_what_the_hub_lists_is_refused_where_something_else_was_published(hub: Hub, tmp_path: Path) -> None:
    file = "unet/model.fp16.safetensors"
    right = hashlib.sha256(REPOSITORY[file]).hexdigest()
    for revision in (None, hub.newest):
        other = replace(SVD, revision=revision, published={file: "0" * 64})
        with pytest.raises(BackendUnavailable, match=r"unet/model\.fp16\.safetensors is damaged"):
            pull(other, tmp_path / "other")
        assert not (tmp_path / "other" / "svd" / file).exists()
    pull(replace(SVD, published={file: right, "not/needed.safetensors": "0" * 64}), tmp_path / "right")
    hub.newest = "b" * 40
    pull(replace(SVD, published={file: right}), tmp_path / "right")
    assert read_lock(tmp_path / "right")["svd"].revision == "a" * 40


def test_a_download_without_a_file_is_refused(hub: Hub, tmp_path: Path) -> None:
    del hub.files["vae/config.json"]
    with pytest.raises(BackendUnavailable, match=r"vae/config\.json was not downloaded"):
        pull(SVD, tmp_path)


def test_a_repository_without_what_is_needed_is_refused(hub: Hub, tmp_path: Path) -> None:
    with pytest.raises(BackendUnavailable, match=r"model_fp16_fixrot\.safetensors is missing"):
        pull(KNOWN["lgm"], tmp_path)


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (OSError("Name or service not known\nand more"), "connect this machine to the network"),
        (OfflineModeIsEnabled("offline"), "give its path"),
        (type("GatedRepoError", (Exception,), {})("403"), "accept its license at https"),
        (type("RevisionNotFoundError", (Exception,), {})("404"), "the pinned revision no longer exists"),
    ],
)
def test_without_the_hub_there_is_one_clear_message(error: Exception, says: str, hub: Hub, tmp_path: Path) -> None:
    hub.fails = error
    with pytest.raises(BackendUnavailable, match=says) as told:
        pull(SVD, tmp_path)
    assert len(str(told.value).splitlines()) == 1
    assert SVD.hub_id in str(told.value)
    assert not (tmp_path / "svd").exists()


def test_a_full_disk_is_not_taken_for_a_lost_network(hub: Hub, tmp_path: Path) -> None:
    hub.fails = OSError(errno.ENOSPC, "No space left on device")
    with pytest.raises(OSError, match="No space left"):
        pull(SVD, tmp_path)


def test_without_the_package_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "huggingface_hub", None)
    with pytest.raises(BackendUnavailable, match="run `make setup CUDA=1`"):
        pull(SVD, tmp_path)


def test_a_pin_of_the_registry_is_what_is_asked_for(hub: Hub, tmp_path: Path) -> None:
    pull(replace(SVD, revision="d" * 40), tmp_path)
    assert hub.revisions == ["d" * 40]


def test_weights_that_only_the_user_knows_come_whole_but_once(hub: Hub, tmp_path: Path) -> None:
    pull(lookup_weights("somebody/pictures"), tmp_path)
    assert set(hub.downloaded) == set(WANTED)  # not svd.safetensors, which holds all parts once more
    assert find_weights("somebody/pictures", tmp_path) == tmp_path / "somebody--pictures"


@pytest.mark.parametrize(
    ("files", "chosen"),
    [
        (["u/m.safetensors", "u/m.bin"], ["u/m.safetensors"]),
        (["u/m.bin", "u/m.fp16.bin"], ["u/m.fp16.bin"]),
        (["u/m.safetensors", "u/m.fp16.bin"], ["u/m.safetensors"]),
        (["u/m.bin"], ["u/m.bin"]),
        (["u/m.safetensors", "u/m.non_ema.safetensors"], ["u/m.safetensors"]),
        (["u/m.safetensors", "u/m.onnx", "u/flax_model.msgpack", "u/openvino_model.bin"], ["u/m.safetensors"]),
        (["m.safetensors", "config.json"], ["config.json", "m.safetensors"]),
        ([".cache/x.json", "u/.git/config.json", "u/a.json"], ["u/a.json"]),
        (
            [
                "u/m-00001-of-00002.safetensors",
                "u/m-00002-of-00002.safetensors",
                "u/m.safetensors.index.json",
                "u/m.bin.index.json",
                "u/m-00001-of-00001.bin",
            ],
            ["u/m-00001-of-00002.safetensors", "u/m-00002-of-00002.safetensors", "u/m.safetensors.index.json"],
        ),
        (
            [
                "u/m.fp16-00001-of-00001.safetensors",
                "u/m.safetensors.index.fp16.json",
                "u/m-00001-of-00001.safetensors",
                "u/m.safetensors.index.json",
            ],
            ["u/m.fp16-00001-of-00001.safetensors", "u/m.safetensors.index.fp16.json"],
        ),
    ],
)
def test_tensors_come_in_one_format(files: list[str], chosen: list[str]) -> None:
    assert needed(files) == chosen


def test_a_part_may_be_a_single_file() -> None:
    files = ["model.safetensors", "model_fp16_fixrot.safetensors", "model_fp16.safetensors", "README.md"]
    assert needed(files, KNOWN["lgm"].parts) == ["model_fp16_fixrot.safetensors"]


@pytest.mark.parametrize("name", ["vgg16", "lpips-vgg", "i3d"])
def test_of_the_judges_repositories_one_file_is_needed(name: str) -> None:
    (file,) = KNOWN[name].parts
    repository = [file, "README.md", "config.json", "LPIPS_v0.1_alex-df73285e.pth", "pytorch_model.bin", "other.pt"]
    assert needed(repository, KNOWN[name].parts) == [file]


@pytest.mark.parametrize("name", ["lpips-vgg", "i3d"])
def test_files_of_torch_are_found_and_told_apart_by_their_content(name: str, tmp_path: Path) -> None:
    (file,) = KNOWN[name].parts
    (tmp_path / name).mkdir()
    (tmp_path / name / file).write_bytes(b"tensors")
    assert find_weights(name, tmp_path) == tmp_path / name
    before = digests(tmp_path / name, KNOWN[name].parts)
    assert list(before) == [file]
    (tmp_path / name / file).write_bytes(b"other tensors")
    assert digests(tmp_path / name) != before
