"""Admission of users' models."""

import json
import zipfile
from pathlib import Path

import pytest
from fake_steps import PNG

from dg4d_lib.errors import BadInput
from flows.inputs.conversion_job import ConversionRequest
from flows.inputs.given_views import ViewsRequest
from flows.inputs.models import check_model, put_model
from steps.profiles import PREVIEW
from steps.store.artifact_store import ArtifactStore


@pytest.fixture
def store(tmp_path: Path) -> ArtifactStore:
    return ArtifactStore(tmp_path / "store")


def entries(path: Path, store: ArtifactStore) -> list[str]:
    with zipfile.ZipFile(store.path(put_model(path, store))) as archive:
        return archive.namelist()


def test_a_gltf_comes_with_its_files(tmp_path: Path, store: ArtifactStore) -> None:
    tree = {
        "buffers": [{"uri": "a%20b.bin"}],
        "images": [{"uri": "tex/c.png"}, {"uri": "data:,x"}, {"uri": "gone.png"}],
    }
    (tmp_path / "x.gltf").write_text(json.dumps(tree))
    (tmp_path / "a b.bin").write_bytes(b"1")
    (tmp_path / "tex").mkdir()
    (tmp_path / "tex/c.png").write_bytes(b"2")
    assert entries(tmp_path / "x.gltf", store) == ["model.gltf", "a b.bin", "tex/c.png"]


def test_an_obj_comes_with_materials_and_textures(tmp_path: Path, store: ArtifactStore) -> None:
    (tmp_path / "x.OBJ").write_text("mtllib my materials.mtl\nv 0 0 0\n")
    (tmp_path / "my materials.mtl").write_text("newmtl a\nmap_Kd -s 1 1 1 paint.png\n")
    (tmp_path / "paint.png").write_bytes(b"1")
    assert entries(tmp_path / "x.OBJ", store) == ["model.obj", "my materials.mtl", "paint.png"]


@pytest.mark.parametrize("statement", ["my paint.png", r"C:\textures\my paint.png", "-clamp on my paint.png"])
def test_textures_with_spaces_in_their_names_come_along(statement: str, tmp_path: Path, store: ArtifactStore) -> None:
    (tmp_path / "x.obj").write_text("mtllib a.mtl\nv 0 0 0\n")
    (tmp_path / "a.mtl").write_text(f"newmtl a\nmap_Kd {statement}\n")
    (tmp_path / "my paint.png").write_bytes(b"1")
    assert entries(tmp_path / "x.obj", store) == ["model.obj", "a.mtl", "my paint.png"]


def test_an_obj_comes_with_all_of_its_materials(tmp_path: Path, store: ArtifactStore) -> None:
    (tmp_path / "x.obj").write_text("mtllib a.mtl b.mtl\nv 0 0 0\n")
    for name in ("a.mtl", "b.mtl"):
        (tmp_path / name).write_text("newmtl a\n")
    assert entries(tmp_path / "x.obj", store) == ["model.obj", "a.mtl", "b.mtl"]


def test_a_byte_order_mark_hides_no_file(tmp_path: Path, store: ArtifactStore) -> None:
    (tmp_path / "x.obj").write_text("mtllib a.mtl\nv 0 0 0\n", "utf-8-sig")
    (tmp_path / "a.mtl").write_text("newmtl a\nmap_Kd paint.png\n", "utf-8-sig")
    (tmp_path / "paint.png").write_bytes(b"1")
    (tmp_path / "y.gltf").write_text(json.dumps({"images": [{"uri": "paint.png"}]}), "utf-8-sig")
    assert entries(tmp_path / "x.obj", store) == ["model.obj", "a.mtl", "paint.png"]
    assert entries(tmp_path / "y.gltf", store) == ["model.gltf", "paint.png"]


def test_a_ply_comes_with_its_texture(tmp_path: Path, store: ArtifactStore) -> None:
    (tmp_path / "x.ply").write_text("ply\nformat ascii 1.0\ncomment TextureFile my paint.png\nend_header\n")
    (tmp_path / "my paint.png").write_bytes(b"1")
    assert entries(tmp_path / "x.ply", store) == ["model.ply", "my paint.png"]


