"""Assets as the API gives them, against the package that they come from."""

import html
import json
import math
import re
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from recording import add_record

import dg4d
from dg4d.asset import Asset
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.ply import read_ply
from steps.artifacts.packages import Manifest
from tests.steps.small_package import FPS, FRAMES, REACH, cloud, packed, tracked


def test_an_asset_tells_its_frames_and_its_name(gem: Path) -> None:
    asset = dg4d.load(gem)
    assert (asset.frames, asset.fps, asset.name) == (FRAMES, FPS, "gem <&> stone")
    assert asset.duration_s == pytest.approx(FRAMES / FPS)
    assert "3 frames at 24 fps" in repr(asset)


def test_the_mesh_moves_and_the_loop_closes(gem: Path) -> None:
    asset = dg4d.load(gem)
    first, second = asset.mesh(0.0), asset.mesh(1 / FPS)
    assert first.faces.shape == tuple(tracked().mesh.faces.shape)
    np.testing.assert_allclose(second.vertices - first.vertices, [[REACH / 2, 0, 0]] * len(first.vertices), atol=1e-3)
    half = asset.mesh(2.5 / FPS)  # on its way from the last frame back to the first
    np.testing.assert_allclose(half.vertices - first.vertices, [[REACH / 2, 0, 0]] * len(first.vertices), atol=1e-3)
    for t in (asset.duration_s, -asset.duration_s, 5 * asset.duration_s):
        np.testing.assert_allclose(asset.mesh(t).vertices, first.vertices, atol=1e-3)


def test_meshes_and_gaussians_are_where_the_files_have_them(gem: Path) -> None:
    asset = dg4d.load(gem)
    np.testing.assert_allclose(asset.mesh().bounds, trimesh.load_scene(gem / "asset.glb").bounds, atol=1e-3)
    assert asset.mesh().bounds[0, 1] == pytest.approx(0, abs=1e-3)  # on the ground
    splats = read_ply(gem / "splats" / "000.ply", y_down=True)
    torch.testing.assert_close(asset.gaussians().means, splats.means, atol=1e-3, rtol=0)


@pytest.mark.parametrize(("frames", "fps"), [(29, 25.0), (61, 29.97), (14, 10.0)])
def test_the_time_of_a_frame_is_that_frame(frames: int, fps: float) -> None:
    asset = object.__new__(Asset)
    asset.manifest = Manifest.model_construct(frames=frames, fps=fps)
    positions = [float(asset._position(frame / fps)) for frame in range(3 * frames)]
    assert positions == [frame % frames for frame in range(3 * frames)]
    assert float(asset._position(0.3 - 0.1 * 3)) == 0  # not `frames`, of which there is no mesh


def test_the_texture_is_where_trimesh_looks_for_it(gem: Path) -> None:
    mesh = dg4d.load(gem).mesh()
    colors = mesh.visual.to_color().vertex_colors[:, :3] / 255
    np.testing.assert_allclose(colors, [[0.2, 0.4, 0.8]] * len(colors), atol=0.01)


def test_a_mesh_per_frame_stays_until_the_next(tmp_path: Path) -> None:
    folder = packed(tmp_path, "per_frame")
    add_record(folder)
    asset = dg4d.load(folder)
    sizes = [np.abs(asset.mesh(frame / FPS).vertices).max() for frame in (0.0, 0.9, 1.0, 2.0)]
    assert sizes[0] == sizes[1] < sizes[2] < sizes[3]


def test_the_gaussians_move_with_the_asset(gem: Path) -> None:
    asset = dg4d.load(gem)
    for frame in range(FRAMES):
        moved = asset.gaussians(frame / FPS)
        shift = torch.tensor([REACH * frame / (FRAMES - 1), 0, 0])
        expected = asset.manifest.placement.placement.points(cloud().means + shift)
        assert len(moved) == 9
        torch.testing.assert_close(moved.means, expected, atol=1e-3, rtol=0)


@pytest.mark.parametrize("mesh", [False, True])
def test_a_rendering_is_a_picture_with_alpha(gem: Path, mesh: bool) -> None:
    camera = dg4d.Camera(azimuth_deg=20.0, width=48, height=40)
    picture = dg4d.load(gem).render(camera, 1 / FPS, mesh=mesh)
    assert picture.shape == (40, 48, 4) and picture.dtype == np.float32
    assert picture.min() >= 0 and picture.max() <= 1
    inside = picture[..., 3] > 0.5
    assert 0.01 < inside.mean() < 0.6
    assert picture[inside][:, 2].mean() > picture[inside][:, 0].mean()  # blue


