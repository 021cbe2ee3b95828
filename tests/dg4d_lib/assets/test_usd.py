"""Animated meshes and splats as USDZ: validity and third-party readers."""

import io
import json
import math
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from pxr import Usd, UsdGeom, UsdShade, UsdUtils, UsdValidation
from usd_samples import FPS, FRAMES, ball, balls, cloud, colorful_ball, growing_ball, torn_ball

from dg4d_lib.asset_settings import GltfSettings
from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.assets.formats.usd import UsdPlacement, compose_usdz, write_usdz
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.textured import TexturedMesh
from tests.clients.node import run_node

PNG = GltfSettings(image="png")


def code(frame: float, fps: float = FPS) -> float:
    """Return the time code of a frame."""
    return 24 * frame / fps


def at(x: float = 0.0, turn_deg: float = 0.0, scale: float = 1.0) -> torch.Tensor:
    """Scaled, then turned around y, then put beside the origin."""
    c, s = scale * math.cos(math.radians(turn_deg)), scale * math.sin(math.radians(turn_deg))
    return torch.tensor([[c, 0, s, x], [0, scale, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1.0]])


def two_assets(folder: Path) -> list[UsdPlacement]:
    """One placed twice, and another with twice its frame rate."""
    write_usdz(folder / "slow.usdz", growing_ball(), FPS)
    write_usdz(folder / "fast.usdz", balls(), 2 * FPS)
    return [
        UsdPlacement("a bear", folder / "slow.usdz", at()),
        UsdPlacement("a bear", folder / "slow.usdz", at(2.0, 90.0, 0.5), start_s=0.5, speed=2.0),
        UsdPlacement("くま 2", folder / "fast.usdz", at(-2.0)),
    ]


WRITTEN = {
    "tracked": lambda path: write_usdz(path, growing_ball(), FPS),
    "torn": lambda path: write_usdz(path, torn_ball(), FPS),
    "with splats": lambda path: write_usdz(path, growing_ball(), FPS, cloud()),
    "half splats": lambda path: write_usdz(path, growing_ball(), FPS, cloud(), half=True),
    "changing textures": lambda path: write_usdz(path, colorful_ball(), FPS),
    "per frame": lambda path: write_usdz(path, balls(), FPS, cloud()),
    "one frame": lambda path: write_usdz(path, growing_ball(1), FPS, cloud(1)),
    "one mesh": lambda path: write_usdz(path, balls(1), FPS),
    "scene": lambda path: compose_usdz(path, two_assets(path.parent)),
}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a.usdz"


def corners(stage: Usd.Stage, name: str, time: float) -> np.ndarray:
    """Points of every triangle's corners, "f 3 3"; the product's own indices play no part."""
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(name))
    assert set(mesh.GetFaceVertexCountsAttr().Get(time)) <= {3}
    points = np.array(mesh.GetPointsAttr().Get(time)).reshape(-1, 3)
    return points[np.array(mesh.GetFaceVertexIndicesAttr().Get(time), int)].reshape(-1, 3, 3)


def expected_corners(asset: Asset4D, frame: int) -> np.ndarray:
    return (asset.mesh.vertices + asset.offsets[frame])[asset.mesh.faces].numpy()


def pictures(path: Path, layer_name: str = "/asset/mesh/materials/subject/color") -> dict[float | None, np.ndarray]:
    """The texture a package shows at every key, and without a time (None)."""
    stage = Usd.Stage.Open(str(path))
    texture = UsdShade.Shader(stage.GetPrimAtPath(layer_name)).GetInput("file").GetAttr()
    found = {}
    with zipfile.ZipFile(path) as package:
        for time in (None, *texture.GetTimeSamples()):
            value = texture.Get() if time is None else texture.Get(time)
            assert value.resolvedPath == f"{path}[{value.path.removeprefix('./')}]", "the file is in the package"
            found[time] = np.array(Image.open(io.BytesIO(package.read(value.path.removeprefix("./")))))
    return found


