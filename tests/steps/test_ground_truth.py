"""Where the frames of the truth lie: every layout, and what is said where something is missing."""

import json
from pathlib import Path

import pytest

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from steps.artifacts.ground_truth import CAMERA, find_ground_truth, find_ground_truths

AZIMUTHS = (-75.0, 15.0, 105.0, 195.0)


def frames(folder: Path, count: int, pattern: str = "{:03d}.png") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(count):
        (folder / pattern.format(i)).write_bytes(b"picture")
    return folder


def ours(folder: Path, count: int = 12, given: int | None = None) -> Path:
    frames(folder / "input", count if given is None else given)
    for azimuth in AZIMUTHS:
        frames(folder / f"view_{azimuth:g}", count)
    return folder


def consistent4d(folder: Path, count: int = 12) -> Path:
    for k in range(4):
        frames(folder / f"eval_{k}", count, "{}.png")
    return folder


def names(paths: tuple[Path, ...]) -> list[str]:
    return [path.name for path in paths]


def test_our_layout_is_read(tmp_path: Path) -> None:
    folder = ours(tmp_path / "newt")
    truth = find_ground_truth(folder)
    assert truth.name == "newt"
    assert [view.azimuth_deg for view in truth.views] == list(AZIMUTHS)
    assert [view.name for view in truth.views] == ["-75", "15", "105", "195"]
    assert truth.mesh is truth.bank is None
    (folder / "mesh.npz").touch()
    frames(folder / "bank", 1)
    (folder / "bank" / "bank.json").touch()
    assert find_ground_truth(folder).mesh == folder / "mesh.npz"
    assert find_ground_truth(folder).bank == folder / "bank"


@pytest.mark.parametrize("place", ["", "ref", "input"])
def test_consistent4ds_layout_is_read_wherever_its_input_lies(tmp_path: Path, place: str) -> None:
    folder = consistent4d(tmp_path / "skull")
    frames(folder / place, 12, "{}.png")
    truth = find_ground_truth(folder)
    assert [view.azimuth_deg for view in truth.views] == list(AZIMUTHS)
    assert truth.views[3].frames[0].parent.name == "eval_3"
    assert names(truth.inputs) == [f"{i}.png" for i in range(12)]


def test_frames_play_by_their_numbers(tmp_path: Path) -> None:
    truth = find_ground_truth(frames(tmp_path / "a", 11, "frame_{}.png"))
    assert names(truth.inputs)[-2:] == ["frame_9.png", "frame_10.png"]


def test_an_input_alone_is_a_truth(tmp_path: Path) -> None:
    picture = frames(tmp_path, 1, "fox.png") / "fox.png"
    truth = find_ground_truth(picture)
    assert (truth.name, truth.inputs, truth.views) == ("fox", (picture,), ())
    assert len(find_ground_truth(frames(tmp_path / "film", 5)).inputs) == 5


def test_one_picture_may_be_given_where_films_are_true(tmp_path: Path) -> None:
    truth = find_ground_truth(ours(tmp_path / "newt", given=1))
    assert len(truth.inputs) == 1
    assert len(truth.views[0].frames) == 12


def test_a_data_set_is_its_objects(tmp_path: Path) -> None:
    for name in ("b", "a"):
        ours(tmp_path / name, 2)
    frames(tmp_path / "notes", 1)
    assert [truth.name for truth in find_ground_truths(tmp_path)] == ["a", "b"]
    assert [truth.name for truth in find_ground_truths(tmp_path / "a")] == ["a"]
    frames(consistent4d(tmp_path / "other" / "gt" / "skull", 2), 2, "{}.png")
    assert [truth.name for truth in find_ground_truths(tmp_path / "other")] == ["skull"]


def test_a_folder_of_pictures_is_a_data_set_of_inputs(tmp_path: Path) -> None:
    frames(tmp_path, 3, "cat{}.png")
    assert [(truth.name, len(truth.inputs)) for truth in find_ground_truths(tmp_path)] == [
        ("cat0", 1),
        ("cat1", 1),
        ("cat2", 1),
    ]


def test_the_camera_of_truths_is_the_cameras_default() -> None:
    camera = OrbitCamera()
    assert {"elevation": camera.elevation_deg, "radius": camera.radius, "fovy": camera.fov_y_deg} == CAMERA


def cameras(folder: Path, **changes: float) -> None:
    every = {name: dict(CAMERA) for name in ("input", *(f"view_{azimuth:g}" for azimuth in AZIMUTHS))}
    every["view_15"].update(changes)
    (folder / "cameras.json").write_text(json.dumps(every))


def test_views_from_another_distance_are_refused(tmp_path: Path) -> None:
    folder = ours(tmp_path / "newt")
    cameras(folder)
    assert find_ground_truth(folder).views
    cameras(folder, radius=2.5)
    with pytest.raises(BadInput, match=r"radius 2.*view_15: radius 2\.5"):
        find_ground_truth(folder)
    (folder / "cameras.json").write_text("{}")
    with pytest.raises(BadInput, match="does not give the camera of every view"):
        find_ground_truth(folder)


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="is not ground truth"):
        find_ground_truth(tmp_path / "nowhere")
    with pytest.raises(BadInput, match=r"has no input/; put the input frames into .*input"):
        find_ground_truth(consistent4d(tmp_path / "skull"))
    folder = consistent4d(tmp_path / "trump")
    frames(folder / "a", 2)
    frames(folder / "b", 2)
    with pytest.raises(BadInput, match="has no input/, and several folders could be the input: a, b; put"):
        find_ground_truth(folder)
    folder = ours(tmp_path / "newt")
    (folder / "view_15" / "011.png").unlink()
    with pytest.raises(BadInput, match="input 12, view_-75 12, view_15 11"):
        find_ground_truth(folder)
    frames(tmp_path / "five" / "eval_7", 2)
    with pytest.raises(BadInput, match="eval_0 to eval_3"):
        find_ground_truth(tmp_path / "five")
    (tmp_path / "empty").mkdir()
    with pytest.raises(BadInput, match="holds no objects"):
        find_ground_truths(tmp_path / "empty")
    folder = ours(tmp_path / "twice")
    frames(folder / "eval_1", 12)
    with pytest.raises(BadInput, match="two folders of one view"):
        find_ground_truth(folder)
