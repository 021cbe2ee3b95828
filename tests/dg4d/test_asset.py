"""Assets as the API gives them, against the package that they come from."""

import html
import json
import re
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

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
    with pytest.raises(BadInput, match="no zip"):
        dg4d.load(tmp_path / "text.zip")


@pytest.mark.parametrize("name", ["../outside.txt", "/outside.txt", "a/../../outside.txt"])
def test_a_zip_that_leads_out_of_its_folder_is_refused(tmp_path: Path, name: str) -> None:
    with zipfile.ZipFile(tmp_path / "bad.zip", "w") as archive:
        archive.writestr(name, "x")
    with pytest.raises(BadInput, match="outside"):
        dg4d.load(tmp_path / "bad.zip")
    assert not list(tmp_path.parent.glob("outside.txt"))