@pytest.fixture
def undrawn(gem: Path) -> Asset:
    """An asset that must not be rendered: pictures without pixels end the process."""

    def draw(*_: object) -> None:
        raise AssertionError("rendered")

    asset = dg4d.load(gem)
    vars(asset).update(_render_gaussians=draw, _render_mesh=draw)
    return asset


@pytest.mark.parametrize(
    "wrong",
    [
        {"width": 0}, {"height": -5}, {"fov_y_deg": 0.0}, {"fov_y_deg": 180.0}, {"fov_y_deg": math.nan},
        {"radius": -2.0}, {"radius": math.inf}, {"azimuth_deg": math.nan}, {"elevation_deg": math.inf},
    ],
)  # fmt: skip
@pytest.mark.parametrize("mesh", [False, True])
def test_a_camera_out_of_range_is_refused_before_rendering(undrawn: Asset, wrong: dict[str, Any], mesh: bool) -> None:
    with pytest.raises(BadInput, match="given"):
        undrawn.render(dg4d.Camera(**wrong), mesh=mesh)


@pytest.mark.parametrize(("width", "height"), [(4097, 4), (4, 4097), (32.5, 4), (0, 4)])
def test_a_picture_that_is_too_large_or_has_parts_of_pixels_is_refused(undrawn: Asset, width: Any, height: int) -> None:
    camera: Any = SimpleNamespace(width=width, height=height)  # the type checker of the tests refuses such a camera
    with pytest.raises(BadInput, match=rf"{width} x {height} pixels; .* whole numbers from 1 to 4096"):
        undrawn.render(camera)


@pytest.mark.parametrize("mesh", [False, True])
def test_a_picture_of_one_pixel_is_rendered(gem: Path, mesh: bool) -> None:
    camera = dg4d.Camera(width=1, height=1, fov_y_deg=5)
    assert dg4d.load(gem).render(camera, mesh=mesh).shape == (1, 1, 4)


def test_an_unknown_time_is_refused(gem: Path) -> None:
    with pytest.raises(BadInput, match="seconds"):
        dg4d.load(gem).mesh(float("nan"))


def test_the_glb_is_saved_as_it_is(gem: Path, tmp_path: Path) -> None:
    path = dg4d.load(gem).save_glb(tmp_path / "gem.glb")
    assert path.read_bytes() == (gem / "asset.glb").read_bytes()
    with pytest.raises(BadInput, match="cannot be written"):
        dg4d.load(gem).save_glb(tmp_path / "gem.glb" / "below.glb")


def test_a_zip_loads_without_and_with_a_record(gem: Path, tmp_path: Path) -> None:
    for name, left_out in (("bare.zip", "provenance.json"), ("whole.zip", "")):
        with zipfile.ZipFile(tmp_path / name, "w") as archive:
            for path in sorted(gem.rglob("*")):
                if path.is_file() and path.name != left_out:
                    archive.write(path, path.relative_to(gem).as_posix())
        asset = dg4d.load(tmp_path / name)
        assert asset.frames == FRAMES and "<iframe" in asset._repr_html_()
        folder = asset.folder
        del asset
        assert not folder.exists()


def zipped(folder: Path, path: Path, below: str) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for file in sorted(folder.rglob("*")):
            if file.is_file():
                archive.write(file, below + file.relative_to(folder).as_posix())
    return path


@pytest.mark.parametrize("beside", ["", "README.txt", "__MACOSX/gem/._asset.json"])
def test_a_zip_of_the_folder_itself_loads(gem: Path, tmp_path: Path, beside: str) -> None:
    path = zipped(gem, tmp_path / "z.zip", "gem/")
    if beside:
        with zipfile.ZipFile(path, "a") as archive:
            archive.writestr(beside, "x")
    asset = dg4d.load(path)
    assert asset.name == "gem <&> stone" and asset.mesh().faces.size and "<iframe" in asset._repr_html_()
    folder = asset.folder
    del asset
    assert not folder.exists() and not folder.parent.exists()


