"""Animated GLB: validity, round trip, third-party readers."""

import io
import json
import struct
from collections.abc import Callable
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
from dg4d_lib.assets.formats.glb import read_glb, read_mesh_glb, write_frames_glb, write_glb, write_mesh_glb
from dg4d_lib.assets.formats.gltf import GlbReader, GltfDocument
from dg4d_lib.errors import BadInput
from dg4d_lib.input_settings import WarpSettings
from dg4d_lib.mesh.textured import TexturedMesh

FRAMES, FPS = 5, 7.0
PNG = GltfSettings(image="png", quantized=False)
COMPONENTS = {5126: "<f4", 5125: "<u4", 5123: "<u2"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}


def ball(subdivisions: int = 1) -> TexturedMesh:
    """A sphere whose triangles share no vertex, as if every edge were a seam."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.5)
    vertices = torch.tensor(sphere.triangles.reshape(-1, 3), dtype=torch.float32)
    faces = torch.arange(len(vertices)).reshape(-1, 3)
    generator = torch.Generator().manual_seed(0)
    texture = torch.randint(0, 256, (16, 8, 3), generator=generator) / 255
    return TexturedMesh(vertices, faces, torch.rand(len(vertices), 2, generator=generator), texture)


def moving_ball(frames: int = FRAMES, fps: float = FPS) -> Asset4D:
    mesh = ball()
    offsets = torch.randn(frames, len(mesh.vertices), 3, generator=torch.Generator().manual_seed(1)) / 10
    return Asset4D(mesh, offsets, fps, {"notes": ["a preview"], "empty": [], "nothing": None, "text": ""})


def unpack(content: bytes) -> tuple[dict[str, Any], bytes]:
    """The JSON and the buffer, read by the specification and not by the product."""
    (text_length,) = struct.unpack_from("<I", content, 12)
    return json.loads(content[20 : 20 + text_length]), content[28 + text_length :]


def rows(tree: dict[str, Any], binary: bytes, index: int) -> np.ndarray:
    accessor = tree["accessors"][index]
    view = tree["bufferViews"][accessor["bufferView"]]
    count = accessor["count"] * WIDTHS[accessor["type"]]
    values = np.frombuffer(binary, COMPONENTS[accessor["componentType"]], count, view["byteOffset"])
    assert values.nbytes == view["byteLength"]
    return values.reshape(accessor["count"], -1)


WRITTEN = {
    "tracked": lambda: write_glb(moving_ball(), PNG),
    "one frame": lambda: write_glb(moving_ball(frames=1)),
    "many frames": lambda: write_glb(moving_ball(frames=300)),
    "per frame": lambda: write_frames_glb([ball(0), ball(1), ball(0)], FPS),
    "still": lambda: write_mesh_glb(ball(), PNG),
}


def test_the_smallest_frame_rate_of_a_driving_video_has_finite_times() -> None:
    slowest = WarpSettings.model_json_schema()["properties"]["fps"]["minimum"]
    for settings in (PNG, GltfSettings()):
        assert read_glb(write_glb(moving_ball(frames=128, fps=slowest), settings)).fps == pytest.approx(slowest)


@pytest.mark.parametrize("kind", WRITTEN)
def test_bounds_and_places_of_all_accessors_are_true(kind: str) -> None:
    content = WRITTEN[kind]()
    assert struct.unpack_from("<4sII", content) == (b"glTF", 2, len(content))
    tree, binary = unpack(content)
    assert tree["buffers"] == [{"byteLength": len(binary)}]
    assert len(binary) % 4 == 0
    for index, accessor in enumerate(tree["accessors"]):
        values = rows(tree, binary, index)
        assert np.isfinite(values).all()
        assert values.min(0).tolist() == accessor["min"]
        assert values.max(0).tolist() == accessor["max"]
    ends = [0]
    for view in tree["bufferViews"]:
        assert view["byteOffset"] % 4 == 0
        assert view["byteOffset"] >= ends[-1]
        ends.append(view["byteOffset"] + view["byteLength"])
    assert ends[-1] <= len(binary)


@pytest.mark.parametrize("kind", WRITTEN)
def test_everything_has_a_name_and_no_extension_is_used(kind: str) -> None:
    tree, _ = unpack(WRITTEN[kind]())
    collections = ("accessors", "animations", "bufferViews", "images", "materials", "meshes", "nodes", "samplers")
    for collection in (*collections, "scenes", "textures"):
        assert all(item["name"] for item in tree.get(collection, []))
    assert "extension" not in json.dumps(tree)


@pytest.mark.parametrize("kind", WRITTEN)
def test_other_readers_load_it(kind: str) -> None:
    content = WRITTEN[kind]()
    scene = trimesh.load(io.BytesIO(content), file_type="glb")
    assert all(len(mesh.faces) > 0 for mesh in scene.geometry.values())
    theirs = pygltflib.GLTF2.load_from_bytes(content)
    assert len(theirs.meshes) == len(scene.geometry)


def test_a_tracked_mesh_comes_back_with_frame_0_as_its_base() -> None:
    given = moving_ball()
    back = read_glb(write_glb(given, PNG))
    for name in ("faces", "uvs"):
        assert torch.equal(getattr(back.mesh, name), getattr(given.mesh, name))
    torch.testing.assert_close(back.mesh.texture, given.mesh.texture, atol=1e-7, rtol=0)
    assert torch.equal(back.mesh.vertices, given.mesh.vertices + given.offsets[0])
    assert torch.equal(back.offsets, given.offsets - given.offsets[0])
    assert back.extras == given.extras


def test_a_file_with_a_target_for_every_frame_comes_back() -> None:
    """Earlier versions wrote the mesh of the reference frame as base, and one-hot weights at every frame."""
    document, given = GltfDocument({}), moving_ball()
    exact = GlbReader(write_glb(given, PNG))
    tree = exact.tree
    for accessor in tree["accessors"]:
        view = document.add_view_of(exact, accessor["bufferView"])
        document.add("accessors", **{**accessor, "bufferView": view})
    primitive = tree["meshes"][0]["primitives"][0]
    rest = document.add_accessor("rest", given.mesh.vertices.numpy(), 34962)
    targets = [{"POSITION": document.add_accessor("t", pose.numpy(), 34962)} for pose in given.offsets]
    weights = document.add_accessor("w", np.eye(FRAMES, dtype="<f4")[[*range(FRAMES), 0]].ravel())
    primitive |= {"attributes": {**primitive["attributes"], "POSITION": rest}, "targets": targets}
    tree["animations"][0]["samplers"][0]["output"] = weights
    for image in tree["images"]:
        image["bufferView"] = document.add_view_of(exact, image["bufferView"])
    for name in ("meshes", "nodes", "materials", "textures", "images", "samplers", "animations", "scenes"):
        document.tree[name] = tree[name]
    back = read_glb(document.to_bytes())
    assert torch.equal(back.mesh.vertices, given.mesh.vertices)
    assert torch.equal(back.offsets, given.offsets)


@pytest.mark.parametrize("fps", [7.0, 23.976, 29.97, 120.0, 0.5])
def test_the_frame_rate_comes_back(fps: float) -> None:
    assert read_glb(write_glb(moving_ball(fps=fps))).fps == fps


def test_a_single_frame_comes_back() -> None:
    given = moving_ball(frames=1)
    back = read_glb(write_glb(given))
    assert torch.equal(back.mesh.vertices + back.offsets[0], given.mesh.vertices + given.offsets[0])


def test_each_key_shows_one_frame_and_the_last_key_shows_the_first() -> None:
    tree, binary = unpack(write_glb(moving_ball()))
    (animation,) = tree["animations"]
    (sampler,) = animation["samplers"]
    assert sampler["interpolation"] == "LINEAR"
    assert animation["channels"] == [{"sampler": 0, "target": {"node": 0, "path": "weights"}}]
    np.testing.assert_allclose(rows(tree, binary, sampler["input"])[:, 0], np.arange(FRAMES + 1) / FPS, rtol=1e-6)
    weights = rows(tree, binary, sampler["output"]).reshape(FRAMES + 1, FRAMES - 1)
    assert np.array_equal(weights, np.eye(FRAMES)[[*range(FRAMES), 0], 1:])  # frame 0 is the base
    assert tree["meshes"][0]["weights"] == [0, 0, 0, 0]


def test_a_mesh_per_frame_is_shown_alone_at_its_time() -> None:
    tree, binary = unpack(write_frames_glb([ball(0), ball(1), ball(0)], FPS))
    (animation,) = tree["animations"]
    for node, (channel, sampler) in enumerate(zip(animation["channels"], animation["samplers"], strict=True)):
        assert channel["target"] == {"node": node, "path": "scale"}
        assert sampler["interpolation"] == "STEP"
        keys = (rows(tree, binary, sampler["input"])[:, 0] * FPS).round().astype(int).tolist()
        scales = rows(tree, binary, sampler["output"])
        assert (scales == scales[:, :1]).all()
        held = [scales[max(i for i, key in enumerate(keys) if key <= frame), 0] for frame in range(4)]
        assert held == [node == frame % 3 for frame in range(4)]
    assert [node.get("scale") for node in tree["nodes"]] == [[1.0] * 3, [0.0] * 3, [0.0] * 3, None]
    assert tree["nodes"][tree["scenes"][0]["nodes"][0]] == {"name": "subject", "children": [0, 1, 2]}


def test_a_thousand_frames_come_back_and_no_node_holds_more_than_a_player_can() -> None:
    given = moving_ball(frames=1000)
    content = write_glb(given, PNG)
    assert torch.equal(read_glb(content).offsets, given.offsets - given.offsets[0])
    assert max(len(mesh["weights"]) for mesh in unpack(content)[0]["meshes"]) <= 129
    assert len(content) < 1000 * len(given.mesh.vertices) * 24 * 1.3  # what nodes share is written once


def test_nodes_of_a_long_animation_follow_each_other_without_a_gap() -> None:
    tree, binary = unpack(write_glb(moving_ball(frames=300)))
    (animation,) = tree["animations"]
    seconds = np.arange(301 * 4) / 4 / FPS
    shown, weighted = np.zeros((3, len(seconds))), []
    for channel, sampler in zip(animation["channels"], animation["samplers"], strict=True):
        times, output = rows(tree, binary, sampler["input"])[:, 0], rows(tree, binary, sampler["output"])
        node = channel["target"]["node"]
        if channel["target"]["path"] == "scale":
            shown[node] = output[np.searchsorted(times, seconds, side="right") - 1, 0]
        else:
            weighted.append((node, times[0], times[-1]))
    assert (shown.sum(0) == 1).all()
    for node, first, last in weighted:
        there = seconds[shown[node] == 1]
        assert first <= there[there < 300 / FPS - 1e-3].max()
        assert node == 0 or first <= there.min() + 1e-5
        assert last >= there[there < 300 / FPS - 1e-3].max()


def test_a_still_mesh_comes_back() -> None:
    back = read_mesh_glb(write_mesh_glb(ball(), PNG))
    assert torch.equal(back.vertices, ball().vertices)
    torch.testing.assert_close(back.texture, ball().texture, atol=1e-7, rtol=0)


def test_the_first_row_of_the_texture_is_the_top_of_the_embedded_picture() -> None:
    tree, binary = unpack(write_mesh_glb(ball(), PNG))
    view = tree["bufferViews"][tree["images"][0]["bufferView"]]
    content = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    picture = np.array(Image.open(io.BytesIO(content)))
    assert np.array_equal(picture, (ball().texture * 255).round().byte().numpy())


def test_many_vertices_get_wide_indices() -> None:
    count = 65536
    mesh = replace(ball(), vertices=torch.rand(count, 3), uvs=torch.rand(count, 2), faces=torch.tensor([[0, 1, 65535]]))
    back = read_mesh_glb(write_mesh_glb(mesh))
    assert torch.equal(back.faces, mesh.faces)


def test_equal_assets_give_equal_bytes() -> None:
    assert write_glb(moving_ball()) == write_glb(moving_ball())


@pytest.mark.parametrize(
    ("asset", "says"),
    [
        (replace(moving_ball(), fps=0.0), "positive"),
        (replace(moving_ball(), offsets=torch.zeros(0, len(ball().vertices), 3)), "at least one frame"),
        (replace(moving_ball(), offsets=moving_ball().offsets * float("nan")), "not finite"),
        (replace(moving_ball(), mesh=replace(ball(), faces=torch.zeros(0, 3, dtype=torch.long))), "without triangles"),
        (replace(moving_ball(), mesh=replace(ball(), vertices=ball().vertices * float("inf"))), "not finite"),
        (replace(moving_ball(), mesh=replace(ball(), vertices=ball().vertices * float("nan"))), "not finite"),
        (replace(moving_ball(), mesh=replace(ball(), texture=torch.zeros(0, 4, 3))), "needs a texture"),
        (replace(moving_ball(), mesh=replace(ball(), faces=ball().faces + 1)), "beyond"),
        (replace(moving_ball(), offsets=torch.zeros(2, 3, 3)), "offsets for 3"),
        (replace(moving_ball(), fps=float("nan")), "positive"),
        (replace(moving_ball(), textures=torch.full((FRAMES, 4, 4, 3), float("nan"))), "not finite"),
    ],
)
def test_an_unusable_asset_is_refused(asset: Asset4D, says: str) -> None:
    with pytest.raises(BadInput, match=says):
        write_glb(asset)


@pytest.mark.parametrize("side", [1, 3])
def test_tiny_textures_come_back(side: int) -> None:
    mesh = replace(ball(), texture=torch.full((side, side, 3), 0.2))
    torch.testing.assert_close(read_mesh_glb(write_mesh_glb(mesh)).texture, mesh.texture, atol=2 / 255, rtol=0)


@pytest.mark.slow
def test_a_texture_of_8192_pixels_is_written_whole() -> None:
    mesh = replace(ball(), texture=torch.full((1, 1, 3), 0.5).expand(8192, 8192, 3))
    tree, binary = unpack(write_mesh_glb(mesh))
    view = tree["bufferViews"][tree["images"][0]["bufferView"]]
    with Image.open(io.BytesIO(binary[view["byteOffset"] :])) as picture:
        assert picture.size == (8192, 8192)


def test_text_of_any_script_stays_in_the_extras() -> None:
    extras = {"name": 'süßer Fuchs 🦊 " \\ \n', "名前": ["きつね"]}
    assert read_glb(write_glb(replace(moving_ball(), extras=extras))).extras == extras


def test_no_meshes_are_refused() -> None:
    with pytest.raises(BadInput, match="at least one mesh"):
        write_frames_glb([], FPS)


def swapped(content: bytes, old: bytes, new: bytes) -> bytes:
    assert old in content
    assert len(old) == len(new)
    return content.replace(old, new)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "not a GLB"),
        (b"PK\x03\x04 a zip", "not a GLB"),
        (WRITTEN["tracked"]()[:16], "corrupt"),
        (WRITTEN["tracked"]()[:-1], "corrupt"),
        (swapped(WRITTEN["tracked"](), b'"POSITION"', b'"POSITIOM"'), "form"),
        (swapped(WRITTEN["tracked"](), b'"targets"', b'"tergets"'), "morph targets"),
        (swapped(WRITTEN["tracked"](), b'"mesh":0', b'"mush":0'), "shows 0 meshes"),
        (swapped(WRITTEN["tracked"](), b"IHDR", b"IHDX"), "form"),
        (swapped(WRITTEN["tracked"](), b'"indices":3', b'"indices":0'), "integers"),
        (WRITTEN["still"](), "morph targets"),
        (WRITTEN["per frame"](), "shows 3 meshes"),
    ],
)
def test_a_file_of_another_form_is_refused(content: bytes, says: str) -> None:
    with pytest.raises(BadInput, match=says):
        read_glb(content)


@pytest.mark.parametrize("read", [read_glb, read_mesh_glb])
def test_a_node_that_is_its_own_child_is_refused(read: Callable[[bytes], object]) -> None:
    content = swapped(WRITTEN["tracked"](), b'"name":"subject","mesh":0}', b'"children":[0],  "mesh":0}')
    with pytest.raises(BadInput, match="circle"):
        read(content)


def test_a_transform_on_the_mesh_is_not_overlooked() -> None:
    moved = swapped(WRITTEN["still"](), b'"name":"subject","mesh":0}', b'"scale":[2,2,20],"mesh":0}')
    with pytest.raises(BadInput, match="transform"):
        read_mesh_glb(moved)
