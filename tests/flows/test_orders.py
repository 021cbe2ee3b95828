from pathlib import Path

import pytest

from dg4d_lib.errors import BadInput
from flows.orders import Order, Wish
from steps.profiles import PREVIEW, revise
from steps.store import ArtifactStore


@pytest.fixture
def store(tmp_path: Path) -> ArtifactStore:
    return ArtifactStore(tmp_path / "store")


@pytest.fixture(autouse=True)
def code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DG4D_CODE_VERSION", "test")


def wish(picture: Path, video: Path | None = None, bank: Path | None = None, **changes: object) -> Wish:
    return Wish(item="x", picture=picture, video=video, bank=bank, settings=revise(PREVIEW, dict(changes)))


def order(wish: Wish, store: ArtifactStore) -> Order:
    wish.check()
    return wish.order(store)


def frames(folder: Path, count: int) -> Path:
    folder.mkdir(exist_ok=True)
    for i in range(count):
        (folder / f"{i:03d}.png").write_bytes(bytes([i]))
    (folder / "notes.txt").write_text("not a frame")
    return folder


def test_names_do_not_count_but_content_settings_and_seed_do(tmp_path: Path, store: ArtifactStore) -> None:
    (tmp_path / "a.png").write_bytes(b"picture")
    (tmp_path / "b.png").write_bytes(b"picture")
    (tmp_path / "c.png").write_bytes(b"another")
    first = order(wish(tmp_path / "a.png"), store)
    assert order(wish(tmp_path / "b.png"), store).digest() == first.digest()
    assert first.model_copy(update={"item": "y", "profile": "p"}).digest() == first.digest()
    others = [
        order(wish(tmp_path / "c.png"), store),
        order(wish(tmp_path / "a.png", **{"mesh.grid": 64}), store),
        first.model_copy(update={"seed": 1}),
        first.model_copy(update={"moving": True}),
    ]
    assert len({first.digest(), *(other.digest() for other in others)}) == 5


def test_other_code_is_another_order(tmp_path: Path, store: ArtifactStore, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.png").write_bytes(b"picture")
    one = order(wish(tmp_path / "a.png"), store)
    before = one.digest()
    monkeypatch.setenv("DG4D_CODE_VERSION", "other")
    assert one.digest() != before


def test_a_folder_of_frames_is_a_video_and_equal_frames_are_equal_sources(tmp_path: Path, store: ArtifactStore) -> None:
    (tmp_path / "a.png").write_bytes(b"picture")
    one = order(wish(tmp_path / "a.png", frames(tmp_path / "one", 3)), store)
    two = order(wish(tmp_path / "a.png", frames(tmp_path / "two", 3)), store)
    assert one.source == two.source
    assert one.moving
    assert (one.source_name, one.picture_name) == ("one", "a.png")
    assert order(wish(tmp_path / "a.png", frames(tmp_path / "one", 4)), store).source != one.source


@pytest.mark.parametrize(("name", "moving"), [("a.mp4", True), ("a.WEBM", True), ("a.gif", False), ("a.png", False)])
def test_a_video_can_be_the_main_argument(tmp_path: Path, store: ArtifactStore, name: str, moving: bool) -> None:
    (tmp_path / name).write_bytes(b"x")
    assert order(wish(tmp_path / name), store).moving == moving


def test_what_cannot_work_is_refused_before_any_work(tmp_path: Path) -> None:
    good = tmp_path / "good.png"
    good.write_bytes(b"x")
    (tmp_path / "empty.png").touch()
    bank = frames(tmp_path / "bank", 1)
    cases = {
        "does not exist": wish(tmp_path / "none.png"),
        "is a folder; give one file": wish(tmp_path),
        "empty": wish(tmp_path / "empty.png"),
        "does not exist;": wish(good, tmp_path / "none.mp4"),
        "holds 1 picture;": wish(good, frames(tmp_path / "single", 1)),
        "holds no pictures;": wish(good, frames(tmp_path / "bare", 0)),
        "needs the true views": wish(good, **{"prior.kind": "oracle"}),
        r"no file bank\.json": wish(good, bank=bank, **{"prior.kind": "oracle"}),
    }
    for says, bad in cases.items():
        with pytest.raises(BadInput, match=says):
            bad.check()
    (bank / "bank.json").write_text("{}")
    wish(good, bank=bank, **{"prior.kind": "oracle"}).check()
    with pytest.raises(BadInput, match=r"prior\.kind=oracle"):
        wish(good, bank=bank).check()
