import json
import zipfile
from contextlib import nullcontext
from pathlib import Path

import pytest
from fake_steps import PNG

from dg4d_lib.errors import BadInput
from flows.inputs.conversion_job import ConversionRequest
from flows.inputs.given_views import ViewsRequest, parse_views, views_in_cell
from steps.profiles import PREVIEW
from steps.sources.views import GivenViews, parse_view, read_transforms
from steps.store.artifact_store import ArtifactStore


def picture(folder: Path, name: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_bytes(PNG)
    return folder / name


@pytest.mark.parametrize(
    ("text", "parsed"),
    [
        ("90=a.png", (90, 0, "a.png")),
        ("-75.5,20=b c.png", (-75.5, 20, "b c.png")),
        ("180=x=y.png", (180, 0, "x=y.png")),
    ],
)
def test_a_view_is_azimuth_elevation_and_file(text, parsed):
    assert parse_view(text) == parsed


@pytest.mark.parametrize("text", ["a.png", "=a.png", "90=", "nan=a.png", "1,2,3=a.png", "left=a.png"])
def test_other_texts_are_refused_with_the_form(text):
    with pytest.raises(BadInput, match="AZIMUTH"):
        parse_view(text)


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("180,95=a.png", "elevation 95 is out of range; use -80 to 80"),
        ("400=a.png", "azimuth 400 is out of range; use -360 to 360"),
        ("-361,10=a.png", "azimuth -361 is out of range; use -360 to 360"),
        (
            "1e9,-81=a.png",
            "azimuth 1e+09 is out of range; use -360 to 360; elevation -81 is out of range; use -80 to 80",
        ),
    ],
)
def test_only_the_wrong_angle_of_a_view_is_named(text, wrong):
    with pytest.raises(BadInput) as refusal:
        parse_view(text)
    assert str(refusal.value) == f"{text!r}: {wrong}"


@pytest.mark.parametrize(
    ("views", "named"),
    [
        (["90=a.png", "-270=b.png"], "b.png and a.png"),
        (["0=a.png"], "a.png and the input"),
        (["359.5=a.png"], "the input"),
    ],
)
def test_two_views_of_one_direction_are_refused(views, named, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a.png", "b.png"):
        picture(tmp_path, name)
    with pytest.raises(BadInput, match=named):
        ViewsRequest(views=parse_views(views)).check(None)


def test_views_travel_with_the_job_and_change_its_digest(tmp_path):
    store = ArtifactStore(tmp_path / "store")
    front, back = picture(tmp_path, "front.png"), picture(tmp_path, "back.png")
    plain = ConversionRequest(item="a", picture=front, settings=PREVIEW)
    views = ViewsRequest(views=parse_views([f"180,10={back}"]))
    job = plain.model_copy(update={"given_views": views}).to_job(store)
    assert job.views is not None and job.digest() != plain.to_job(store).digest()
    with zipfile.ZipFile(store.path(job.views)) as archive:
        given = GivenViews.model_validate_json(archive.read("views.json"))
        assert archive.read(given.views[0].file) == PNG
    assert (given.views[0].azimuth, given.views[0].elevation, given.views[0].name) == (180, 10, "back.png")


def test_a_turntable_may_be_a_folder_of_frames(tmp_path):
    for name in ("0.png", "1.png"):
        picture(tmp_path / "turn", name)
    store = ArtifactStore(tmp_path / "store")
    ref = ViewsRequest(turntable=tmp_path / "turn").put(store, None)
    with zipfile.ZipFile(store.path(ref)) as archive:
        assert archive.read("turntable")[:2] == b"PK"


MATRIX = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]


def transforms(folder: Path, *files: str, **more: object) -> Path:
    for name in files:
        picture(folder, name)
    frames = [{"file_path": name, "transform_matrix": MATRIX} for name in files]
    (folder / "transforms.json").write_text(json.dumps({"frames": frames, **more}))
    return folder / "transforms.json"


def test_the_camera_of_the_input_is_the_one_with_its_name(tmp_path):
    path = transforms(tmp_path, "a.png", "b.png", "c.png", camera_angle_x=0.9)
    store = ArtifactStore(tmp_path / "store")
    for source, others in ((tmp_path / "b.png", ["a.png", "c.png"]), (None, ["b.png", "c.png"])):
        with zipfile.ZipFile(store.path(ViewsRequest(cameras=path).put(store, source))) as archive:
            given = GivenViews.model_validate_json(archive.read("views.json"))
        assert [view.name for view in given.views] == others and given.input_camera is not None


