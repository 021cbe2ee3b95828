"""`dg4d compose`: what it takes, what it refuses, and what it leaves behind."""

import json
import shutil
from hashlib import sha256
from pathlib import Path

import pytest

from dg4d_lib.assets.scenes.compose import AnimatedGlb
from dg4d_lib.errors import BadInput
from flows.commands.compose import compose, read_scene
from flows.inputs.package_record import RECORD
from tests.steps.small_package import packed


def record(folder: Path) -> None:
    """What `publish` writes, as far as a reader needs it."""
    files = {
        path.relative_to(folder).as_posix(): {
            "digest": f"sha256:{sha256(path.read_bytes()).hexdigest()}",
            "size_bytes": path.stat().st_size,
        }
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != RECORD
    }
    (folder / RECORD).write_text(json.dumps({"files": files}))


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = packed(tmp_path_factory.mktemp("package"))
    record(folder)
    return folder


@pytest.fixture
def shelf(finished: Path, tmp_path: Path) -> Path:
    """A folder with two packages, one of them with a difficult name."""
    for name in ("gem", "große Eule 猫"):
        shutil.copytree(finished, tmp_path / name)
    return tmp_path


def names(path: Path) -> list[str]:
    tree = AnimatedGlb(path.read_bytes()).file.tree
    return [tree["nodes"][number]["name"] for number in tree["scenes"][0]["nodes"]]


def scene_file(folder: Path, **scene: object) -> Path:
    path = folder / "scene.json"
    path.write_text(json.dumps(scene))
    return path


def test_packages_stand_in_a_row_in_the_order_given(shelf: Path) -> None:
    compose([shelf / "große Eule 猫", shelf / "gem"], shelf / "new" / "scene.glb", spacing=0.5)
    tree = AnimatedGlb((shelf / "new" / "scene.glb").read_bytes()).file.tree
    assert names(shelf / "new" / "scene.glb") == ["große Eule 猫", "gem"]
    left, right = (tree["nodes"][number]["translation"][0] for number in tree["scenes"][0]["nodes"])
    assert left < right


def test_a_package_that_is_given_twice_gets_two_names(shelf: Path) -> None:
    compose([shelf / "gem", shelf / "gem", shelf / "gem"], shelf / "scene.glb")
    assert names(shelf / "scene.glb") == ["gem", "gem 2", "gem 3"]


def test_a_scene_file_places_and_times(shelf: Path) -> None:
    items = [
        {"package": "gem", "name": "gem 2", "position": [1, 0, 0], "scale": 2, "start_s": 0.5},
        {"package": "gem", "rotation_deg": [0, 90, 0], "speed": 0.5, "loop": False},
        {"package": "gem"},
    ]
    compose([], shelf / "scene.glb", scene_file(shelf, items=items, duration_s=2))
    assert names(shelf / "scene.glb") == ["gem 2", "gem", "gem 3"]
    body = AnimatedGlb((shelf / "scene.glb").read_bytes())
    assert body.duration_s == 2
    assert body.file.tree["nodes"][body.roots[0]]["scale"] == [2, 2, 2]


def test_a_film_is_written_beside_the_scene(shelf: Path) -> None:
    compose([], shelf / "scene.glb", scene_file(shelf, items=[{"package": "gem"}], fps=8, duration_s=0.5), preview=True)
    assert b"ftyp" in (shelf / "scene.mp4").read_bytes()[:12]


def test_equal_scenes_are_equal_bytes_wherever_they_lie(shelf: Path, tmp_path: Path) -> None:
    compose([shelf / "gem"], shelf / "one.glb")
    shutil.copytree(shelf / "gem", tmp_path / "elsewhere" / "gem")
    compose([tmp_path / "elsewhere" / "gem"], tmp_path / "two.glb")
    assert (shelf / "one.glb").read_bytes() == (tmp_path / "two.glb").read_bytes()


def test_an_altered_file_is_named(shelf: Path) -> None:
    (shelf / "gem" / "splats" / "001.ply").write_bytes(b"other")
    with pytest.raises(BadInput, match=r"gem is damaged: splats/001\.ply was altered"):
        compose([shelf / "gem"], shelf / "scene.glb")
    assert not (shelf / "scene.glb").exists()


