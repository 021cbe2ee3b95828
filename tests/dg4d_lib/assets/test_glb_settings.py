"""GLB with other settings than the defaults: round trip and third-party readers."""

import io
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pygltflib
import pytest
import torch
import trimesh
from PIL import Image

from dg4d_lib.asset_settings import GltfSettings
from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.assets.formats import gltf
from dg4d_lib.assets.formats.glb import (
    component_notes,
    read_glb,
    read_mesh_glb,
    write_frames_glb,
    write_glb,
    write_mesh_glb,
)
from dg4d_lib.assets.formats.gltf import GlbReader
from dg4d_lib.assets.formats.normals import SmoothNormals, mesh_normal_groups
from dg4d_lib.assets.placement import Placement
from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.mesh.textured import TexturedMesh

pytest.importorskip("meshoptimizer", reason="meshoptimizer is not installed: make clients")

FRAMES, FPS = 5, 8.0
COMPACT = GltfSettings(quantized=True, meshopt=True)


def ball() -> TexturedMesh:
    """A sphere whose triangles share no vertex, with a smooth texture."""
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    vertices = torch.tensor(sphere.triangles.reshape(-1, 3), dtype=torch.float32)
    uvs = torch.stack((vertices[:, 0] + 0.5, 0.5 - vertices[:, 1]), 1)
    ramp = torch.linspace(0, 1, 32)
    texture = torch.stack((ramp[:, None].expand(32, 32), ramp.expand(32, 32), torch.full((32, 32), 0.5)), -1)
    return TexturedMesh(vertices, torch.arange(len(vertices)).reshape(-1, 3), uvs, texture)


def turning_ball(frames: int = FRAMES) -> Asset4D:
    """A sphere that turns once and rises."""
    mesh = ball()
    angles = torch.arange(frames) / frames * 2 * torch.pi
    x, y, z = mesh.vertices.T
    poses = [torch.stack((a.cos() * x + a.sin() * z, y + 0.1 * a, a.cos() * z - a.sin() * x), 1) for a in angles]
    return Asset4D(mesh, torch.stack(poses) - mesh.vertices, FPS)


def flickering_ball() -> Asset4D:
    """With a texture per frame."""
    asset = turning_ball()
    textures = torch.stack([asset.mesh.texture * (frame + 1) / FRAMES for frame in range(FRAMES)])
    return replace(asset, textures=textures)


def placed(asset: Asset4D) -> torch.Tensor:
    return asset.mesh.vertices + asset.offsets


def scale_of(content: bytes) -> float:
    return float(GlbReader(content).tree["nodes"][0]["scale"][0])


@pytest.mark.parametrize("settings", [GltfSettings(quantized=True), COMPACT], ids=["quantized", "packed"])
def test_quantized_places_are_within_half_a_step_in_every_pose(settings: GltfSettings) -> None:
    content = write_glb(turning_ball(), settings)
    half_step = scale_of(content) / 2
    reach = turning_ball().offsets.abs().max() if settings.meshopt else 0
    assert not settings.meshopt or half_step == pytest.approx(float(reach) * 1.0001 / 8191 / 2, rel=0.3)
    found, expected = placed(read_glb(content)), placed(turning_ball())
    if settings.meshopt:  # which changes the order of the vertices
        nearest = torch.cdist(found[0], expected[0]).argmin(1)
        expected = expected[:, nearest]
    worst = (found - expected).abs().max()
    assert 0 < worst <= half_step + 1e-7
    assert GlbReader(content).tree["nodes"][0]["extras"]["largestError"] == pytest.approx(half_step)


def test_texture_coordinates_are_exact_unless_compressed() -> None:
    assert torch.equal(read_mesh_glb(write_mesh_glb(ball(), GltfSettings())).uvs, ball().uvs)
    back = read_mesh_glb(write_mesh_glb(ball(), COMPACT)).uvs
    distances = torch.cdist(back, ball().uvs, compute_mode="donot_use_mm_for_euclid_dist").amin(1)
    assert distances.max() <= 0.51 * 2**0.5 / 65535