def test_spz_of_both_kinds_is_admitted(tmp_path: Path, store: ArtifactStore) -> None:
    for name, content in {"3.spz": b"\x1f\x8b", "4.spz": b"NGSP"}.items():
        (tmp_path / name).write_bytes(content)
        assert entries(tmp_path / name, store) == ["model.spz"]


def test_names_that_are_too_long_are_left_to_the_reader(tmp_path: Path, store: ArtifactStore) -> None:
    (tmp_path / "x.gltf").write_text(json.dumps({"buffers": [{"uri": "a" * 5000}]}))
    assert entries(tmp_path / "x.gltf", store) == ["model.gltf"]


def test_the_name_of_a_model_does_not_count(tmp_path: Path, store: ArtifactStore) -> None:
    for name in ("a.glb", "b.glb"):
        (tmp_path / name).write_bytes(b"glTF same")
    assert put_model(tmp_path / "a.glb", store) == put_model(tmp_path / "b.glb", store)


@pytest.mark.parametrize("name", ["../secret", "/etc/passwd", "a/../../secret"])
def test_files_outside_of_the_folder_are_refused(name: str, tmp_path: Path, store: ArtifactStore) -> None:
    (tmp_path / "secret").write_text("secret")
    (tmp_path / "in").mkdir()
    (tmp_path / "in/x.gltf").write_text(json.dumps({"buffers": [{"uri": name}]}))
    with pytest.raises(BadInput, match="leads out of the folder"):
        put_model(tmp_path / "in/x.gltf", store)


REFUSED = {
    "a.glb": (None, "does not exist"),
    "a.fbx": (b"x", "export the model as GLB"),
    "b.glb": (b"", "0 bytes"),
    "c.glb": (b"PK??", r"does not start as a \.glb"),
    "d.gltf": (b"{", "not a glTF file"),
    "e.gltf": (b"[" * 2000, "not a glTF file"),
    "f.spz": (b"nothing", r"does not start as a \.spz"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_other_files_are_refused(name: str, tmp_path: Path, store: ArtifactStore) -> None:
    content, sentence = REFUSED[name]
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(BadInput, match=sentence):
        put_model(tmp_path / name, store)


def test_a_model_needs_no_picture_and_takes_no_words(tmp_path: Path, store: ArtifactStore) -> None:
    (tmp_path / "a.glb").write_bytes(b"glTF same")
    request = ConversionRequest(item="a", asset=tmp_path / "a.glb", settings=PREVIEW)
    request.check()
    job = request.to_job(store)
    assert job.asset == job.source and not job.moving and job.source_name == "a.glb"
    with pytest.raises(BadInput, match="leave --text out"):
        request.model_copy(update={"text": "words"}).check()


@pytest.mark.parametrize("sides", ["views", "turntable", "cameras"])
def test_a_model_excludes_pictures_of_other_sides(sides: str, tmp_path: Path) -> None:
    (tmp_path / "a.glb").write_bytes(b"glTF same")
    (tmp_path / "a.png").write_bytes(PNG)
    path = tmp_path / "a.png"
    given = ViewsRequest.model_validate({sides: [{"azimuth": 180, "path": path}] if sides == "views" else path})
    request = ConversionRequest(item="a", picture=path, asset=tmp_path / "a.glb", settings=PREVIEW, given_views=given)
    with pytest.raises(BadInput, match=r"--asset: a\.glb has all sides .* give the model, or the pictures, not both"):
        request.check()
    request.model_copy(update={"given_views": ViewsRequest()}).check()


def test_a_mask_needs_a_picture_beside_the_model(tmp_path: Path) -> None:
    (tmp_path / "a.glb").write_bytes(b"glTF same")
    (tmp_path / "a.png").write_bytes(PNG)
    request = ConversionRequest(item="a", asset=tmp_path / "a.glb", mask=tmp_path / "a.png", settings=PREVIEW)
    with pytest.raises(BadInput, match="--mask marks the subject of a picture"):
        request.check()
    request.model_copy(update={"picture": tmp_path / "a.png"}).check()


def test_folders_are_no_models(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="is a folder"):
        check_model(tmp_path)