def test_a_missing_file_is_named(shelf: Path) -> None:
    (shelf / "gem" / "asset.glb").unlink()
    with pytest.raises(BadInput, match=r"asset\.glb is missing"):
        compose([shelf / "gem"], shelf / "scene.glb")


def test_a_folder_that_is_no_package_is_refused(shelf: Path) -> None:
    (shelf / "empty").mkdir()
    with pytest.raises(BadInput, match="is not an asset"):
        compose([shelf / "gem", shelf / "empty"], shelf / "scene.glb")


@pytest.mark.parametrize(("packages", "scene"), [((), None), (("gem",), "scene.json")])
def test_either_packages_or_a_scene_file_are_needed(shelf: Path, packages: tuple[str, ...], scene: str | None) -> None:
    scene_file(shelf, items=[{"package": "gem"}])
    with pytest.raises(BadInput, match="give either"):
        compose([shelf / name for name in packages], shelf / "scene.glb", shelf / scene if scene else None)


@pytest.mark.parametrize(
    ("scene", "said"),
    [
        ({"items": []}, r"items = \[\]: Tuple should have at least 1 item"),
        (
            {"items": [{"package": "gem"}], "lights": 3},
            "scene has an unknown field 'lights'; allowed: items, dur",
        ),
        ({"items": [{"package": "gem", "sclae": 2}]}, r"items\[0\] has an unknown field 'sclae'; allowed: .*loop$"),
        ({"items": [{"name": "gem"}]}, r"items\[0\] has no package, which is required$"),
        ({"items": [{"package": "gem", "scale": 0}]}, r"items\[0\]\.scale = 0: Input should be greater than 0$"),
        ({"items": [{"package": "gem", "position": [0, 1]}]}, r"items\[0\]\.position"),
        ({"items": [{"package": "../gem"}]}, r"items\[0\]\.package leads outside"),
        ({"items": [{"package": "/gem"}]}, r"items\[0\]\.package leads outside"),
    ],
)
def test_what_is_wrong_in_a_scene_file_is_said(shelf: Path, scene: dict[str, object], said: str) -> None:
    with pytest.raises(BadInput, match=said):
        read_scene(scene_file(shelf, **scene))


def test_a_scene_file_that_is_not_there_or_no_json_is_refused(shelf: Path) -> None:
    with pytest.raises(BadInput, match="cannot be read"):
        read_scene(shelf / "none.json")
    (shelf / "text.json").write_text("a scene")
    with pytest.raises(BadInput, match="Invalid JSON"):
        read_scene(shelf / "text.json")


def test_another_suffix_is_refused(shelf: Path) -> None:
    with pytest.raises(BadInput, match=r"\.glb or \.usdz"):
        compose([shelf / "gem"], shelf / "scene.obj")


def test_a_folder_is_no_output(shelf: Path) -> None:
    (shelf / "scene.glb").mkdir()
    with pytest.raises(BadInput, match="is a folder"):
        compose([shelf / "gem"], shelf / "scene.glb")


def test_a_file_of_a_package_is_not_written_over(shelf: Path) -> None:
    with pytest.raises(BadInput, match="belongs to a package"):
        compose([shelf / "gem"], shelf / "gem" / "asset.glb")


def test_an_output_that_cannot_be_written_is_refused(shelf: Path) -> None:
    with pytest.raises(BadInput, match="cannot be written"):
        compose([shelf / "gem"], Path("/proc/scene.glb"))


def test_a_failure_leaves_the_old_scene_and_nothing_else(shelf: Path) -> None:
    (shelf / "scene.glb").write_bytes(b"old")
    items = [{"package": "gem", "start_s": 9}]
    before = sorted(path.name for path in shelf.iterdir())
    with pytest.raises(BadInput, match="after the end of the scene"):
        compose([], shelf / "scene.glb", scene_file(shelf, items=items, duration_s=1))
    assert (shelf / "scene.glb").read_bytes() == b"old"
    assert sorted(path.name for path in shelf.iterdir()) == sorted([*before, "scene.json"])