def faults(stage: Usd.Stage) -> list[str]:
    """Return the findings of all OpenUSD validators."""
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) >= 25
    return [error.GetMessage() for error in UsdValidation.ValidationContext(validators).Validate(stage)]


@pytest.mark.parametrize("kind", WRITTEN)
def test_no_validator_finds_anything(kind: str, path: Path) -> None:
    WRITTEN[kind](path)
    stage = Usd.Stage.Open(str(path))
    assert faults(stage) == []
    for prim in [prim for prim in stage.Traverse() if prim.GetVariantSets().GetNames()]:
        prim.GetVariantSet("representation").SetVariantSelection("mesh")
    assert faults(stage) == []


def test_validators_without_materialx_know_nothing_but_its_shaders(path: Path) -> None:
    write_usdz(path, colorful_ball(), FPS, open_pbr=True)  # usd-core has no MaterialX, so its nodes are not registered
    found = faults(Usd.Stage.Open(str(path)))
    assert len(found) == 3
    assert all("shaderId 'ND_" in fault and "not found in sdrRegistry" in fault for fault in found)


def test_the_validators_find_something_in_a_broken_file(path: Path) -> None:
    WRITTEN["tracked"](path)
    stage = Usd.Stage.Open(str(path))
    stage.GetPrimAtPath("/asset/mesh/subject").RemoveAPI(UsdShade.MaterialBindingAPI)
    assert len(faults(stage)) == 1


@pytest.mark.parametrize("kind", WRITTEN)
def test_everything_a_package_needs_is_inside_aligned_and_without_dates(kind: str, path: Path) -> None:
    WRITTEN[kind](path)
    layers, assets, missing = UsdUtils.ComputeAllDependencies(str(path))
    assert not missing
    assert all(layer.identifier.startswith(str(path)) for layer in layers)
    assert all(asset.startswith(f"{path}[") for asset in assets)
    content = path.read_bytes()
    with zipfile.ZipFile(path) as package:
        assert package.testzip() is None
        entries = package.infolist()
    assert entries[0].filename.endswith(".usdc")
    for entry in entries:
        name_length, extra_length = np.frombuffer(content, "<u2", 2, entry.header_offset + 26)
        assert (entry.header_offset + 30 + name_length + extra_length) % 64 == 0
        assert (entry.compress_type, entry.date_time) == (zipfile.ZIP_STORED, (1980, 1, 1, 0, 0, 0))


@pytest.mark.parametrize("kind", ["with splats", "half splats", "changing textures", "per frame", "scene"])
def test_equal_input_gives_equal_bytes(kind: str, path: Path) -> None:
    WRITTEN[kind](path)
    other = path.parent / "elsewhere"
    other.mkdir()
    WRITTEN[kind](other / "b.usdz")
    assert path.read_bytes() == (other / "b.usdz").read_bytes()


def test_the_stage_says_what_its_numbers_mean(path: Path) -> None:
    write_usdz(path, growing_ball(), 23.976)
    stage = Usd.Stage.Open(str(path))
    assert str(stage.GetDefaultPrim().GetPath()) == "/asset"
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert (stage.GetTimeCodesPerSecond(), stage.GetFramesPerSecond()) == (24, 24)
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, code(FRAMES, 23.976))


@pytest.mark.parametrize("make", [growing_ball, torn_ball])
def test_a_tracked_mesh_moves_as_given_and_ends_where_it_began(make: Any, path: Path) -> None:
    write_usdz(path, make(), FPS)
    stage = Usd.Stage.Open(str(path))
    for frame in range(FRAMES + 1):
        found = corners(stage, "/asset/mesh/subject", code(frame))
        assert np.array_equal(found, expected_corners(make(), frame % FRAMES))
    between = (expected_corners(make(), 1) + expected_corners(make(), 2)) / 2
    np.testing.assert_allclose(corners(stage, "/asset/mesh/subject", code(1.5)), between, atol=1e-6)