@pytest.mark.parametrize(
    ("names", "says"),
    [
        (["a.txt"], r"z\.zip is not an asset: it has no asset\.json"),
        (["a/asset.json", "b/asset.json"], r"z\.zip is not an asset: it has no asset\.json"),
        (["a/asset.json"], r"z\.zip/a/asset\.json cannot be used"),
    ],
)
def test_a_zip_that_is_not_an_asset_is_refused_by_its_name(tmp_path: Path, names: list[str], says: str) -> None:
    path = tmp_path / "z.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for name in names:
            archive.writestr(name, "x")
    with pytest.raises(BadInput, match=says) as refused:
        dg4d.load(path)
    assert str(refused.value).startswith(str(path)) and "dg4d-asset-" not in str(refused.value)


def test_a_damaged_zip_is_refused_by_its_name(gem: Path, tmp_path: Path) -> None:
    folder = tmp_path / "gem"
    shutil.copytree(gem, folder)
    (folder / "asset.glb").write_bytes(b"other")
    with pytest.raises(BadInput, match=r"z\.zip/gem is damaged: asset\.glb was altered") as refused:
        dg4d.load(zipped(folder, tmp_path / "z.zip", "gem/"))
    assert "dg4d-asset-" not in str(refused.value)


def test_the_report_is_read_and_a_broken_one_refused(gem: Path, tmp_path: Path) -> None:
    folder = tmp_path / "gem"
    shutil.copytree(gem, folder)
    assert dg4d.load(folder).report == {} and dg4d.load(folder).failing is None
    (folder / "report.json").write_text(json.dumps({"wall_s": 3, "acceptance": {"failing": ["flaws"]}}))
    assert dg4d.load(folder).report["wall_s"] == 3 and dg4d.load(folder).failing == ["flaws"]
    (folder / "report.json").write_text("{")
    with pytest.raises(BadInput, match="make the asset again"):
        _ = dg4d.load(folder).report


def test_an_asset_whose_folder_holds_another_one_is_refused(gem: Path, tmp_path: Path) -> None:
    folder = tmp_path / "gem"
    shutil.copytree(gem, folder)
    asset, read = dg4d.load(folder), dg4d.load(folder)
    mesh = read.mesh()
    (folder / "asset.glb").write_bytes(b"other")
    add_record(folder)
    lazy: list[Callable[[], object]] = [
        asset.mesh, asset.gaussians, asset.render, asset._repr_html_, lambda: asset.report, lambda: asset.failing,
        lambda: asset.save_glb(tmp_path / "gem.glb"),
    ]  # fmt: skip
    for reading in lazy:
        with pytest.raises(BadInput, match=r"now holds another asset.*out="):
            reading()
    np.testing.assert_array_equal(read.mesh().vertices, mesh.vertices)  # as it was read before


def test_a_notebook_gets_the_viewer_in_a_frame_that_cannot_reach_the_page(gem: Path) -> None:
    shown = dg4d.load(gem)._repr_html_()
    match = re.fullmatch(r'<iframe title="([^"]*)" sandbox="([^"]*)" [^<>]*srcdoc="([^"]*)"></iframe>', shown)
    assert match
    assert html.unescape(match[1]) == "gem <&> stone"
    assert match[2].split() == ["allow-scripts", "allow-downloads"]  # never allow-same-origin beside scripts
    page = html.unescape(match[3])
    assert page.lower().startswith("<!doctype html>") and "Content-Security-Policy" in page


def test_a_package_that_was_altered_or_is_none_is_refused(gem: Path, tmp_path: Path) -> None:
    folder = tmp_path / "gem"
    shutil.copytree(gem, folder)
    (folder / "asset.glb").write_bytes(b"other")
    with pytest.raises(BadInput, match=r"asset\.glb was altered"):
        dg4d.load(folder)
    with pytest.raises(BadInput, match="does not exist"):
        dg4d.load(tmp_path / "nothing")
    (tmp_path / "text.zip").write_text("no zip")
    with pytest.raises(BadInput, match="not a zip"):
        dg4d.load(tmp_path / "text.zip")


@pytest.mark.parametrize("name", ["../outside.txt", "/outside.txt", "a/../../outside.txt"])
def test_a_zip_that_leads_out_of_its_folder_is_refused(tmp_path: Path, name: str) -> None:
    with zipfile.ZipFile(tmp_path / "bad.zip", "w") as archive:
        archive.writestr(name, "x")
    with pytest.raises(BadInput, match="outside"):
        dg4d.load(tmp_path / "bad.zip")
    assert not list(tmp_path.parent.glob("outside.txt"))