def test_a_mesh_without_extent_can_be_quantized() -> None:
    point = replace(ball(), vertices=torch.full((len(ball().vertices), 3), 0.3))
    back = read_mesh_glb(write_mesh_glb(point, GltfSettings(quantized=True)))
    torch.testing.assert_close(back.vertices, point.vertices)


def corners(asset: Asset4D) -> torch.Tensor:
    """Return all triangles with the positions of their corners at all frames, in an order that no writer changes."""
    rows = placed(asset)[:, asset.mesh.faces].movedim(0, 2).flatten(2)  # f 3 t*3
    first = rows[..., 0].argmin(1)
    turned = torch.stack([row.roll(-int(turn), 0) for row, turn in zip(rows, first, strict=True)]).flatten(1)
    return turned[np.lexsort(turned.T.numpy())]


def test_packing_loses_nothing() -> None:
    given = tilted(turning_ball())
    back = read_glb(write_glb(given, GltfSettings(meshopt=True, quantized=False)))
    torch.testing.assert_close(corners(back), corners(given), atol=1e-6, rtol=0)


def test_each_way_to_write_less_makes_the_file_smaller() -> None:
    asset = turning_ball()
    sizes = [
        len(write_glb(asset, settings))
        for settings in (
            GltfSettings(quantized=False),
            GltfSettings(quantized=True),
            COMPACT,
            GltfSettings(quantized=True, meshopt=True, moving_normals=False),
        )
    ]
    assert sizes == sorted(sizes, reverse=True)


def normals_shown(content: bytes, frame: int) -> np.ndarray:
    parsed = GlbReader(content)
    primitive = parsed.tree["meshes"][0]["primitives"][0]
    base = parsed.accessor(primitive["attributes"]["NORMAL"])
    changes = parsed.accessor(primitive["targets"][frame - 1]["NORMAL"]) if frame else 0
    shown = base + changes
    return shown / np.linalg.norm(shown, axis=1, keepdims=True)


def tilted(asset: Asset4D) -> Asset4D:
    """Nothing in it lies along an axis."""
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(3)))[0]
    mesh = replace(asset.mesh, vertices=asset.mesh.vertices @ turn)
    return replace(asset, mesh=mesh, offsets=asset.offsets @ turn)


@pytest.mark.parametrize("quantized", [False, True])
@pytest.mark.parametrize("given", [turning_ball(), tilted(turning_ball())], ids=["along the axes", "tilted"])
def test_normals_are_those_of_the_moved_surface(given: Asset4D, quantized: bool) -> None:
    content = write_glb(given, GltfSettings(quantized=quantized))
    normals_of = SmoothNormals(mesh_normal_groups(given.mesh, placed(given).numpy()), given.mesh.faces.numpy())
    for frame, pose in enumerate(placed(given)):
        cosine = (normals_shown(content, frame) * normals_of(pose.numpy())).sum(1).min()
        assert cosine > (0.9995 if quantized else 0.9999)  # 8 bits: at most 1.8 degrees


def test_normals_that_turn_over_get_more_bits() -> None:
    def kinds(asset: Asset4D) -> list[int]:
        tree = GlbReader(write_glb(asset, GltfSettings(quantized=True))).tree
        targets = tree["meshes"][0]["primitives"][0]["targets"]
        return [tree["accessors"][target["NORMAL"]]["componentType"] for target in targets]

    byte, short, floating = 5120, 5122, 5126
    assert kinds(turning_ball()) == [byte, floating, floating, byte]  # 72, 144, 216, 288 degrees, along the axes
    assert set(kinds(tilted(turning_ball()))) <= {byte, short}


def test_without_moving_normals_targets_have_places_only() -> None:
    tree = GlbReader(write_glb(turning_ball(), GltfSettings(moving_normals=False, quantized=False))).tree
    assert all(set(target) == {"POSITION"} for target in tree["meshes"][0]["primitives"][0]["targets"])


@pytest.mark.parametrize("interpolation", ["linear", "step"])
def test_frames_are_joined_as_asked(interpolation: Any) -> None:
    tree = GlbReader(write_glb(turning_ball(), GltfSettings(interpolation=interpolation, quantized=False))).tree
    assert tree["animations"][0]["samplers"][0]["interpolation"] == interpolation.upper()