@pytest.mark.parametrize(("make", "points"), [(growing_ball, 42), (torn_ball, 240)])
def test_only_vertices_that_stay_together_are_one_point(make: Any, points: int, path: Path) -> None:
    write_usdz(path, make(), FPS)
    stage = Usd.Stage.Open(str(path))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/asset/mesh/subject"))
    assert len(mesh.GetPointsAttr().Get(0)) == points


def test_bounds_and_normals_follow_the_motion(path: Path) -> None:
    squeezed = ball(3).vertices * torch.tensor([1.0, 0.5, 1.0])
    write_usdz(path, Asset4D(ball(3), torch.stack((torch.zeros_like(squeezed), squeezed - ball(3).vertices)), 1.0), FPS)
    stage = Usd.Stage.Open(str(path))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/asset/mesh/subject"))
    assert mesh.GetNormalsInterpolation() == "vertex"
    for time, height in ((0, 1.0), (1, 0.5)):
        at = code(time)
        points, normals = np.array(mesh.GetPointsAttr().Get(at)), np.array(mesh.GetNormalsAttr().Get(at))
        outward = points / (1, height**2, 1)  # the gradient of the ellipsoid's equation
        outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        assert (normals * outward).sum(1).min() > 0.99
        assert np.array_equal(mesh.GetExtentAttr().Get(at), (points.min(0), points.max(0)))


def test_normals_stay_when_told_so(path: Path) -> None:
    write_usdz(path, torn_ball(), FPS, settings=GltfSettings(moving_normals=False))
    stage = Usd.Stage.Open(str(path))
    normals = UsdGeom.Mesh(stage.GetPrimAtPath("/asset/mesh/subject")).GetNormalsAttr()
    assert np.array_equal(normals.Get(0), normals.Get(code(2)))


def test_texture_coordinates_count_upwards(path: Path) -> None:
    write_usdz(path, growing_ball(), FPS)
    stage = Usd.Stage.Open(str(path))
    st = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/asset/mesh/subject")).GetPrimvar("st")
    assert st.GetInterpolation() == "faceVarying"
    mesh = growing_ball().mesh
    expected = mesh.uvs[mesh.faces].reshape(-1, 2) * torch.tensor([1.0, -1.0]) + torch.tensor([0.0, 1.0])
    np.testing.assert_allclose(np.array(st.ComputeFlattened()), expected.numpy(), atol=1e-7)


def test_the_texture_is_the_picture_and_is_srgb(path: Path) -> None:
    write_usdz(path, growing_ball(), FPS, settings=PNG)
    (picture,) = pictures(path).values()
    assert np.array_equal(picture, (ball().texture * 255).round().byte().numpy())
    stage = Usd.Stage.Open(str(path))
    color = UsdShade.Shader(stage.GetPrimAtPath("/asset/mesh/materials/subject/color"))
    assert color.GetInput("sourceColorSpace").Get() == "sRGB"


@pytest.mark.parametrize("side", [1, 3])
def test_tiny_textures_are_written(side: int, path: Path) -> None:
    texture = torch.full((side, side, 3), 51 / 255)
    write_usdz(path, replace(growing_ball(), mesh=replace(ball(), texture=texture)), FPS, settings=PNG)
    (picture,) = pictures(path).values()
    assert np.array_equal(picture, np.full((side, side, 3), 51))


def test_jpeg_is_nearly_the_picture(path: Path) -> None:
    smooth = torch.linspace(0, 1, 32)[:, None, None].expand(32, 32, 3)
    write_usdz(path, replace(growing_ball(), mesh=replace(ball(), texture=smooth)), FPS)
    (picture,) = pictures(path).values()
    np.testing.assert_allclose(picture / 255, smooth, atol=3 / 255)


def test_changing_textures_change_with_their_frames(path: Path) -> None:
    write_usdz(path, colorful_ball(), FPS, settings=PNG)
    found = pictures(path)
    assert list(found) == [None, *map(code, range(FRAMES + 1))]
    textures = (colorful_ball().textures * 255).round().byte().numpy()
    for time, picture in found.items():
        assert np.array_equal(picture, textures[round((time or 0) / code(1)) % FRAMES])


