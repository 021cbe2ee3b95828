"""Skinned USDZ: the skeleton as UsdSkel evaluates it, and the rules of Quick Look."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from pxr import Usd, UsdGeom, UsdShade, UsdSkel, UsdValidation

from dg4d_lib.asset_settings import GltfSettings
from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.assets.formats.usd import UsdPlacement, compose_usdz, write_skinned_usdz, write_usdz
from dg4d_lib.errors import BadInput
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh.tracking.rig import Rig, fit_rig, rig_offsets
from tests.clients.node import run_node

FPS, FRAMES = 8.0, 5
ARKIT_TYPES = {  # prims that the ARKit rules of OpenUSD's complianceChecker.py allow
    "Scope", "Xform", "Shader", "Material", "Mesh", "SkelRoot", "Skeleton", "SkelAnimation",
}  # fmt: skip
ARKIT_SHADERS = {"UsdPreviewSurface", "UsdUVTexture", "UsdPrimvarReader_float2"}


def bending() -> Asset4D:
    """Return a pole that bends to both sides, with copies of some vertices."""
    pole = trimesh.creation.cylinder(radius=0.2, height=2, sections=8).subdivide().subdivide()
    rest = torch.tensor(np.concatenate((pole.vertices, pole.vertices[::5]))[:, [0, 2, 1]], dtype=torch.float32)
    angles = 0.8 * (torch.arange(FRAMES) * 2 * math.pi / FRAMES).sin()[:, None] * ((rest[:, 1] + 1) / 2) ** 2
    x, y, z = rest.unbind(1)
    moved = torch.stack((x * angles.cos() - y * angles.sin(), x * angles.sin() + y * angles.cos(), z + 0 * angles), -1)
    texture = torch.rand(8, 8, 3, generator=torch.Generator().manual_seed(0))
    mesh = TexturedMesh(rest, torch.tensor(pole.faces[:, ::-1].copy()), rest[:, :2] / 4 + 0.5, texture)
    return Asset4D(mesh, moved - rest, FPS, {"notes": ["bends"]})


@pytest.fixture(scope="module")
def skinned(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Asset4D, Rig]:
    asset = bending()
    rig = fit_rig(asset.mesh.vertices, asset.offsets, 0.02, 8)
    path = tmp_path_factory.mktemp("skinned") / "asset.usdz"
    write_skinned_usdz(path, asset, rig, {"name": "pole"})
    return path, asset, rig


def test_usdskel_moves_the_mesh_as_the_rig_says(skinned: tuple[Path, Asset4D, Rig]) -> None:
    path, asset, rig = skinned
    stage = Usd.Stage.Open(str(path))
    root = UsdSkel.Root(stage.GetPrimAtPath("/asset/mesh"))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/asset/mesh/subject"))
    indices = np.array(mesh.GetFaceVertexIndicesAttr().Get())
    cache = UsdSkel.Cache()
    cache.Populate(root, Usd.PrimDefaultPredicate)
    skeleton = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/asset/mesh/rig")))
    query = cache.GetSkinningQuery(mesh.GetPrim())
    expected = (asset.mesh.vertices + rig_offsets(rig, asset.mesh.vertices))[:, asset.mesh.faces.flatten()]
    for frame in range(FRAMES + 1):
        time = 24 * frame / FPS
        points = mesh.GetPointsAttr().Get()
        assert query.ComputeSkinnedPoints(skeleton.ComputeSkinningTransforms(time), points, time)
        np.testing.assert_allclose(np.array(points)[indices], expected[frame % FRAMES], atol=1e-5)
        low, high = np.array(root.GetExtentAttr().Get(time))
        np.testing.assert_allclose((low, high), (np.min(points, 0), np.max(points, 0)), atol=1e-5)
    assert root.GetExtentAttr().Get() == root.GetExtentAttr().Get(0)  # also for readers that ignore time
    assert (stage.GetTimeCodesPerSecond(), stage.GetEndTimeCode()) == (24, 24 * FRAMES / FPS)


def test_the_joints_at_rest_are_where_the_mesh_was_bound(skinned: tuple[Path, Asset4D, Rig]) -> None:
    stage = Usd.Stage.Open(str(skinned[0]))
    cache = UsdSkel.Cache()
    cache.Populate(UsdSkel.Root(stage.GetPrimAtPath("/asset/mesh")), Usd.PrimDefaultPredicate)
    skeleton = UsdSkel.Skeleton(stage.GetPrimAtPath("/asset/mesh/rig"))
    rest = cache.GetSkelQuery(skeleton).ComputeJointSkelTransforms(0, atRest=True)
    np.testing.assert_allclose(np.array(rest), np.array(skeleton.GetBindTransformsAttr().Get()), atol=1e-6)


def test_readers_that_ignore_time_see_the_first_frame(skinned: tuple[Path, Asset4D, Rig]) -> None:
    stage = Usd.Stage.Open(str(skinned[0]))
    motion = UsdSkel.Animation(stage.GetPrimAtPath("/asset/mesh/rig/motion"))
    for attribute in (motion.GetRotationsAttr(), motion.GetTranslationsAttr()):
        assert attribute.Get() == attribute.Get(0) != attribute.Get(24 / FPS)


def test_the_mesh_at_rest_is_that_of_the_asset(skinned: tuple[Path, Asset4D, Rig]) -> None:
    path, asset, _ = skinned
    (seen,) = run_node("read_usdz.mjs", str(path))["meshes"]
    np.testing.assert_allclose(seen["corners"], asset.mesh.vertices[asset.mesh.faces].reshape(-1, 3), atol=1e-6)
    assert seen["textured"]


def test_no_rule_of_quick_look_is_broken(skinned: tuple[Path, Asset4D, Rig]) -> None:
    stage = Usd.Stage.Open(str(skinned[0]))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert [fault.GetMessage() for fault in UsdValidation.ValidationContext(validators).Validate(stage)] == []
    assert {prim.GetTypeName() for prim in stage.Traverse()} <= ARKIT_TYPES
    shaders = [UsdShade.Shader(prim) for prim in stage.Traverse() if prim.IsA(UsdShade.Shader)]
    assert {shader.GetShaderId() for shader in shaders} == ARKIT_SHADERS
    assert len([layer for layer in stage.GetUsedLayers() if layer.realPath]) == 1
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 1)


def test_point_samples_break_no_rule_of_quick_look_unless_they_have_open_pbr(tmp_path: Path) -> None:
    for open_pbr in (False, True):
        path = tmp_path / f"{open_pbr}.usdz"
        write_usdz(path, bending(), FPS, open_pbr=open_pbr)
        stage = Usd.Stage.Open(str(path))
        shaders = [UsdShade.Shader(prim).GetShaderId() for prim in stage.Traverse() if prim.IsA(UsdShade.Shader)]
        assert (set(shaders) == ARKIT_SHADERS) is not open_pbr


def test_open_pbr_reads_the_same_texture(tmp_path: Path) -> None:
    settings = GltfSettings(roughness=0.25, metallic=0.75)
    write_usdz(tmp_path / "a.usdz", bending(), FPS, settings=settings, open_pbr=True)
    stage = Usd.Stage.Open(str(tmp_path / "a.usdz"))
    material = UsdShade.Material(stage.GetPrimAtPath("/asset/mesh/materials/subject"))
    surface = material.ComputeSurfaceSource("mtlx")[0]
    assert surface.GetShaderId() == "ND_open_pbr_surface_surfaceshader"
    assert [surface.GetInput(n).Get() for n in ("specular_roughness", "base_metalness")] == [0.25, 0.75]
    color = UsdShade.Shader(surface.GetInput("base_color").GetConnectedSources()[0][0].source.GetPrim())
    preview = UsdShade.Shader(stage.GetPrimAtPath("/asset/mesh/materials/subject/color"))
    assert color.GetInput("file").Get() == preview.GetInput("file").Get()
    assert color.GetInput("file").GetAttr().GetColorSpace() == "srgb_texture"
    assert material.ComputeSurfaceSource()[0].GetShaderId() == "UsdPreviewSurface"


def test_a_skinned_asset_plays_in_a_scene(skinned: tuple[Path, Asset4D, Rig], tmp_path: Path) -> None:
    compose_usdz(tmp_path / "scene.usdz", [UsdPlacement("pole", skinned[0], torch.eye(4), start_s=0.5, speed=2.0)])
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdz"))
    motion = UsdSkel.Animation(stage.GetPrimAtPath("/scene/pole/mesh/rig/motion"))
    asset = Usd.Stage.Open(str(skinned[0]))
    alone = UsdSkel.Animation(asset.GetPrimAtPath("/asset/mesh/rig/motion"))
    found = motion.GetTranslationsAttr().Get(24 * (0.5 + 2 / FPS / 2))
    np.testing.assert_allclose(found, alone.GetTranslationsAttr().Get(24 * 2 / FPS), atol=1e-6)


def test_the_rig_of_another_mesh_is_refused(skinned: tuple[Path, Asset4D, Rig], tmp_path: Path) -> None:
    asset, rig = skinned[1:]
    other = Asset4D(asset.mesh, asset.offsets[:2], FPS)
    with pytest.raises(BadInput, match=r"2 frames of the mesh; given .* and 5"):
        write_skinned_usdz(tmp_path / "a.usdz", other, rig)