def test_the_surface_is_as_rough_and_metallic_as_asked() -> None:
    tree = GlbReader(write_mesh_glb(ball(), GltfSettings(roughness=0.4, metallic=0.75, quantized=False))).tree
    surface = tree["materials"][0]["pbrMetallicRoughness"]
    assert (surface["roughnessFactor"], surface["metallicFactor"]) == (0.4, 0.75)


@pytest.mark.parametrize(("image", "worst"), [("png", 0.51), ("jpeg", 8.0), ("webp", 12.0)])
def test_pictures_come_back_as_their_format_keeps_them(image: Any, worst: float) -> None:
    content = write_mesh_glb(ball(), GltfSettings(image=image, quantized=False))
    torch.testing.assert_close(read_mesh_glb(content).texture, ball().texture, atol=worst / 255, rtol=0)
    assert GlbReader(content).tree["images"][0]["mimeType"] == f"image/{image}"


def test_a_reader_without_webp_finds_the_same_picture_as_jpeg() -> None:
    parsed = GlbReader(write_mesh_glb(ball(), GltfSettings(image="webp", quantized=False)))
    assert "extensionsRequired" not in parsed.tree
    image = parsed.tree["images"][parsed.tree["textures"][0]["source"]]
    with Image.open(io.BytesIO(parsed.view(image["bufferView"]))) as picture:
        assert picture.format == "JPEG"
        pixels = torch.from_numpy(np.array(picture)) / 255
    torch.testing.assert_close(pixels, ball().texture, atol=8 / 255, rtol=0)


def test_a_picture_too_large_for_webp_is_refused() -> None:
    mesh = replace(ball(), texture=torch.zeros(1, 16384, 3))
    with pytest.raises(BadInput, match="16384 pixels cannot be webp"):
        write_mesh_glb(mesh, GltfSettings(image="webp", quantized=False))


@pytest.mark.parametrize("textures", ["pointer", "core"])
@pytest.mark.parametrize("compact", [False, True])
def test_changing_textures_come_back(textures: Any, compact: bool) -> None:
    given = flickering_ball()
    back = read_glb(write_glb(given, GltfSettings(textures=textures, image="png", quantized=compact, meshopt=compact)))
    assert given.textures is not None
    assert back.textures is not None
    torch.testing.assert_close(back.textures, given.textures, atol=0.51 / 255, rtol=0)
    torch.testing.assert_close(back.mesh.texture, back.textures[0])
    torch.testing.assert_close(back.mesh.uvs, given.mesh.uvs, atol=1e-4 if compact else 1e-6, rtol=0)
    torch.testing.assert_close(placed(back), placed(given), atol=1e-4, rtol=0)


def test_changing_textures_need_no_extension_in_core() -> None:
    tree = GlbReader(write_glb(flickering_ball(), GltfSettings(textures="core", quantized=False))).tree
    assert "extensionsUsed" not in tree
    assert len(tree["materials"]) == FRAMES


def test_who_knows_no_extension_sees_the_first_texture() -> None:
    content = write_glb(flickering_ball(), GltfSettings(image="png", quantized=False))
    assert "extensionsRequired" not in GlbReader(content).tree
    (mesh,) = trimesh.load(io.BytesIO(content), file_type="glb").geometry.values()
    seen = mesh.visual.to_color().vertex_colors[:, :3].mean(0)
    first = replace(ball(), texture=ball().texture / FRAMES)
    (plain,) = trimesh.load(io.BytesIO(write_mesh_glb(first)), file_type="glb").geometry.values()
    np.testing.assert_allclose(seen, plain.visual.to_color().vertex_colors[:, :3].mean(0), atol=2)


def test_the_offset_of_the_texture_steps_with_the_frames_and_returns() -> None:
    parsed = GlbReader(write_glb(flickering_ball()))
    animation = parsed.tree["animations"][0]
    (track,) = [c for c in animation["channels"] if c["target"]["path"] == "pointer"]
    sampler = animation["samplers"][track["sampler"]]
    assert "node" not in track["target"]
    assert sampler["interpolation"] == "STEP"
    offsets = parsed.accessor(sampler["output"])
    assert len(np.unique(offsets, axis=0)) == FRAMES
    assert np.array_equal(offsets[0], offsets[-1])
    np.testing.assert_allclose(parsed.accessor(sampler["input"])[:, 0], np.arange(FRAMES + 1) / FPS)


