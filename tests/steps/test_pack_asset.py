"""The package: complete, true to its inputs, the same for the same request, and refused when parts do not fit."""

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest
import small_package
import torch
from small_package import FPS, FRAMES, NOTE, REACH, cloud, extracted, gem, inputs, job, packed, tracked

from dg4d_lib.assets.formats.glb import read_glb, read_mesh_glb
from dg4d_lib.assets.formats.splats import read_splats
from dg4d_lib.errors import BadInput
from steps.artifacts.archives import EPOCH
from steps.artifacts.media import read_png
from steps.artifacts.meshes import write_tracked
from steps.artifacts.packages import read_manifest
from steps.pack_asset import run

COMMON = {
    "asset.json", "asset.glb", "asset.usdz", "preview.mp4", "preview.webp", "turntable.mp4", "contact_sheet.png",
    "canonical/gaussians.ply", "canonical/asset4d.safetensors", "input/subject.png", "input/driving.mp4",
    "splats/moving.websplats",
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


def files(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def test_a_tracked_package_is_complete(package: Path) -> None:
    assert files(package) == COMMON | SPLATS | RIGGED


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
    asset = read_glb((package / "asset.glb").read_bytes())
    assert torch.equal(asset.offsets, tracked().offsets)
    assert asset.fps == FPS
    assert asset.extras["notes"] == [NOTE]
    assert asset.extras["generator"].startswith("dg4d ")


def test_another_frame_rate_keeps_the_length_and_the_frames(tmp_path: Path) -> None:
    folder = packed(tmp_path, fps=2 * FPS)
    manifest, asset, states = (
        read_manifest(folder),
        read_glb((folder / "asset.glb").read_bytes()),
        read_splats(folder / "splats"),
    )
    assert (manifest.frames, manifest.fps) == (len(asset.offsets), asset.fps) == (2 * FRAMES, 2 * FPS)
    assert manifest.duration_s == pytest.approx(FRAMES / FPS)
    assert len(states.means) == 2 * FRAMES
    torch.testing.assert_close(asset.offsets[::2], tracked().offsets, atol=1e-6, rtol=0)
    torch.testing.assert_close(states.means[::2, 0, 0], torch.linspace(0, REACH, FRAMES))
    assert states.means[1, 0, 0].item() == pytest.approx(REACH / 4)


def test_a_mesh_per_frame_keeps_the_rate_of_the_driving_video(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"48 are asked for.*mesh\.mode=tracked"):
        packed(tmp_path, "per_frame", fps=2 * FPS)


def test_levels_of_detail_have_their_share_of_the_triangles(tmp_path: Path) -> None:
    pytest.importorskip("meshoptimizer", reason="meshoptimizer is not installed: make clients")
    folder = packed(tmp_path, lods=(0.5,))
    level = read_glb((folder / "lod/1.glb").read_bytes())
    assert len(level.mesh.faces) <= len(gem().faces) / 2
    assert len(level.offsets) == FRAMES


def test_what_is_not_wanted_is_not_written(tmp_path: Path) -> None:
    folder = packed(tmp_path, usd=False, spz=False, rig=False, splats=False, splat_gltf="ratified")
    assert files(folder) == COMMON - {"asset.usdz"} | {f"splats/{i:03d}.glb" for i in range(FRAMES)}


def test_the_splats_move_as_the_motion_says(package: Path) -> None:
    states = read_splats(package / "splats")
    torch.testing.assert_close(states.means[-1], cloud().means + torch.tensor([REACH, 0, 0]))
    torch.testing.assert_close(states.means[0], cloud().means)


def test_every_frame_has_its_own_mesh(per_frame: Path) -> None:
    radii = [
        read_mesh_glb((per_frame / name).read_bytes()).vertices.norm(dim=1).max().item() for name in sorted(MESHES)
    ]
    assert radii == pytest.approx([0.2, 0.3, 0.4])


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