def test_roughness_and_metallic_are_the_settings(path: Path) -> None:
    write_usdz(path, growing_ball(), FPS, settings=GltfSettings(roughness=0.25, metallic=0.75))
    stage = Usd.Stage.Open(str(path))
    surface = UsdShade.Shader(stage.GetPrimAtPath("/asset/mesh/materials/subject/surface"))
    assert [surface.GetInput(name).Get() for name in ("roughness", "metallic")] == [0.25, 0.75]


@pytest.mark.parametrize("kind", ["with splats", "half splats", "changing textures", "per frame"])
def test_who_names_no_time_sees_the_first_frame(kind: str, path: Path) -> None:
    WRITTEN[kind](path)
    stage = Usd.Stage.Open(str(path))
    splats = stage.GetDefaultPrim().GetVariantSet("representation")
    for choice in ("mesh", "splats") if splats.GetVariantNames() else ("mesh",):
        splats.SetVariantSelection(choice)
        moving = [a for prim in stage.Traverse() for a in prim.GetAttributes() if a.GetNumTimeSamples()]
        assert moving
        for attribute in moving:
            assert np.array_equal(np.array(attribute.Get()), np.array(attribute.Get(0))), attribute.GetPath()


@pytest.mark.parametrize("frames", [1, 2, FRAMES])
def test_a_mesh_per_frame_is_there_at_its_time_alone(frames: int, path: Path) -> None:
    write_usdz(path, balls(frames), FPS, settings=PNG)
    stage = Usd.Stage.Open(str(path))
    for time in np.arange(0, frames + 1, 0.5):
        for frame, mesh in enumerate(balls(frames)):
            found = corners(stage, f"/asset/mesh/frame_{frame:03d}", code(time))
            there = mesh.vertices[mesh.faces].numpy() if int(time) % frames == frame else np.zeros((0, 3, 3))
            assert np.array_equal(found, there)
    for frame, mesh in enumerate(balls(frames)):
        (picture,) = pictures(path, f"/asset/mesh/materials/frame_{frame:03d}/color").values()
        assert np.array_equal(picture, (mesh.texture * 255).round().byte().numpy())


def test_three_js_reads_the_first_frame(path: Path) -> None:
    for surface, name in ((growing_ball(), "subject"), (balls(), "frame_000")):
        write_usdz(path, surface, FPS)
        (seen,) = run_node("read_usdz.mjs", str(path))["meshes"]
        mesh = surface.mesh if isinstance(surface, Asset4D) else surface[0]
        assert (seen["name"], seen["textured"]) == (name, True)
        np.testing.assert_allclose(seen["corners"], mesh.vertices[mesh.faces].reshape(-1, 3), atol=1e-6)
        upwards = mesh.uvs[mesh.faces].reshape(-1, 2) * torch.tensor([1.0, -1.0]) + torch.tensor([0.0, 1.0])
        np.testing.assert_allclose(seen["uvs"], upwards, atol=1e-6)


def test_a_thousand_frames_are_written(path: Path) -> None:
    write_usdz(path, growing_ball(1000), FPS, cloud(1000))
    stage = Usd.Stage.Open(str(path))
    stage.GetDefaultPrim().GetVariantSet("representation").SetVariantSelection("mesh")
    assert np.array_equal(corners(stage, "/asset/mesh/subject", code(999)), expected_corners(growing_ball(1000), 999))


def test_what_is_said_about_an_asset_is_kept(path: Path) -> None:
    about = {"name": "Der Bär の 熊 🐻", "notes": ["a", 1, None], "empty": {}}
    write_usdz(path, growing_ball(), FPS, None, about)
    stage = Usd.Stage.Open(str(path))
    assert json.loads(stage.GetRootLayer().customLayerData["dg4d"]) == about
    assert stage.GetDefaultPrim().GetDisplayName() == about["name"]
    assert Usd.ModelAPI(stage.GetDefaultPrim()).GetAssetName() == about["name"]