SETTINGS = [
    GltfSettings(image="png", quantized=False),
    GltfSettings(quantized=True),
    GltfSettings(interpolation="step", moving_normals=False, quantized=False),
]


def test_trimesh_reads_the_same_values() -> None:
    mesh = ball()
    (seen,) = trimesh.load(io.BytesIO(write_glb(turning_ball())), file_type="glb").geometry.values()
    assert np.array_equal(seen.vertices.astype(np.float32), mesh.vertices.numpy())
    assert np.array_equal(seen.faces, mesh.faces.numpy())
    np.testing.assert_allclose(seen.visual.uv, mesh.uvs.numpy() * (1, -1) + (0, 1), atol=1e-6)  # its v points up
    assert seen.visual.material.baseColorTexture.size == (32, 32)


@pytest.mark.parametrize("settings", SETTINGS, ids=["plain", "quantized", "step"])
def test_pygltflib_reads_the_same_values(settings: GltfSettings) -> None:
    given = turning_ball()
    theirs = pygltflib.GLTF2.load_from_bytes(write_glb(given, settings))
    blob = theirs.binary_blob()
    types = {5120: "i1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}

    def values(index: int) -> np.ndarray:
        accessor = theirs.accessors[index]
        view, dtype = theirs.bufferViews[accessor.bufferView], np.dtype(types[accessor.componentType])
        width = {"VEC2": 2, "VEC3": 3}[accessor.type]
        stride = view.byteStride or width * dtype.itemsize
        shape, strides = (accessor.count, width), (stride, dtype.itemsize)
        raw = np.ndarray(shape, dtype, blob, view.byteOffset, strides)
        return raw / np.iinfo(dtype).max if accessor.normalized else raw.astype(float)

    node, primitive = theirs.nodes[0], theirs.meshes[0].primitives[0]
    scale = np.array(node.scale or 1.0)
    rest = values(primitive.attributes.POSITION)
    base = [np.zeros(3)]
    targets = [values(target["POSITION"]) for target in primitive.targets]
    for offsets, pose in zip(base + targets, placed(given), strict=True):
        moved = (rest + offsets) * scale + np.array(node.translation or 0.0)
        np.testing.assert_allclose(moved, pose, atol=2e-5)
    np.testing.assert_allclose(values(primitive.attributes.TEXCOORD_0), given.mesh.uvs, atol=1e-5)


@pytest.mark.parametrize("settings", [GltfSettings(components=2), GltfSettings(components=2, quantized=False)])
def test_components_reproduce_a_motion_that_they_span(settings: GltfSettings) -> None:
    """A turn around an axis lies in a plane of poses: cos x + sin z."""
    asset = turning_ball(12)
    asset = replace(asset, offsets=asset.offsets * torch.tensor([1.0, 0.0, 1.0]))
    content = write_glb(asset, settings)
    assert GlbReader(content).tree["meshes"][0]["extras"]["targetNames"] == ["component_000", "component_001"]
    torch.testing.assert_close(placed(read_glb(content)), placed(asset), atol=1e-4, rtol=0)
    assert len(content) < len(write_glb(asset, settings.model_copy(update={"components": 0}))) / 2


@pytest.mark.parametrize("quantized", [True, False])
@pytest.mark.parametrize("components", [1, 3])
def test_the_error_of_components_is_measured_and_noted(quantized: bool, components: int) -> None:
    asset = tilted(turning_ball(12))
    content = write_glb(asset, GltfSettings(components=components, quantized=quantized))
    distances = (placed(read_glb(content)) - placed(asset)).norm(dim=-1)
    extras = GlbReader(content).tree["nodes"][0]["extras"]
    assert extras["largestError"] == pytest.approx(float(distances.max()), abs=1e-6)
    assert extras["rmsError"] == pytest.approx(float(distances.square().mean().sqrt()), abs=1e-6)
    (note,) = component_notes("a.glb", content)
    assert f"{extras['rmsError']:.2g} world units (rms), at most {extras['largestError']:.2g}" in note
    assert component_notes("a.glb", write_glb(asset, GltfSettings(quantized=quantized))) == ()


def test_the_noted_error_does_not_depend_on_the_height_of_the_asset() -> None:
    asset, scale, settings = tilted(turning_ball(12)), 0.02, GltfSettings(components=1)
    small = Placement(scale).surface(asset)
    assert isinstance(small, Asset4D)
    notes = component_notes("a.glb", write_glb(small, settings), scale)
    assert notes == component_notes("a.glb", write_glb(asset, settings))


@pytest.mark.parametrize("moving_normals", [True, False])
def test_components_may_be_larger_than_any_displacement(moving_normals: bool) -> None:
    """Half of the triangles move at once, the others in the last frame: the first component is larger than both."""
    mesh = ball()
    early = (mesh.vertices[mesh.faces].mean(1)[:, 1] > 0).repeat_interleave(3)
    offsets = torch.zeros(16, len(mesh.vertices), 3)
    offsets[1:, early, 0] = offsets[15:, ~early, 0] = 2.0
    asset = Asset4D(mesh, offsets, FPS)
    back = read_glb(write_glb(asset, GltfSettings(components=2, moving_normals=moving_normals)))
    torch.testing.assert_close(placed(back), placed(asset), atol=1e-3, rtol=0)


def test_trimesh_places_quantized_vertices_and_their_texture() -> None:
    scene = trimesh.load(io.BytesIO(write_glb(turning_ball(), GltfSettings(image="png"))), file_type="glb")
    (seen,) = scene.dump()
    np.testing.assert_allclose(seen.vertices, ball().vertices, atol=2e-5)
    np.testing.assert_allclose(seen.visual.uv, ball().uvs.numpy() * (1, -1) + (0, 1), atol=1e-6)


@pytest.mark.parametrize("count", [1, 2])
def test_showing_a_mesh_does_not_replace_the_scale_of_the_cube(count: int) -> None:
    tree = GlbReader(write_frames_glb([ball()] * count, FPS, settings=GltfSettings(quantized=True))).tree
    shown = [channel["target"]["node"] for channel in tree["animations"][0]["channels"]]
    (root,) = tree["scenes"][0]["nodes"]
    assert tree["nodes"][root]["children"] == shown
    assert tree["nodes"][root]["scale"] != [1.0] * 3
    assert tree["nodes"][shown[0]]["scale"] == [1.0] * 3


def test_meshes_per_frame_share_one_cube() -> None:
    meshes = [ball(), replace(ball(), vertices=ball().vertices * 2 + 1)]
    content = write_frames_glb(meshes, FPS, settings=GltfSettings(quantized=True))
    scene = trimesh.load(io.BytesIO(content), file_type="glb")
    extents = sorted(float(mesh.extents[0]) for mesh in scene.geometry.values())
    assert extents[1] == pytest.approx(2 * extents[0], rel=1e-3)


@pytest.mark.parametrize(
    "settings", [COMPACT, GltfSettings(image="webp", textures="core", quantized=False)], ids=["packed", "core"]
)
def test_equal_assets_give_equal_bytes_with_any_settings(settings: GltfSettings) -> None:
    assert write_glb(flickering_ball(), settings) == write_glb(flickering_ball(), settings)


def test_packing_without_its_package_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    content = write_mesh_glb(ball(), COMPACT)
    monkeypatch.setitem(sys.modules, "meshoptimizer", None)
    with pytest.raises(BackendUnavailable, match="meshoptimizer"):
        write_mesh_glb(ball(), COMPACT)
    with pytest.raises(BackendUnavailable, match="meshoptimizer"):
        read_mesh_glb(content)


def test_broken_packing_is_refused() -> None:
    content = write_mesh_glb(ball(), COMPACT)
    parsed = GlbReader(content)
    start = content.index(parsed.view.__self__.binary[:64])
    broken = content[:start] + bytes(64) + content[start + 64 :]
    with pytest.raises(BadInput):
        read_mesh_glb(broken)


def test_a_file_beyond_what_a_glb_can_hold_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gltf, "MAX_LENGTH", 10_000)
    with pytest.raises(BadInput, match="at most 4 GiB"):
        write_glb(turning_ball())