def test_of_files_of_one_name_the_input_itself_names_its_camera(tmp_path):
    files = [picture(tmp_path / f"cam{i}", "0.png").relative_to(tmp_path).as_posix() for i in range(3)]
    matrices = [[[1, 0, 0, i], *MATRIX[1:]] for i in range(3)]
    frames = [{"file_path": file, "transform_matrix": m} for file, m in zip(files, matrices, strict=True)]
    path = transforms(tmp_path, frames=frames, camera_angle_x=0.9)
    store = ArtifactStore(tmp_path / "store")
    with zipfile.ZipFile(store.path(ViewsRequest(cameras=path).put(store, tmp_path / "cam1" / "0.png"))) as archive:
        given = GivenViews.model_validate_json(archive.read("views.json"))
    assert [camera.matrix[0][3] for camera in (given.input_camera, *(v.camera for v in given.views))] == [1, 0, 2]
    with pytest.raises(BadInput, match=r"names 3 files 0\.png"):
        ViewsRequest(cameras=path).check(picture(tmp_path / "elsewhere", "0.png"))


def test_focal_lengths_are_in_widths_of_the_picture(tmp_path):
    own = read_transforms(transforms(tmp_path, "a.png", "b.png", fl_x=400, w=800, h=600, cx=200, cy=300))
    camera = own.camera(own.frames[0])
    assert camera.focal == 0.5 and camera.center == (0.25, 0.5) and camera.size == (800, 600)


@pytest.mark.parametrize(("size", "refused"), [((400, 300), False), ((401, 300), False), ((600, 800), True)])
def test_a_picture_may_be_smaller_than_its_camera_says_but_not_of_another_shape(tmp_path, size, refused):
    own = read_transforms(transforms(tmp_path, "a.png", "b.png", fl_x=400, w=800, h=600))
    with pytest.raises(BadInput, match="600 x 800 pixels, its camera 800 x 600") if refused else nullcontext():
        own.camera(own.frames[0]).check_shape(size, "a.png")


@pytest.mark.parametrize(
    ("more", "refusal"),
    [
        ({}, "no focal length"),
        ({"fl_x": 4, "w": 8, "h": 8, "k1": 0.3}, "distorted"),
        ({"fl_x": -1}, "transforms.json"),
        ({"camera_angle_x": 0.9, "w": 10**400, "h": 8}, "transforms.json"),
        ({"frames": [{"file_path": "a.png", "transform_matrix": MATRIX, "k1": 0.3}] * 2}, "distorted"),
    ],
)
def test_cameras_that_are_no_pinholes_are_refused(more, refusal, tmp_path):
    path = transforms(tmp_path, "a.png", "b.png", **more)
    with pytest.raises(BadInput, match=refusal):
        ViewsRequest(cameras=path).put(ArtifactStore(tmp_path / "store"), None)


def test_files_outside_of_the_folder_of_cameras_are_refused(tmp_path):
    picture(tmp_path, "outside.png")
    path = transforms(tmp_path / "in", "a.png", "b.png", camera_angle_x=0.9)
    path.write_text(path.read_text().replace('"b.png"', '"../outside.png"'))
    with pytest.raises(BadInput, match="leads out of the folder"):
        ViewsRequest(cameras=path).check(None)


def test_cameras_exclude_other_views(tmp_path):
    path = transforms(tmp_path, "a.png", "b.png", camera_angle_x=0.9)
    with pytest.raises(BadInput, match="without --view"):
        ViewsRequest(views=parse_views([f"90={tmp_path / 'a.png'}"]), cameras=path).check(None)


def test_a_cell_of_a_manifest_holds_several_views_below_its_folder(tmp_path):
    picture(tmp_path, "a.png")
    found = views_in_cell("90=a.png; 180,5=b.png", tmp_path)
    assert [(view.azimuth, view.elevation, view.path.name) for view in found] == [(90, 0, "a.png"), (180, 5, "b.png")]
    with pytest.raises(BadInput, match="leads out"):
        views_in_cell("90=../a.png", tmp_path)