NAN = float("nan")


@pytest.mark.parametrize(
    ("surface", "fps", "states", "says"),
    [
        (growing_ball(), 0.0, None, "positive"),
        (growing_ball(), NAN, None, "positive"),
        (growing_ball(0), FPS, None, "at least one frame"),
        ([], FPS, None, "at least one frame"),
        (replace(growing_ball(), mesh=replace(ball(), faces=torch.zeros(0, 3, dtype=torch.long))), FPS, None, "triang"),
        (replace(growing_ball(), offsets=growing_ball().offsets * NAN), FPS, None, "not finite"),
        (replace(colorful_ball(), textures=torch.full((FRAMES, 2, 2, 3), NAN)), FPS, None, "not finite"),
        ([ball(), replace(ball(), vertices=ball().vertices * NAN)], FPS, None, "not finite"),
        ([ball(), replace(ball(), uvs=ball().uvs * NAN)], FPS, None, "not finite"),
        (growing_ball(), FPS, replace(cloud(), means=cloud().means * NAN), "not finite"),
        (growing_ball(), FPS, cloud(3), "each of the 4 frames"),
        (growing_ball(), FPS, cloud().at(0), "each of the 4 frames"),
    ],
)
def test_what_cannot_be_written_is_refused(
    surface: Asset4D | Sequence[TexturedMesh], fps: float, states: Gaussians | None, says: str, path: Path
) -> None:
    with pytest.raises(BadInput, match=says):
        write_usdz(path, surface, fps, states)
    assert not path.exists()


def test_a_folder_that_cannot_be_written_to_is_named(tmp_path: Path) -> None:
    with pytest.raises(OSError, match=r"nowhere.*a\.usdz"):
        write_usdz(tmp_path / "nowhere" / "a.usdz", growing_ball(), FPS)


def test_a_scene_has_every_asset_at_its_place_and_time(path: Path) -> None:
    placements = two_assets(path.parent)
    compose_usdz(path, placements)
    stage = Usd.Stage.Open(str(path))
    assert stage.GetTimeCodesPerSecond() == 24
    assert stage.GetEndTimeCode() == pytest.approx(24 * (0.5 + FRAMES / FPS / 2))

    def world(name: str, seconds: float) -> np.ndarray:
        time = seconds * stage.GetTimeCodesPerSecond()
        matrix = UsdGeom.Xformable(stage.GetPrimAtPath(name)).ComputeLocalToWorldTransform(time)
        return corners(stage, name, time) @ np.array(matrix)[:3, :3] + np.array(matrix)[3, :3]

    def expected(placement: UsdPlacement, frame: int) -> np.ndarray:
        turn, shift = placement.transform[:3, :3].numpy(), placement.transform[:3, 3].numpy()
        return expected_corners(growing_ball(), frame) @ turn.T + shift

    for frame in range(FRAMES):
        first, second = world("/scene/a_bear/mesh/subject", frame / FPS), expected(placements[0], frame)
        np.testing.assert_allclose(first, second, atol=1e-5)
        later = world("/scene/a_bear_2/mesh/subject", 0.5 + frame / FPS / 2)
        np.testing.assert_allclose(later, expected(placements[1], frame), atol=1e-5)
    np.testing.assert_allclose(world("/scene/a_bear_2/mesh/subject", 0.2), expected(placements[1], 0), atol=1e-5)
    coarse = balls()[2]
    found = corners(stage, "/scene/_2/mesh/frame_002", code(2, 2 * FPS))
    assert np.array_equal(found, coarse.vertices[coarse.faces].numpy())


