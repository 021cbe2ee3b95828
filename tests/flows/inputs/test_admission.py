"""Admission to the store: what is no picture, video, folder of frames or bank never enters it."""

import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from fake_steps import PNG, bank_json, picture

from dg4d_lib.errors import BadInput
from flows.commands.benchmark import put_ground_truth
from flows.inputs import sources
from flows.inputs.sources import put_bank, put_source
from steps.artifacts.ground_truth import find_ground_truth
from steps.sources import banks
from steps.store.artifact_store import ArtifactStore

SECRET = b"root:x:0:0:root:/root:/bin/bash\n"


@pytest.fixture
def store(tmp_path: Path) -> ArtifactStore:
    return ArtifactStore(tmp_path / "store")


def kept(store: ArtifactStore) -> list[Path]:
    return [path for path in store.root.rglob("*") if path.is_file()]


def bank(folder: Path, *views: str) -> Path:
    folder.mkdir()
    (folder / "bank.json").write_text(bank_json(*views))
    (folder / "0.png").write_bytes(PNG)
    return folder


def names_in(store: ArtifactStore) -> list[str]:
    (path,) = kept(store)
    with zipfile.ZipFile(path) as archive:
        return archive.namelist()


@pytest.mark.parametrize("suffix", ["png", "mp4", "zip", ""])
def test_a_secret_is_not_stored_whatever_it_is_called(tmp_path: Path, store: ArtifactStore, suffix: str) -> None:
    (tmp_path / f"a.{suffix}").write_bytes(SECRET)
    with pytest.raises(BadInput, match="the file is a text file, whatever its name says; give pictures"):
        put_source(tmp_path / f"a.{suffix}", store)
    assert kept(store) == []


def test_a_secret_among_frames_is_not_stored(tmp_path: Path, store: ArtifactStore) -> None:
    (tmp_path / "in").mkdir()
    for i in range(3):
        (tmp_path / "in" / f"{i}.png").write_bytes(PNG)
    (tmp_path / "in" / "id_ed25519").write_bytes(SECRET)
    put_source(tmp_path / "in", store)
    assert names_in(store) == ["0.png", "1.png", "2.png"]
    (tmp_path / "in" / "3.png").write_bytes(SECRET)
    with pytest.raises(BadInput, match=r"3\.png: the file is a text file"):
        put_source(tmp_path / "in", store)
    assert len(kept(store)) == 1


def test_of_a_bank_its_description_and_the_pictures_that_it_names_are_stored(
    tmp_path: Path, store: ArtifactStore
) -> None:
    folder = bank(tmp_path / "bank", "0.png")
    (folder / "passwd").write_bytes(SECRET)
    (folder / "1.png").write_bytes(PNG)
    put_bank(folder, store)
    assert names_in(store) == ["0.png", "bank.json"]


BANKS: dict[str, Callable[[Path], object]] = {
    r"views is \[\], and .* at least 1 item": lambda folder: (folder / "bank.json").write_text(bank_json()),
    "does not describe the views": lambda folder: (folder / "bank.json").write_bytes(SECRET),
    "does not describe the views of a bank: frames is missing": lambda folder: (folder / "bank.json").write_text("{}"),
    "describe the views of a bank: .*recursion": lambda folder: (folder / "bank.json").write_text("[" * 10**5),
    r"0\.png: the file is a text file": lambda folder: (folder / "0.png").write_bytes(SECRET),
    r"0\.png, which is not there": lambda folder: (folder / "0.png").unlink(),
    r"sheets of a bank are PNG files": lambda folder: (folder / "bank.json").write_text(bank_json("bank.json")),
    "tile_size = 2 ask for 6 x 2": lambda folder: (folder / "bank.json").write_text(
        bank_json("0.png").replace("[3, 4]", "[1, 3]")
    ),
}


@pytest.mark.parametrize(("says", "spoil"), BANKS.items(), ids=BANKS)
def test_a_bank_that_is_none_is_not_stored(
    tmp_path: Path, store: ArtifactStore, says: str, spoil: Callable[[Path], object]
) -> None:
    folder = bank(tmp_path / "bank", "0.png")
    spoil(folder)
    with pytest.raises(BadInput, match=says):
        put_bank(folder, store)
    assert kept(store) == []


@pytest.mark.parametrize("name", ["/etc/passwd", "../secret.png", "a/../../secret.png", "a\\..\\..\\secret.png"])
def test_a_bank_names_nothing_outside_of_itself(tmp_path: Path, store: ArtifactStore, name: str) -> None:
    (tmp_path / "secret.png").write_bytes(PNG)
    with pytest.raises(BadInput, match="names a picture outside of the bank"):
        put_bank(bank(tmp_path / "bank", name), store)
    assert kept(store) == []


@pytest.mark.parametrize("name", ["0.png", "bank.json"])
def test_links_of_a_bank_do_not_lead_out(tmp_path: Path, store: ArtifactStore, name: str) -> None:
    folder = bank(tmp_path / "bank", "0.png")
    (folder / name).rename(tmp_path / "outside")
    (folder / name).symlink_to(tmp_path / "outside")
    with pytest.raises(BadInput, match="leads out of the folder"):
        put_bank(folder, store)
    assert kept(store) == []


def test_a_bank_is_described_in_few_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(banks, "LARGEST_BANK_JSON", 20)
    with pytest.raises(BadInput, match="at most 20 are read"):
        sources.check_bank(bank(tmp_path / "bank", "0.png"))


@pytest.mark.parametrize("name", ["input/0.png", "view_15/0.png", "mesh.npz"])
def test_a_secret_in_a_ground_truth_is_not_stored(tmp_path: Path, store: ArtifactStore, name: str) -> None:
    for folder in ("input", "view_15"):
        (tmp_path / "newt" / folder).mkdir(parents=True)
        (tmp_path / "newt" / folder / "0.png").write_text(picture(folder))
    put_ground_truth(find_ground_truth(tmp_path / "newt"), store)
    (tmp_path / "newt" / name).write_bytes(SECRET)
    with pytest.raises(BadInput, match=r"0\.png: the file is a text file|mesh\.npz is not a NumPy archive"):
        put_ground_truth(find_ground_truth(tmp_path / "newt"), store)
    assert len(kept(store)) == 1
