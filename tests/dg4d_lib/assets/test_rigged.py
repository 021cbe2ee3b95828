"""Skinned GLB: motion of the rig as third-party readers see it."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from dg4d_lib.asset_settings import GltfSettings
from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.assets.formats.glb import write_glb
from dg4d_lib.assets.formats.gltf import GlbReader
from dg4d_lib.assets.formats.rigged import fit_asset_rig, write_rigged_glb
from dg4d_lib.assets.placement import Placement
from dg4d_lib.assets.scenes.compose import AnimatedGlb
from dg4d_lib.errors import BadInput
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh.tracking.rig import Rig, fit_rig
from tests.clients.node import run_node

FPS = 6.0
KINDS = {5121: "u1", 5123: "<u2", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}


def swaying(frames: int = 7) -> Asset4D:
    """A pole whose upper parts lean further and further, with two copies of some vertices."""
    pole = trimesh.creation.cylinder(radius=0.2, height=2, sections=12).subdivide().subdivide()
    rest = torch.tensor(np.concatenate((pole.vertices, pole.vertices[::5]))[:, [0, 2, 1]], dtype=torch.float32)
    angles = 0.8 * torch.linspace(0, math.pi, frames).sin()[:, None] * ((rest[:, 1] + 1) / 2) ** 2
    x, y, z = rest.unbind(1)
    moved = torch.stack((x * angles.cos() - y * angles.sin(), x * angles.sin() + y * angles.cos(), z + 0 * angles), -1)
    faces = torch.tensor(pole.faces[:, ::-1].copy())
    uvs = rest[:, :2] / 4 + 0.5
    texture = torch.rand(8, 8, 3, generator=torch.Generator().manual_seed(0))
    return Asset4D(TexturedMesh(rest, faces, uvs, texture), moved - rest, FPS, {"notes": ["sways"]})


@pytest.fixture(scope="module")
def rigged() -> tuple[Asset4D, Rig, bytes]:
    asset = swaying()
    rig = fit_rig(asset.mesh.vertices, asset.offsets, 0.02, 8)
    return asset, rig, write_rigged_glb(asset, rig, GltfSettings(image="png", quantized=False))


def rows(file: pygltflib.GLTF2, index: int) -> np.ndarray:
    accessor = file.accessors[index]
    view = file.bufferViews[accessor.bufferView]
    values = np.frombuffer(
        file.binary_blob(), KINDS[accessor.componentType], accessor.count * WIDTHS[accessor.type], view.byteOffset
    )
    return values.reshape(accessor.count, -1)


def skin(file: pygltflib.GLTF2) -> tuple[np.ndarray, np.ndarray]:
    """The times of the keys, and the vertices at each, by the words of the glTF specification."""
    (animation,), (shown,) = file.animations, file.skins
    attributes = file.meshes[0].primitives[0].attributes
    rest = rows(file, attributes.POSITION)
    bones, weights = rows(file, attributes.JOINTS_0), rows(file, attributes.WEIGHTS_0) / 65535
    binding = rows(file, shown.inverseBindMatrices).reshape(-1, 4, 4).swapaxes(1, 2)
    tracks: dict[tuple[int, str], np.ndarray] = {}
    for channel in animation.channels:
        sampler = animation.samplers[channel.sampler]
        tracks[channel.target.node, channel.target.path] = rows(file, sampler.output)
    times = rows(file, animation.samplers[0].input)[:, 0]
    parents = {child: number for number, node in enumerate(file.nodes) for child in node.children or ()}

    def world(node: int, key: int) -> np.ndarray:
        matrix = np.eye(4)
        matrix[:3, 3] = file.nodes[node].translation or (0, 0, 0)
        if (node, "rotation") in tracks:
            matrix[:3, :3] = Rotation.from_quat(tracks[node, "rotation"][key]).as_matrix()
        if (node, "translation") in tracks:
            matrix[:3, 3] = tracks[node, "translation"][key]
        return world(parents[node], key) @ matrix if node in parents else matrix

    ends = np.concatenate((rest, np.ones((len(rest), 1))), 1)
    poses = []
    for key in range(len(times)):
        matrices = np.stack([world(joint, key) for joint in shown.joints]) @ binding
        blended = (weights[..., None, None] * matrices[bones]).sum(1)
        poses.append((blended @ ends[..., None])[:, :3, 0])
    return times, np.stack(poses)


def morphed(content: bytes) -> np.ndarray:
    """The vertices at every frame, out of a GLB with a morph target per frame."""
    file = pygltflib.GLTF2.load_from_bytes(content)
    primitive = file.meshes[0].primitives[0]
    rest = rows(file, primitive.attributes.POSITION)
    return np.stack([rest, *(rest + rows(file, target["POSITION"]) for target in primitive.targets)])


def test_the_skin_in_the_file_misses_the_morphed_file_by_what_the_rig_says(
    rigged: tuple[Asset4D, Rig, bytes],
) -> None:
    asset, rig, content = rigged
    _, poses = skin(pygltflib.GLTF2.load_from_bytes(content))
    missed = np.linalg.norm(poses[:-1] - morphed(write_glb(asset)), axis=-1)
    assert np.sqrt(np.square(missed).mean()) == pytest.approx(rig.rms, rel=1e-3)  # weights have 16 bits
    assert missed.max() == pytest.approx(rig.max_distance, rel=1e-2)
    assert rig.error <= 0.02


def test_only_the_root_moves_and_the_bones_are_numbered(rigged: tuple[Asset4D, Rig, bytes]) -> None:
    _, rig, content = rigged
    file = pygltflib.GLTF2.load_from_bytes(content)
    joints = file.skins[0].joints
    assert [file.nodes[joint].name for joint in joints] == [f"bone_{n:02d}" for n in range(1, len(joints) + 1)]
    assert rig.stretch < 1e-4
    moving = [each.target.node for each in file.animations[0].channels if each.target.path == "translation"]
    assert moving == [joints[0]]


def test_the_animation_is_closed_and_lasts_as_long_as_the_video(rigged: tuple[Asset4D, Rig, bytes]) -> None:
    asset, _, content = rigged
    times, poses = skin(pygltflib.GLTF2.load_from_bytes(content))
    np.testing.assert_allclose(times, np.arange(len(asset.offsets) + 1) / FPS, rtol=1e-6)
    np.testing.assert_allclose(poses[-1], poses[0], atol=1e-6)


def test_the_nodes_stand_at_rest(rigged: tuple[Asset4D, Rig, bytes]) -> None:
    _, rig, content = rigged
    file = pygltflib.GLTF2.load_from_bytes(content)
    binding = rows(file, file.skins[0].inverseBindMatrices).reshape(-1, 4, 4)
    np.testing.assert_allclose(-binding[:, 3, :3], rig.rest_positions, atol=1e-6)
    places: dict[int, Any] = {}
    for joint, parent in zip(file.skins[0].joints, rig.parents.tolist(), strict=True):
        above = places[file.skins[0].joints[parent]] if parent >= 0 else np.zeros(3)
        places[joint] = above + file.nodes[joint].translation
    np.testing.assert_allclose(list(places.values()), rig.rest_positions, atol=1e-6)


def test_weights_sum_to_exactly_one_and_unused_slots_name_no_bone(rigged: tuple[Asset4D, Rig, bytes]) -> None:
    file = pygltflib.GLTF2.load_from_bytes(rigged[2])
    attributes = file.meshes[0].primitives[0].attributes
    weights, bones = rows(file, attributes.WEIGHTS_0), rows(file, attributes.JOINTS_0)
    assert (weights.astype(int).sum(1) == 65535).all()
    assert (bones[weights == 0] == 0).all()


def test_others_see_the_mesh_at_rest(rigged: tuple[Asset4D, Rig, bytes], tmp_path: Path) -> None:
    asset, _, content = rigged
    (tmp_path / "a.glb").write_bytes(content)
    mesh = trimesh.load(tmp_path / "a.glb", process=False).to_geometry()
    np.testing.assert_allclose(mesh.vertices, asset.mesh.vertices, atol=1e-6)


@pytest.mark.parametrize(
    "settings",
    [
        GltfSettings(quantized=False),
        GltfSettings(image="webp", quantized=False),
        GltfSettings(interpolation="step", quantized=False),
    ],
)
def test_the_khronos_validator_finds_nothing(
    settings: GltfSettings, rigged: tuple[Asset4D, Rig, bytes], tmp_path: Path
) -> None:
    asset, rig, _ = rigged
    (tmp_path / "a.glb").write_bytes(write_rigged_glb(asset, rig, settings))
    report = run_node("validate.mjs", str(tmp_path / "a.glb"))
    assert (report["errors"], report["warnings"]) == (0, 0), report["messages"]


def test_compressed_skins_are_valid_and_smaller(rigged: tuple[Asset4D, Rig, bytes], tmp_path: Path) -> None:
    pytest.importorskip("meshoptimizer", reason="meshoptimizer is not installed: make clients")
    asset, rig, content = rigged
    packed = write_rigged_glb(asset, rig, GltfSettings(image="png", meshopt=True, quantized=False))
    (tmp_path / "a.glb").write_bytes(packed)
    assert len(packed) < len(content)
    report = run_node("validate.mjs", str(tmp_path / "a.glb"))
    assert report["errors"] == 0, report["messages"]


@pytest.mark.parametrize("meshopt", [False, True])
def test_a_quantized_skin_moves_as_the_exact_one(rigged: tuple[Asset4D, Rig, bytes], meshopt: bool) -> None:
    """Compare vertices by the words of the specification; 8-bit weights move a vertex by up to 1/255 of the motion."""
    asset, rig, content = rigged
    small = write_rigged_glb(asset, rig, GltfSettings(image="png", meshopt=meshopt))
    assert len(small) < 0.85 * len(content)
    parsed, exact = GlbReader(small), GlbReader(content)
    assert parsed.tree["extensionsRequired"][0] == "KHR_mesh_quantization"
    attributes = parsed.tree["meshes"][0]["primitives"][0]["attributes"]
    weights = parsed.accessor(attributes["WEIGHTS_0"])
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-6)
    skin = parsed.tree["skins"][0]
    binding = np.frombuffer(parsed.view(parsed.tree["accessors"][skin["inverseBindMatrices"]]["bufferView"]), "<f4")
    vertices = parsed.accessor(attributes["POSITION"]).astype(float)
    matrix = binding.reshape(-1, 4, 4)[0].T
    placed = vertices @ matrix[:3, :3].T + matrix[:3, 3] + rig.rest_positions[0].numpy()
    first = exact.tree["meshes"][0]["primitives"][0]["attributes"]["POSITION"]
    given = exact.accessor(first)
    distances = np.linalg.norm(placed[:, None] - given[None], axis=-1).min(1)
    assert distances.max() < 2e-4


@pytest.mark.parametrize("meshopt", [False, True])
def test_readers_without_skinning_see_a_quantized_skin_at_the_size_of_the_morphed_file(
    rigged: tuple[Asset4D, Rig, bytes], meshopt: bool
) -> None:
    asset, rig, _ = rigged
    settings = GltfSettings(meshopt=meshopt)
    parsed = GlbReader(write_rigged_glb(asset, rig, settings))
    position = parsed.tree["accessors"][parsed.tree["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    morphed_file = AnimatedGlb(write_glb(asset, settings))
    size = (morphed_file.box_max - morphed_file.box_min).max()
    rest = asset.mesh.vertices.numpy()
    np.testing.assert_allclose((position["min"], position["max"]), (rest.min(0), rest.max(0)), atol=1e-4)
    assert (np.array(position["min"]) > morphed_file.box_min - 0.05 * size).all()
    assert (np.array(position["max"]) < morphed_file.box_max + 0.05 * size).all()


def test_the_validator_finds_nothing_in_a_quantized_skin(rigged: tuple[Asset4D, Rig, bytes], tmp_path: Path) -> None:
    asset, rig, _ = rigged
    (tmp_path / "a.glb").write_bytes(write_rigged_glb(asset, rig, GltfSettings()))
    report = run_node("validate.mjs", str(tmp_path / "a.glb"))
    assert (report["errors"], report["warnings"]) == (0, 0), report["messages"]


def test_equal_rigs_give_equal_bytes(rigged: tuple[Asset4D, Rig, bytes]) -> None:
    asset, rig, content = rigged
    assert write_rigged_glb(asset, rig, GltfSettings(image="png", quantized=False)) == content


def test_a_rig_that_misses_too_much_is_left_out_with_the_reason() -> None:
    asset = swaying()
    rig, said = fit_asset_rig(asset, 1, 0.05)
    assert rig is None
    assert said.startswith("no rig: 1 bone misses")
    assert "5.0% is allowed" in said


def test_a_rig_that_follows_is_given_with_its_figures() -> None:
    rig, said = fit_asset_rig(swaying(), 8, 0.1)
    assert rig is not None
    assert f"{len(rig.rest_positions)} bones miss {rig.error:.1%}" in said


def test_the_figures_of_a_rig_do_not_depend_on_the_height_of_the_asset() -> None:
    asset, scale = swaying(), 0.02
    placed = Placement(scale).surface(asset)
    assert isinstance(placed, Asset4D)
    assert fit_asset_rig(placed, 2, 0.5, scale)[1] == fit_asset_rig(asset, 2, 0.5)[1]


def test_a_rig_of_another_mesh_is_refused(rigged: tuple[Asset4D, Rig, bytes]) -> None:
    asset, rig, _ = rigged
    other = TexturedMesh(asset.mesh.vertices[:-1], asset.mesh.faces, asset.mesh.uvs[:-1], asset.mesh.texture)
    with pytest.raises(BadInput, match="vertices"):
        write_rigged_glb(Asset4D(other, asset.offsets[:, :-1], FPS), rig, GltfSettings(quantized=False))