def test_a_scene_holds_an_asset_once_and_keeps_names(path: Path) -> None:
    compose_usdz(path, two_assets(path.parent))
    with zipfile.ZipFile(path) as package:
        layers = [name for name in package.namelist() if name.endswith(".usdc")]
    assert layers == ["scene.usdc", "a_bear/asset.usdc", "_2/asset.usdc"]
    stage = Usd.Stage.Open(str(path))
    shown = {prim.GetName(): prim.GetDisplayName() for prim in stage.GetDefaultPrim().GetChildren()}
    assert shown == {"a_bear": "a bear", "a_bear_2": "a bear", "_2": "くま 2"}


def test_pictures_of_two_assets_have_two_names(path: Path) -> None:
    compose_usdz(path, two_assets(path.parent))
    with zipfile.ZipFile(path) as package:
        names = [Path(name).name for name in package.namelist() if "textures/" in name]
    assert len(names) == len(set(names)) == 1 + FRAMES


def test_a_scene_can_stand_in_a_scene(path: Path) -> None:
    compose_usdz(path, two_assets(path.parent))
    outer = path.parent / "outer.usdz"
    compose_usdz(outer, [UsdPlacement("inner", path, at(scale=2.0), start_s=1.0)])
    stage = Usd.Stage.Open(str(outer))
    assert faults(stage) == []
    time = (1.0 + 1 / FPS) * stage.GetTimeCodesPerSecond()
    found = corners(stage, "/scene/inner/a_bear/mesh/subject", time)
    np.testing.assert_allclose(found, expected_corners(growing_ball(), 1), atol=1e-5)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"speed": 0.0}, "speed must be positive"),
        ({"speed": NAN}, "speed must be positive"),
        ({"start_s": -1.0}, "start must be 0"),
        ({"transform": torch.full((4, 4), NAN)}, "not finite"),
        ({"file": Path("nowhere.usdz")}, "cannot be read"),
        ({"file": Path(__file__)}, "is not a USDZ"),
    ],
)
def test_a_placement_without_sense_is_refused(change: dict[str, Any], says: str, path: Path) -> None:
    good = two_assets(path.parent)
    with pytest.raises(BadInput, match=says):
        compose_usdz(path, [*good, replace(good[0], **change)])


def test_a_usdz_that_a_scene_cannot_refer_to_is_refused(path: Path) -> None:
    with zipfile.ZipFile(path.parent / "empty.usdz", "w") as package:
        package.writestr("a.usda", "#usda 1.0\n")
    with pytest.raises(BadInput, match="default prim"):
        compose_usdz(path, [UsdPlacement("x", path.parent / "empty.usdz", at())])


@pytest.mark.parametrize(
    ("name", "method", "says"),
    [
        ("../../stolen.usdc", zipfile.ZIP_STORED, "outside of itself"),
        ("/tmp/stolen.usdc", zipfile.ZIP_STORED, "outside of itself"),
        ("asset.usdc", zipfile.ZIP_DEFLATED, "compressed entries"),
    ],
)
def test_a_usdz_with_unsafe_entries_is_refused(name: str, method: int, says: str, path: Path) -> None:
    sound = two_assets(path.parent)[0].file
    hostile = path.parent / "hostile.usdz"
    with zipfile.ZipFile(sound) as package, zipfile.ZipFile(hostile, "w", method) as other:
        other.writestr(name, package.read(package.namelist()[0]))
    with pytest.raises(BadInput, match=says):
        compose_usdz(path, [UsdPlacement("x", hostile, at(), hold_s=0.0)])


def test_a_usdz_whose_entries_overlap_is_refused(path: Path) -> None:
    sound, hostile = two_assets(path.parent)[0].file, path.parent / "hostile.usdz"
    with zipfile.ZipFile(sound) as package, zipfile.ZipFile(hostile, "w") as other:
        other.writestr("asset.usdc", package.read(package.namelist()[0]))
        other.filelist += other.filelist  # the directory lists the entry twice
    with pytest.raises(BadInput, match="without overlap"):
        compose_usdz(path, [UsdPlacement("x", hostile, at())])


def test_an_empty_scene_is_refused(path: Path) -> None:
    with pytest.raises(BadInput, match="at least one asset"):
        compose_usdz(path, [])
