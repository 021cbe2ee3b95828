"""The package: complete, true to its inputs, the same for the same request, and refused when parts do not fit."""

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import small_package
import torch
import trimesh
from pxr import Usd, UsdGeom
from pydantic import ValidationError
from small_package import FPS, FRAMES, NOTE, REACH, cloud, extracted, gem, inputs, job, packed, tracked

from dg4d_lib.asset_settings import SMALLEST_HEIGHT_M, PackSettings
from dg4d_lib.assets import resample
from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.assets.formats.glb import read_glb
from dg4d_lib.assets.formats.splats import read_splats
from dg4d_lib.assets.placement import Placement
from dg4d_lib.cameras.orbit import FOV_Y_DEG
from dg4d_lib.cameras.viewpoints import whole_fov_y_deg
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.ply import write_ply
from dg4d_lib.mesh.textured import TexturedMesh, TrackedMesh
from dg4d_lib.mesh.texturing.bake import locate_texels
from dg4d_lib.mesh.texturing.unwrap import unwrap
from steps import pack_asset
from steps.artifacts.archives import EPOCH
from steps.artifacts.media import read_png
from steps.artifacts.meshes import write_tracked
from steps.artifacts.packages import WIDEST_FOV_DEG, Camera, PackagePlacement, read_manifest
from steps.artifacts.rendering import read_states, read_surface
from steps.pack_asset import run

COMMON = {
    "asset.json", "asset.glb", "asset.usdz", "asset_splats.usdz", "preview.mp4", "preview.webp", "turntable.mp4",
    "contact_sheet.png", "canonical/gaussians.ply", "canonical/asset4d.safetensors", "input/subject.png",
    "input/driving.mp4", "splats/moving.websplats",
}  # fmt: skip
SPLATS = {f"splats/{i:03d}.{form}" for i in range(FRAMES) for form in ("ply", "spz")}
RIGGED = {"asset_rigged.glb"}
MESHES = {f"meshes/{i:03d}.glb" for i in range(FRAMES)}


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return packed(tmp_path_factory.mktemp("tracked"))


