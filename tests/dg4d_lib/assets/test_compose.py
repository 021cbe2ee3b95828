"""Composed scenes: placement and timing as third-party readers see them."""

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from dg4d_lib.asset_settings import GltfSettings
from dg4d_lib.assets.animated import Asset4D, interpolate_frames
from dg4d_lib.assets.formats.glb import write_frames_glb, write_glb, write_mesh_glb
from dg4d_lib.assets.formats.gltf import GltfDocument
from dg4d_lib.assets.scenes.compose import Actor, AnimatedGlb, compose_glb, line_up, scene_duration
from dg4d_lib.assets.scenes.scene import SceneItem
from dg4d_lib.errors import BadInput
from dg4d_lib.mesh.textured import TexturedMesh
from tests.clients.node import run_node

FRAMES, FPS = 4, 8.0
KINDS = {5123: "<u2", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
SETTINGS = {
    "plain": GltfSettings(quantized=False),
    "quantized": GltfSettings(quantized=True),
    "webp": GltfSettings(image="webp", moving_normals=False, quantized=False),
    "held": GltfSettings(interpolation="step", quantized=False),
}


def gem(radius: float = 0.3, center: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> TexturedMesh:
    shape = trimesh.creation.icosphere(subdivisions=1, radius=radius)
    vertices = torch.tensor(shape.vertices + np.array(center), dtype=torch.float32)
    uvs = torch.rand(len(vertices), 2, generator=torch.Generator().manual_seed(0))
    texture = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(1))
    return TexturedMesh(vertices, torch.tensor(shape.faces), uvs, texture)


def hopping(frames: int = FRAMES, changing: bool = False) -> Asset4D:
    mesh = gem(center=(0.1, 0.2, -0.1))
    offsets = torch.zeros(frames, len(mesh.vertices), 3)
    offsets[..., 1] = torch.linspace(0, math.pi, frames).sin()[:, None] * torch.linspace(0.5, 1, len(mesh.vertices))
    textures = torch.rand(frames, 16, 16, 3, generator=torch.Generator().manual_seed(2)) if changing else None
    return Asset4D(mesh, offsets, FPS, {"notes": ["hops"]}, textures)


def tracked(settings: GltfSettings = SETTINGS["plain"]) -> AnimatedGlb:
    return AnimatedGlb(write_glb(hopping(), settings))


def per_frame() -> AnimatedGlb:
    return AnimatedGlb(write_frames_glb([gem(0.1 * (1 + i)) for i in range(3)], FPS))


def actor(name: str, body: AnimatedGlb, **where: object) -> Actor:
    return Actor(name, body, SceneItem(package="p", **where))


def rows(file: pygltflib.GLTF2, index: int) -> np.ndarray:
    accessor = file.accessors[index]
    view = file.bufferViews[accessor.bufferView]
    values = np.frombuffer(
        file.binary_blob(), KINDS[accessor.componentType], accessor.count * WIDTHS[accessor.type], view.byteOffset
    )
    return values.reshape(accessor.count, -1)


def named(file: pygltflib.GLTF2, name: str) -> int:
    (number,) = (number for number, node in enumerate(file.nodes) if node.name == name)
    return number


def track(file: pygltflib.GLTF2, node: int, path: str) -> tuple[np.ndarray, np.ndarray]:
    """Keys and values of a node's track, read by pygltflib."""
    (animation,) = file.animations
    (sampler,) = (
        animation.samplers[c.sampler] for c in animation.channels if (c.target.node, c.target.path) == (node, path)
    )
    keys = rows(file, sampler.input)[:, 0]
    return keys, rows(file, sampler.output).reshape(len(keys), -1)


def shown_at(file: pygltflib.GLTF2, name: str, seconds: float) -> np.ndarray:
    """The vertices of a tracked asset in the scene at a moment, by the words of the glTF specification."""
    place = file.nodes[named(file, name)]
    (child,) = place.children
    primitive = file.meshes[file.nodes[child].mesh].primitives[0]
    keys, values = track(file, child, "weights")
    weights = [np.interp(seconds, keys, column) for column in values.T]
    targets = [rows(file, target["POSITION"]) for target in primitive.targets]
    vertices = rows(file, primitive.attributes.POSITION) + np.tensordot(weights, targets, 1)
    return Rotation.from_quat(place.rotation).apply(vertices * place.scale) + place.translation


def expected_at(one: Actor, position: float) -> np.ndarray:
    """The same, from the asset: a position is a frame number."""
    asset = hopping()
    vertices = asset.mesh.vertices + interpolate_frames(asset.offsets, torch.tensor([position]))[0]
    return trimesh.transform_points(vertices.numpy(), one.transform)


TURNED = {"position": (1.0, 2.0, 3.0), "rotation_deg": (10.0, 50.0, -20.0), "scale": 1.5}


@pytest.mark.parametrize(("seconds", "position"), [(0.0, 0.0), (0.125, 1.0), (0.3, 2.4), (0.45, 3.6), (0.6, 0.8)])
def test_an_asset_moves_where_it_was_placed_and_begins_again(seconds: float, position: float) -> None:
    one = actor("one", tracked(), **TURNED)
    file = pygltflib.GLTF2.load_from_bytes(compose_glb([one], 1.0))
    np.testing.assert_allclose(shown_at(file, "one", seconds), expected_at(one, position), atol=2e-5)


@pytest.mark.parametrize(
    ("seconds", "position"),
    [(0.1, 0.0), (0.2, 0.0), (0.2625, 1.0), (0.325, 2.0), (0.3875, 3.0), (0.42, 3.0), (2.0, 3.0)],
)
def test_an_asset_waits_plays_once_at_its_speed_and_stands_in_its_last_pose(seconds: float, position: float) -> None:
    one = actor("one", tracked(), start_s=0.2, speed=2.0, loop=False)
    file = pygltflib.GLTF2.load_from_bytes(compose_glb([one], 2.0))
    np.testing.assert_allclose(shown_at(file, "one", seconds), expected_at(one, position), atol=2e-5)


@pytest.mark.parametrize("loop", [True, False])
def test_the_times_of_an_actor_are_those_of_its_track(loop: bool) -> None:
    one = actor("one", tracked(), start_s=0.2, speed=2.0, loop=loop)
    file = pygltflib.GLTF2.load_from_bytes(compose_glb([one], 1.5))
    for seconds in (0.1, 0.21, 0.4, 0.77, 1.1):
        (played,) = one.animation_times(np.array([seconds]))
        np.testing.assert_allclose(shown_at(file, "one", seconds), expected_at(one, played * FPS), atol=2e-5)


def test_the_last_pose_is_not_on_the_way_back_to_the_first() -> None:
    body = AnimatedGlb(write_glb(hopping(4 * FRAMES), SETTINGS["plain"]), return_s=4 / FPS)  # 4 keys per frame
    assert body.last_pose_s == pytest.approx(4 * (FRAMES - 1) / FPS)
    one = actor("one", body, loop=False)
    (played,) = one.animation_times(np.array([4 * FRAMES / FPS]))
    assert played == pytest.approx(body.last_pose_s)
    file = pygltflib.GLTF2.load_from_bytes(compose_glb([one], 4.0))
    _, values = track(file, named(file, "one subject"), "weights")
    assert values[-1].argmax() + 1 == 4 * (FRAMES - 1)


def test_the_last_frame_stays_when_every_frame_has_a_mesh_of_its_own() -> None:
    file = pygltflib.GLTF2.load_from_bytes(compose_glb([actor("many", per_frame(), loop=False)], 2.0))
    last = [track(file, named(file, f"many frame_{i:03d}"), "scale")[1][-1, 0] for i in range(3)]
    assert last == [0, 0, 1]


def test_every_track_ends_with_the_scene() -> None:
    actors = [
        actor("one", tracked(), start_s=0.3),
        actor("two", per_frame(), speed=0.7),
        actor("three", tracked(), loop=False),
    ]
    file = pygltflib.GLTF2.load_from_bytes(compose_glb(actors, 1.7))
    (animation,) = file.animations
    for sampler in animation.samplers:
        keys = rows(file, sampler.input)[:, 0]
        assert keys[-1] == np.float32(1.7)
        assert (np.diff(keys) > 0).all()


@pytest.mark.parametrize("speed", [200.0, 500.0])
def test_an_asset_still_moves_at_a_speed_at_which_its_keys_are_too_close(speed: float) -> None:
    fps = 80.0  # a key every 63 or 25 microseconds
    body = AnimatedGlb(write_glb(replace(hopping(40), fps=fps), SETTINGS["plain"]))
    one = actor("one", body, start_s=0.2, speed=speed, loop=False)
    file = pygltflib.GLTF2.load_from_bytes(compose_glb([one], 1.0))
    keys, values = track(file, named(file, "one subject"), "weights")
    assert (np.diff(keys) > 0.99e-4).all() and len(keys) > 40 / fps / speed / 1.3e-4
    assert keys[0] == np.float32(0.2) and not values[0].any()  # frame 0 before
    shown = values[1:-2].argmax(1) + 1
    np.testing.assert_allclose(keys[1:-2], 0.2 + shown / fps / speed, atol=1e-7)
    assert values[-1].argmax() + 1 == 39  # the last frame afterwards


def test_a_looping_motion_is_cut_where_it_is_when_the_scene_ends() -> None:
    one = actor("one", tracked())
    file = pygltflib.GLTF2.load_from_bytes(compose_glb([one], 0.8))
    np.testing.assert_allclose(shown_at(file, "one", 0.8), expected_at(one, (0.8 * FPS) % FRAMES), atol=2e-5)


def test_frames_are_shown_one_at_a_time_in_every_round() -> None:
    body = per_frame()
    file = pygltflib.GLTF2.load_from_bytes(compose_glb([actor("many", body)], 2 * body.duration_s))
    nodes = [named(file, f"many frame_{i:03d}") for i in range(3)]
    for seconds, frame in ((0.05, 0), (0.15, 1), (0.3, 2), (0.4, 0), (0.55, 1), (0.7, 2)):
        shown = []
        for node in nodes:
            keys, scales = track(file, node, "scale")
            shown.append(scales[np.searchsorted(keys, seconds, side="right") - 1, 0])
        assert np.argmax(shown) == frame
        assert sum(shown) == 1


@pytest.mark.parametrize("name", SETTINGS)
def test_others_find_the_vertices_at_rest_where_they_were_placed(name: str, tmp_path: Path) -> None:
    one = actor("one", tracked(SETTINGS[name]), **TURNED)
    (tmp_path / "scene.glb").write_bytes(compose_glb([actor("other", per_frame()), one]))
    scene = trimesh.load(tmp_path / "scene.glb", process=False)
    (node,) = (node for node in scene.graph.nodes_geometry if node.startswith("one"))
    matrix, geometry = scene.graph[node]
    found = trimesh.transform_points(scene.geometry[geometry].vertices, matrix)
    np.testing.assert_allclose(found, trimesh.transform_points(hopping().mesh.vertices, one.transform), atol=1e-4)


def mixed() -> list[Actor]:
    pointed = AnimatedGlb(write_glb(hopping(changing=True), GltfSettings(textures="pointer", quantized=False)))
    return [
        actor("plain", tracked(), position=(1, 0, 0)),
        actor("frames", per_frame(), start_s=0.5, speed=2.0),
        actor("core", AnimatedGlb(write_glb(hopping(changing=True), GltfSettings(textures="core", quantized=False)))),
        actor("pointed", pointed, **TURNED),
        actor("pointed again", pointed, start_s=0.1),
        *(actor(name, tracked(settings)) for name, settings in SETTINGS.items() if name != "plain"),
        actor("still", AnimatedGlb(write_mesh_glb(gem()))),
        actor("日本 ü/.:", tracked(), loop=False),
    ]


def test_the_khronos_validator_finds_nothing_in_a_scene_of_every_kind(tmp_path: Path) -> None:
    (tmp_path / "scene.glb").write_bytes(compose_glb(mixed(), 2.3))
    report = run_node("validate.mjs", str(tmp_path / "scene.glb"))
    assert (report["errors"], report["warnings"]) == (0, 0), report["messages"]


def test_compressed_assets_stay_compressed_and_valid(tmp_path: Path) -> None:
    pytest.importorskip("meshoptimizer", reason="meshoptimizer is not installed: make clients")
    one, two = (
        actor(name, tracked(GltfSettings(meshopt=True, quantized=False)), position=(x, 0, 0))
        for name, x in (("a", 0), ("b", 1))
    )
    content = compose_glb([one, actor("c", tracked()), two])
    (tmp_path / "scene.glb").write_bytes(content)
    report = run_node("validate.mjs", str(tmp_path / "scene.glb"))
    assert report["errors"] == 0, report["messages"]
    again = AnimatedGlb(content)
    assert "EXT_meshopt_compression" in again.file.tree["extensionsRequired"]
    boxes = [np.stack((each.glb.box_min, each.glb.box_max)) + each.origin for each in (one, two)]
    np.testing.assert_allclose(again.box_min[0], boxes[0].min(0)[0], atol=1e-5)
    np.testing.assert_allclose(again.box_max[0], boxes[1].max(0)[0], atol=1e-5)


def test_extensions_are_announced_as_in_the_assets() -> None:
    tree = AnimatedGlb(compose_glb(mixed(), 2.3)).file.tree
    assert tree["extensionsRequired"] == ["KHR_mesh_quantization"]
    assert {"KHR_animation_pointer", "KHR_texture_transform", "EXT_texture_webp"} < set(tree["extensionsUsed"])


def test_pointers_lead_to_the_materials_of_their_own_actor() -> None:
    tree = AnimatedGlb(compose_glb(mixed(), 2.3)).file.tree
    targets = [channel["target"] for channel in tree["animations"][0]["channels"]]
    pointers = [t["extensions"]["KHR_animation_pointer"]["pointer"] for t in targets if t["path"] == "pointer"]
    names = [tree["materials"][int(pointer.split("/")[2])]["name"] for pointer in pointers]
    assert names == ["pointed subject surface", "pointed again subject surface"]


def test_what_is_used_twice_is_stored_once() -> None:
    body = tracked()
    once = compose_glb([actor("a", body)])
    twice = compose_glb([actor("a", body), actor("b", body, position=(1, 0, 0))])
    assert len(twice) < len(once) + 2500  # nodes, names and tracks; the texture alone is as much


def test_a_foot_stands_on_its_position() -> None:
    one = actor("one", tracked(), position=(1.0, 2.0, 3.0), rotation_deg=(0.0, 90.0, 0.0), scale=2.0)
    first = expected_at(one, 0.0)
    assert first[:, 1].min() == pytest.approx(2.0, abs=1e-5)
    assert (first.min(0) + first.max(0))[[0, 2]] / 2 == pytest.approx((1.0, 3.0), abs=1e-5)


def test_a_row_leaves_the_room_asked_for_and_has_its_middle_at_the_origin() -> None:
    bodies = [tracked(), per_frame(), AnimatedGlb(write_mesh_glb(gem(0.5)))]
    actors = [
        actor(str(i), body, position=p) for i, (body, p) in enumerate(zip(bodies, line_up(bodies, 0.2), strict=True))
    ]
    edges = [(a.glb.box_min[0] + a.origin[0], a.glb.box_max[0] + a.origin[0]) for a in actors]
    for (_, end), (start, _) in pairwise(edges):
        assert start - end == pytest.approx(0.2)
    assert edges[0][0] + edges[-1][1] == pytest.approx(0.0)


def test_a_box_holds_all_poses_also_of_frames_that_are_hidden() -> None:
    np.testing.assert_allclose(
        per_frame().box_max, trimesh.creation.icosphere(subdivisions=1, radius=0.3).bounds[1], atol=1e-6
    )
    assert tracked().box_max[1] > hopping().mesh.vertices[:, 1].max() + 0.5


def test_a_foot_is_that_of_frame_0_in_files_with_a_target_for_it() -> None:
    document = GltfDocument({})
    rest = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4")
    shape = {
        "attributes": {"POSITION": document.add_accessor("p", rest, 34962)},
        "indices": document.add_accessor("i", np.arange(3, dtype="<u2"), 34963),
        "targets": [{"POSITION": document.add_accessor("t", rest * 0 + height, 34962)} for height in (2.0, 1.0)],
    }
    node = document.add("nodes", name="n", mesh=document.add("meshes", name="m", primitives=[shape]))
    times = document.add_accessor("s", np.array([0, 1, 2], "<f4"))
    weights = document.add_accessor("w", np.array([1, 0, 0, 1, 1, 0], "<f4"))
    channel = {"sampler": 0, "target": {"node": node, "path": "weights"}}
    document.add("animations", name="a", samplers=[{"input": times, "output": weights}], channels=[channel])
    document.tree["scene"] = document.add("scenes", name="s", nodes=[node])
    body = AnimatedGlb(document.to_bytes())
    assert (body.foot[1], body.box_min[1]) == (2.0, 1.0)


def test_a_scene_ends_when_every_asset_has_played_once() -> None:
    actors = [actor("one", tracked(), start_s=1.0, speed=0.5), actor("two", tracked())]
    assert scene_duration(actors, None) == pytest.approx(1.0 + 2 * FRAMES / FPS)


def test_an_asset_that_starts_after_the_end_is_refused() -> None:
    with pytest.raises(BadInput, match=r"late starts at 3.0 s, after the end of the scene at 2.0 s"):
        compose_glb([actor("early", tracked()), actor("late", tracked(), start_s=3.0)], 2.0)


def test_endless_repetition_is_refused() -> None:
    with pytest.raises(BadInput, match="lower its speed"):
        compose_glb([actor("fast", tracked(), speed=1000.0)], 3600.0)


def test_a_scene_needs_an_asset() -> None:
    with pytest.raises(BadInput, match="none"):
        compose_glb([])


def test_a_file_without_a_mesh_is_refused() -> None:
    document = GltfDocument({})
    document.tree["scene"] = document.add("scenes", nodes=[document.add("nodes", name="nothing")])
    with pytest.raises(BadInput, match="no mesh"):
        AnimatedGlb(document.to_bytes())


def test_a_file_of_another_form_is_refused() -> None:
    with pytest.raises(BadInput, match="not an animated asset"):
        AnimatedGlb(of_nodes([{"mesh": 7}]))


def of_nodes(nodes: list[dict[str, Any]]) -> bytes:
    """Return a GLB of a triangle and nodes, of which the first one is the root."""
    document = GltfDocument({})
    document.tree["nodes"] = nodes
    positions = document.add_accessor("p", np.eye(3, dtype="<f4"), 34962)
    document.add("meshes", name="m", primitives=[{"attributes": {"POSITION": positions}}])
    document.tree["scene"] = document.add("scenes", name="s", nodes=[0])
    return document.to_bytes()


@pytest.mark.parametrize(
    "nodes",
    [
        [{"mesh": 0, "children": [0]}],
        [{"mesh": 0, "children": [1]}, {"children": [0]}],
        [{"children": [number + 1]} for number in range(5000)] + [{"mesh": 0}],
    ],
    ids=["own child", "circle of two", "deep"],
)
def test_nodes_without_an_end_are_refused(nodes: list[dict[str, Any]]) -> None:
    with pytest.raises(BadInput, match="circle or are nested too deeply"):
        AnimatedGlb(of_nodes(nodes))


def test_an_animated_circle_outside_of_the_scene_is_refused() -> None:
    body = tracked()
    nodes = body.file.tree["nodes"]
    body.animation["channels"][0]["target"]["node"] = len(nodes)
    nodes.append({"children": [len(nodes)]})
    with pytest.raises(BadInput, match="not an animated asset"):
        compose_glb([actor("odd", body)])


def test_equal_scenes_give_equal_bytes() -> None:
    assert compose_glb(mixed(), 2.3) == compose_glb(mixed(), 2.3)