@pytest.fixture(scope="module")
def per_frame(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return packed(tmp_path_factory.mktemp("per_frame"), "per_frame", splats=False, spz=False)


def surface(folder: Path) -> Asset4D:
    """Return the tracked mesh in the coordinates of the fit."""
    return read_surface(folder, read_manifest(folder))


def poses(asset: Asset4D) -> torch.Tensor:
    return asset.mesh.vertices + asset.offsets


def stored_states(folder: Path, frames: int) -> Gaussians:
    """Return the splats of a package in the coordinates of the fit."""
    return read_states(folder, read_manifest(folder))(torch.arange(frames, dtype=torch.float64))


def files(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def test_a_tracked_package_is_complete(package: Path) -> None:
    assert files(package) == COMMON | SPLATS | RIGGED


def test_a_rig_that_misses_the_motion_is_for_playback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pack_asset, "PRECISE", -1.0)
    folder = packed(tmp_path)
    assert files(folder) == COMMON | SPLATS | {"asset_playback.glb"}
    assert any("in asset_playback.glb, and asset.glb is exact" in note for note in read_manifest(folder).notes)


def test_a_package_of_a_mesh_per_frame_is_complete(per_frame: Path) -> None:
    assert files(per_frame) == COMMON | MESHES


def test_the_manifest_says_what_is_there(package: Path, per_frame: Path) -> None:
    for folder, mode, meshes in ((package, "tracked", 1), (per_frame, "per_frame", FRAMES)):
        manifest = read_manifest(folder)
        assert (manifest.mode, manifest.fps, manifest.frames, manifest.gaussians) == (mode, FPS, FRAMES, 9)
        assert manifest.duration_s == pytest.approx(FRAMES / FPS)
        assert manifest.vertices == (len(gem().vertices),) * meshes
        assert manifest.triangles == (len(gem().faces),) * meshes
        assert set(manifest.files) == files(folder) - {"asset.json"}
        assert manifest.notes[0] == NOTE
    assert any(note.startswith("rig: 1 bone ") for note in read_manifest(package).notes)


def test_the_glb_moves_as_the_tracked_mesh_and_says_how_it_was_made(package: Path) -> None:
    asset = surface(package)
    torch.testing.assert_close(poses(asset), poses(tracked()), atol=3e-5, rtol=0)  # 16 bits
    assert asset.fps == FPS
    assert asset.extras["notes"] == [NOTE]
    assert asset.extras["generator"].startswith("dg4d ")


def test_delight_evens_the_texture_out(tmp_path: Path) -> None:
    """A gray ball that is lit from above."""
    shape = trimesh.creation.icosphere(2, radius=0.3)
    unwrapped = unwrap(shape.vertices.astype(np.float32), shape.faces.astype(np.int32), 64)
    sources, faces, uvs = map(torch.from_numpy, unwrapped)
    vertices = torch.from_numpy(shape.vertices.astype(np.float32))[sources]
    texels = locate_texels(vertices, vertices, faces, uvs, 64)
    texture = torch.full((64, 64, 3), 0.5)
    texture[texels.rows, texels.columns] += 0.5 * texels.positions[:, 1:2]
    offsets = tracked().offsets[:, :1].expand(FRAMES, len(vertices), 3)
    spreads = []
    for lit in (False, True):
        given = inputs(tmp_path / f"inputs_{lit}")
        write_tracked(given["tracked"], TrackedMesh(TexturedMesh(vertices, faces, uvs, texture), offsets))
        out = job(given, tmp_path / f"out_{lit}", delight=lit, rig=False, usd=False, splats=False, spz=False)
        run(out)
        with zipfile.ZipFile(out.outputs["package"]) as archive:
            archive.extractall(tmp_path / f"asset_{lit}")
        shown = surface(tmp_path / f"asset_{lit}").mesh.texture[texels.rows, texels.columns]
        spreads.append(float(shown.mean(1).std()))
    assert spreads[1] < 0.3 * spreads[0]


def test_another_frame_rate_keeps_the_length_and_the_frames(tmp_path: Path) -> None:
    folder = packed(tmp_path, fps=2 * FPS)
    manifest, asset, states = (
        read_manifest(folder),
        surface(folder),
        stored_states(folder, 2 * FRAMES),
    )
    assert (manifest.frames, manifest.fps) == (len(asset.offsets), asset.fps) == (2 * FRAMES, 2 * FPS)
    assert manifest.duration_s == pytest.approx(FRAMES / FPS)
    assert len(states.means) == 2 * FRAMES
    torch.testing.assert_close(poses(asset)[::2], poses(tracked()), atol=3e-5, rtol=0)
    torch.testing.assert_close(states.means[::2, 0, 0], torch.linspace(0, REACH, FRAMES))
    assert states.means[1, 0, 0].item() == pytest.approx(REACH / 4, abs=1e-6)


@pytest.mark.parametrize(
    ("mode", "fps", "states", "reason"),
    [
        ("per_frame", 48.0, FRAMES, "every frame has its own mesh"),
        ("tracked", 48.0, 5, "at most 5 states"),
        ("tracked", 1.0, FRAMES, f"at least {FRAMES} states"),
    ],
)
def test_a_rate_that_cannot_be_had_is_noted(
    mode: str, fps: float, states: int, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resample, "MAX_STATES", 5)
    manifest = read_manifest(packed(tmp_path, mode, fps=fps, splats=False, spz=False, rig=False, usd=False))
    assert (manifest.frames, manifest.fps) == (states, pytest.approx(states / FRAMES * FPS))
    assert (
        f"the files have {manifest.fps:g} frames per second instead of {fps:g} (pack.fps): {reason}" in manifest.notes
    )


def test_the_smallest_height_makes_a_package(tmp_path: Path) -> None:
    folder = packed(tmp_path, height_m=SMALLEST_HEIGHT_M, rig=False, usd=False, splats=False, spz=False)
    low, high = trimesh.load(folder / "asset.glb").bounds
    assert high[1] - low[1] == pytest.approx(SMALLEST_HEIGHT_M, rel=1e-3)


@pytest.mark.parametrize("height_m", [1e-300, 0.9 * SMALLEST_HEIGHT_M])
def test_a_height_that_floating_point_numbers_do_not_hold_is_refused(height_m: float) -> None:
    with pytest.raises(ValidationError, match="use 0 for one meter per unit of the fit, or 1e-06 to 1000"):
        PackSettings(height_m=height_m)


def test_formats_that_lose_something_are_noted(tmp_path: Path) -> None:
    folder = packed(tmp_path, height_m=1e-4, gltf={"components": 1}, rig=False, usd=False, splats=False)
    notes = read_manifest(folder).notes
    assert any("100% of the splats" in note and "pack.height_m" in note for note in notes)
    (missed,) = (note for note in notes if note.startswith("asset.glb misses the motion by "))
    assert float(missed.split()[5]) > 1e-7  # world units; in meters, it is 7500 times smaller


def test_levels_of_detail_have_their_share_of_the_triangles(tmp_path: Path) -> None:
    pytest.importorskip("meshoptimizer", reason="meshoptimizer is not installed: make clients")
    folder = packed(tmp_path, lods=(0.5,))
    level = read_glb((folder / "lod/1.glb").read_bytes())
    assert len(level.mesh.faces) <= len(gem().faces) / 2
    assert len(level.offsets) == FRAMES


def test_what_is_not_wanted_is_not_written(tmp_path: Path) -> None:
    folder = packed(tmp_path, usd=False, spz=False, rig=False, splats=False, splat_gltf="ratified")
    assert files(folder) == COMMON - {"asset.usdz", "asset_splats.usdz"} | {
        f"splats/{i:03d}.glb" for i in range(FRAMES)
    }


def test_the_splats_move_as_the_motion_says(package: Path) -> None:
    states = stored_states(package, FRAMES)
    expected = cloud().means
    torch.testing.assert_close(states.means[-1], expected + torch.tensor([REACH, 0, 0]), atol=1e-6, rtol=0)
    torch.testing.assert_close(states.means[0], expected, atol=1e-6, rtol=0)


def test_every_file_stands_on_the_ground_at_its_height(tmp_path: Path) -> None:
    folder = packed(tmp_path, height_m=0.12)
    manifest = read_manifest(folder)
    asset = read_glb((folder / "asset.glb").read_bytes())
    glb = poses(asset)
    low, high = glb.amin((0, 1)), glb.amax((0, 1))
    assert low[1].item() == pytest.approx(0.0, abs=1e-5)
    assert (glb[0, :, 1].max() - glb[0, :, 1].min()).item() == pytest.approx(0.12, abs=1e-5)
    torch.testing.assert_close((low + high)[::2], torch.zeros(2), atol=1e-5, rtol=0)
    center = glb[0].mean(0)  # of the gem and of the cloud
    torch.testing.assert_close(read_splats(folder / "splats").means[0].mean(0), center, atol=1e-5, rtol=0)
    web = (folder / "splats/moving.websplats").read_bytes()
    header = json.loads(web[8 : 8 + int.from_bytes(web[4:8], "little")])
    assert header["corner"][1] == pytest.approx(center[1].item() - 0.15 * manifest.placement.scale, abs=1e-5)
    stage = Usd.Stage.Open(str(folder / "asset.usdz"))
    extent = UsdGeom.Boundable(stage.GetPrimAtPath("/asset/mesh")).GetExtentAttr()
    torch.testing.assert_close(torch.tensor(np.array(extent.Get(0))[0]), glb[0].amin(0), atol=1e-3, rtol=0)
    camera = manifest.camera
    assert camera.radius == pytest.approx(2 * manifest.placement.scale)
    assert camera.target == manifest.placement.translation
    assert camera.target[1] == pytest.approx(center[1].item(), abs=1e-5)  # the gem surrounds the point it looks at


def test_the_manifest_says_which_field_of_view_holds_the_whole_animation(package: Path, tmp_path: Path) -> None:
    assert read_manifest(package).camera.whole_fov_y_deg == FOV_Y_DEG
    given, large = job(inputs(tmp_path / "inputs"), tmp_path / "out"), replace(cloud(), means=6 * cloud().means)
    write_ply(given.inputs["gaussians"], large)
    run(given)
    with zipfile.ZipFile(given.outputs["package"]) as archive:
        archive.extract("asset.json", tmp_path)
    expected = whole_fov_y_deg((large.means + torch.tensor([REACH, 0, 0]))[None])
    assert FOV_Y_DEG < read_manifest(tmp_path).camera.whole_fov_y_deg == pytest.approx(expected, abs=0.05)


def test_the_widest_field_of_view_is_below_180_degrees() -> None:
    assert Camera.placed(Placement(), 179.99).whole_fov_y_deg == WIDEST_FOV_DEG < 180


def test_the_manifest_leads_back_to_the_fit(package: Path, tmp_path: Path) -> None:
    """Renders do not depend on height and ground, because cameras orbit the coordinates of the fit."""
    plain = packed(tmp_path, ground=False)
    assert read_manifest(plain).placement == PackagePlacement()
    torch.testing.assert_close(poses(surface(package)), poses(surface(plain)), atol=3e-5, rtol=0)
    ours, theirs = stored_states(package, FRAMES), stored_states(plain, FRAMES)
    torch.testing.assert_close(ours.means, theirs.means, atol=1e-6, rtol=0)


def test_every_frame_has_its_own_mesh(per_frame: Path) -> None:
    meshes = read_surface(per_frame, read_manifest(per_frame))
    radii = [mesh.vertices.norm(dim=1).max().item() for mesh in meshes]
    assert radii == pytest.approx([0.2, 0.3, 0.4], abs=3e-5)


def test_inputs_are_handed_on_byte_by_byte(package: Path) -> None:
    given = inputs(package.parent / "inputs")
    assert (package / "canonical/gaussians.ply").read_bytes() == given["gaussians"].read_bytes()
    assert (package / "input/subject.png").read_bytes() == given["subject"].read_bytes()


def test_the_sheet_is_also_an_output_of_its_own(package: Path) -> None:
    sheet = package.parent / "out/sheet.png"
    assert sheet.read_bytes() == (package / "contact_sheet.png").read_bytes()
    assert read_png(sheet).shape[2] == 3


def test_the_same_request_gives_the_same_bytes(package: Path, tmp_path: Path) -> None:
    run(job(inputs(tmp_path / "inputs"), tmp_path / "out"))
    again, first = tmp_path / "out/package.zip", package.parent / "out/package.zip"
    assert again.read_bytes() == first.read_bytes()


def test_entries_are_stored_with_a_fixed_date_and_the_manifest_first(package: Path) -> None:
    with zipfile.ZipFile(package.parent / "out/package.zip") as archive:
        entries = archive.infolist()
    assert entries[0].filename == "asset.json"
    assert {entry.date_time for entry in entries} == {EPOCH}
    assert {entry.compress_type for entry in entries} == {zipfile.ZIP_STORED}


def test_progress_counts_up_to_its_total(tmp_path: Path) -> None:
    heard: list[tuple[int, int]] = []
    given = job(inputs(tmp_path / "inputs"), tmp_path / "out")
    run(replace(given, progress=lambda done, total, values: heard.append((done, total))))
    assert heard == sorted(heard)
    assert heard[-1][0] == heard[-1][1] > 0


def test_a_mesh_of_another_motion_is_refused(tmp_path: Path) -> None:
    given = inputs(tmp_path / "inputs")
    write_tracked(given["tracked"], extracted(frames=2))
    with pytest.raises(BadInput, match="has 3 frames, but: mesh 2"):
        run(job(given, tmp_path / "out"))


def test_the_driving_video_sets_the_frame_rate(tmp_path: Path) -> None:
    given = inputs(tmp_path / "inputs")
    run(job(given, tmp_path / "out"))
    with zipfile.ZipFile(tmp_path / "out/package.zip") as archive:
        assert read_glb(archive.read("asset.glb")).fps == FPS


def test_a_single_frame_stands_still_in_every_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(small_package, "FRAMES", 1)
    given = inputs(tmp_path / "inputs")
    write_tracked(given["tracked"], extracted(frames=1))
    run(job(given, tmp_path / "out"))
    with zipfile.ZipFile(tmp_path / "out/package.zip") as archive:
        names = set(archive.namelist())
        manifest = json.loads(archive.read("asset.json"))
    assert COMMON | RIGGED | {"splats/000.ply", "splats/000.spz"} == names
    assert (manifest["frames"], manifest["duration_s"]) == (1, pytest.approx(1 / FPS))


def test_a_package_needs_one_kind_of_mesh(tmp_path: Path) -> None:
    given = inputs(tmp_path / "inputs")
    both = {**given, **inputs(tmp_path / "inputs", "per_frame")}
    neither = {port: path for port, path in given.items() if port != "tracked"}
    for wrong in (both, neither):
        with pytest.raises(BadInput, match="one kind of mesh"):
            run(job(wrong, tmp_path / "out"))


@pytest.mark.parametrize(
    ("change", "says"),
    [({"format": "other"}, "format"), ({"fps": 0}, "fps"), ({"version": 2}, "version"), ({"surprise": 1}, "surprise")],
)
def test_a_foreign_manifest_is_refused(package: Path, tmp_path: Path, change: dict[str, object], says: str) -> None:
    content = json.loads((package / "asset.json").read_text())
    (tmp_path / "asset.json").write_text(json.dumps(content | change))
    with pytest.raises(BadInput, match=says):
        read_manifest(tmp_path)
