"""GLBs of other programs: read at rest, and written with morph targets."""

import json
import struct

import numpy as np
import pytest
import trimesh
from foreign_models import BOX, CORNERS, box_glb, skinned_glb

from dg4d_lib.assets.formats.foreign_glb import read_foreign_glb
from dg4d_lib.assets.formats.foreign_joints import read_skeleton
from dg4d_lib.assets.formats.foreign_motion import write_moving_glb
from dg4d_lib.assets.formats.foreign_placement import place_moving_glb
from dg4d_lib.assets.formats.gltf import INDEX_DATA, VERTEX_DATA, GlbReader, GltfDocument, read_accessor
from dg4d_lib.assets.placement import Placement
from dg4d_lib.errors import BadInput

MOST = 1000  # triangles


def edited(content: bytes, edit) -> bytes:
    reader = GlbReader(content)
    edit(reader.tree)
    text = json.dumps(reader.tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(reader.binary), b"BIN\0") + reader.binary
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def shifted(glb, frames: int = 3) -> np.ndarray:
    """Return the vertices, moved by 0.1 more along z at every frame."""
    rest = glb.model.vertices
    return np.stack([rest + np.float32([0, 0, 0.1 * frame]) for frame in range(frames)]).astype(np.float32)


def test_transforms_of_the_nodes_are_applied():
    model = read_foreign_glb(box_glb(), MOST).model
    turned = np.stack([CORNERS[:, 2], CORNERS[:, 1] + 2, -CORNERS[:, 0]], 1)
    np.testing.assert_allclose(model.vertices, turned, atol=1e-6)


def test_colors_come_from_the_texture():
    model = read_foreign_glb(box_glb(), MOST).model
    colors, _ = model.sample(np.arange(12), np.full((12, 3), 1 / 3))
    left = model.parts[0].faces.max(1) < 4  # faces at x = -0.5
    np.testing.assert_allclose(colors[left], [[1, 0, 0]] * 2, atol=1e-5)


def test_agrees_with_trimesh():
    ours, theirs = (
        read_foreign_glb(box_glb(), MOST).model,
        trimesh.load_scene(_file(box_glb()), file_type="glb").to_mesh(),
    )
    np.testing.assert_allclose(ours.vertices[ours.faces].mean((0, 1)), theirs.triangles.mean((0, 1)), atol=1e-6)
    assert len(theirs.faces) == len(ours.faces)


def _file(content: bytes):
    import io

    return io.BytesIO(content)


def test_moving_file_keeps_everything_else():
    glb = read_foreign_glb(box_glb(), MOST)
    content, notes = write_moving_glb(glb, np.eye(4), shifted(glb), 10.0, {"by": "test"})
    before, after = GlbReader(box_glb()).tree, GlbReader(content).tree
    for name in ("materials", "textures", "samplers", "images"):
        assert [{**one, "bufferView": 0} for one in after[name]] == [{**one, "bufferView": 0} for one in before[name]]
    assert [node["name"] for node in after["nodes"]] == ["inner", "outer", "dg4d placement"]
    assert after["asset"]["extras"] == {"author": "somebody", "by": "test"}
    old, new = before["meshes"][0]["primitives"][0], after["meshes"][0]["primitives"][0]
    assert (new["attributes"], new["indices"], new["material"]) == (old["attributes"], old["indices"], old["material"])
    assert [one["name"] for one in after["animations"]] == ["dg4d motion"]
    assert any("animations" in note for note in notes)


def played(content: bytes, frame: int) -> np.ndarray:
    """Return the vertices of all meshes in the world, at a frame, as a player computes them."""
    reader = GlbReader(content)

    def pose(tree):
        animation = tree["animations"][0]
        for channel in animation["channels"]:
            sampler, target = animation["samplers"][channel["sampler"]], channel["target"]
            values = read_accessor(reader, sampler["output"])
            keys = tree["accessors"][sampler["input"]]["count"]
            node = tree["nodes"][target["node"]]
            holder = tree["meshes"][node["mesh"]] if target["path"] == "weights" else node
            holder[target["path"]] = values.reshape(keys, -1)[frame].tolist()

    return read_foreign_glb(edited(content, pose), MOST).model.vertices


@pytest.mark.parametrize("make", [box_glb, skinned_glb])
def test_morph_targets_lead_to_the_given_vertices(make):
    glb = read_foreign_glb(make(), MOST)
    placement = np.diag([0.5, 0.5, 0.5, 1.0])
    placement[:3, 3] = (0.1, -0.2, 0.3)
    rest = glb.model.placed(placement).vertices
    moved = np.stack([rest, rest + np.float32([0, 0.25, 0]), rest * np.float32([1, 1, 2])])
    content, _ = write_moving_glb(glb, placement, moved, 10.0, {})
    for frame in range(3):
        np.testing.assert_allclose(played(content, frame), moved[frame], atol=1e-5)


@pytest.mark.parametrize("make", [box_glb, skinned_glb])
def test_a_model_in_motion_is_placed_and_slowed_down(make):
    glb = read_foreign_glb(make(), MOST)
    fitted = np.diag([0.5, 0.5, 0.5, 1.0])
    fitted[:3, 3] = (0.1, -0.2, 0.3)
    moved = glb.model.placed(fitted).vertices + np.float32([[[0, 0, 0]], [[0, 0.25, 0]]])
    content, _ = write_moving_glb(glb, fitted, moved, 10.0, {})
    placed = place_moving_glb(content, Placement(2.0, (0.0, 1.0, -3.0)), 1.5)
    for frame in range(2):
        np.testing.assert_allclose(played(placed, frame), 2 * moved[frame] + np.float32([0, 1, -3]), atol=1e-5)
    reader = GlbReader(placed)
    for sampler in reader.tree["animations"][0]["samplers"]:
        times = read_accessor(reader, sampler["input"]).ravel()
        np.testing.assert_allclose(times, [0, 0.15, 0.3], atol=1e-6)
        assert reader.tree["accessors"][sampler["input"]]["max"] == [times[-1]]


def raised_glb() -> bytes:
    """Return a box whose upper half a morph target lifts by 0.5 at its default weight, and whose normals it turns."""
    document = GltfDocument({})
    lift = np.where(CORNERS[:, 1:2] > 0, np.float32([0, 1, 0]), np.float32(0))
    along_x, along_y = (np.tile(np.eye(3, dtype="<f4")[axis], (8, 1)) for axis in (0, 1))
    attributes, target = (
        {name: document.add_accessor(name, rows, VERTEX_DATA) for name, rows in given.items()}
        for given in ({"POSITION": CORNERS, "NORMAL": along_x}, {"POSITION": lift, "NORMAL": 2 * along_y})
    )
    indices = document.add_accessor("triangles", BOX.ravel().astype("<u2"), INDEX_DATA)
    primitive = {"attributes": attributes, "indices": indices, "targets": [target]}
    mesh = document.add("meshes", name="box", primitives=[primitive], weights=[0.5])
    node = document.add("nodes", name="box", mesh=mesh)
    document.tree["scene"] = document.add("scenes", nodes=[node])
    return document.to_bytes()


def test_morph_targets_of_the_model_stay_at_their_default():
    glb = read_foreign_glb(raised_glb(), MOST)
    assert np.ptp(glb.model.vertices[:, 1]) == 1.5
    moved = shifted(glb)
    content, _ = write_moving_glb(glb, np.eye(4), moved, 10.0, {})
    np.testing.assert_allclose(played(content, 2), moved[2], atol=1e-6)
    reader = GlbReader(content)
    (primitive,) = reader.tree["meshes"][0]["primitives"]
    normals = read_accessor(reader, primitive["attributes"]["NORMAL"])
    np.testing.assert_allclose(normals, np.tile([0.5**0.5, 0.5**0.5, 0], (8, 1)), atol=1e-6)
    np.testing.assert_array_equal(read_accessor(reader, primitive["attributes"]["POSITION"]), glb.model.vertices)


MIRROR = np.float32([-1, 1, 1])


def mirrored(content: bytes, root: int) -> bytes:
    return edited(content, lambda tree: tree["nodes"][root].update(scale=MIRROR.tolist()))


@pytest.mark.parametrize(("make", "root"), [(box_glb, 1), (skinned_glb, 0)], ids=["box", "skin"])
def test_mirrored_models_keep_their_outside(make, root):
    plain, other = (read_foreign_glb(content, MOST).model for content in (make(), mirrored(make(), root)))
    np.testing.assert_allclose(other.vertices, plain.vertices * MIRROR, atol=1e-6)
    normals, mirrored_normals = (
        np.cross(b - a, c - a) for a, b, c in (model.vertices[model.faces].swapaxes(0, 1) for model in (plain, other))
    )
    np.testing.assert_allclose(mirrored_normals, normals * MIRROR, atol=1e-6)


def test_normals_of_mirrored_models_move_as_those_of_others():
    turns = []
    for content, mirror in ((raised_glb(), 1), (mirrored(raised_glb(), 0), MIRROR)):
        glb = read_foreign_glb(content, MOST)
        bent = (glb.model.vertices * mirror + np.float32([1, 0, 0]) * glb.model.vertices[:, 1:2] ** 2) * mirror
        written, _ = write_moving_glb(glb, np.eye(4), np.stack([glb.model.vertices, bent]), 10.0, {})
        reader = GlbReader(written)
        (primitive,) = reader.tree["meshes"][0]["primitives"]
        assert primitive["indices"] == 4
        turns.append(read_accessor(reader, primitive["targets"][1]["NORMAL"]))
    assert np.abs(turns[0]).max() > 0.1
    np.testing.assert_allclose(turns[1], turns[0], atol=1e-5)


def test_meshes_that_a_scale_of_0_hides_are_no_part_of_the_model_and_stay_in_the_file():
    def edit(tree):
        tree["meshes"].append(tree["meshes"][0])
        tree["nodes"] += [{"mesh": 1}, {"scale": [0.0, 0.0, 0.0], "children": [2]}]
        tree["scenes"][0]["nodes"].append(3)

    glb = read_foreign_glb(edited(box_glb(), edit), max_faces=12)
    assert len(glb.model.faces) == 12
    tree = GlbReader(write_moving_glb(glb, np.eye(4), shifted(glb), 10.0, {})[0]).tree
    assert tree["meshes"][tree["nodes"][2]["mesh"]] == GlbReader(box_glb()).tree["meshes"][0]
    assert tree["nodes"][3]["scale"] == [0, 0, 0]
    skinned = edited(skinned_glb(), lambda tree: tree["nodes"][2].update(scale=[0.0, 0.0, 0.0]))
    assert len(read_foreign_glb(skinned, MOST).model.faces) == 16  # its own scale has no effect


def hang_a_node_on_the_mesh(tree) -> None:
    tree["nodes"][2]["children"] = [3]
    tree["nodes"].append({})


def make_the_mesh_a_joint(tree) -> None:
    tree["skins"][0]["joints"].append(2)


def add_triangles_without_weights(tree) -> None:
    (primitive,) = tree["meshes"][0]["primitives"]
    attributes = {"POSITION": primitive["attributes"]["POSITION"]}
    tree["meshes"][0]["primitives"].append({**primitive, "attributes": attributes})


@pytest.mark.parametrize(
    ("edit", "apart"),
    [
        (lambda tree: None, True),
        (hang_a_node_on_the_mesh, False),
        (make_the_mesh_a_joint, False),
        (add_triangles_without_weights, False),
    ],
    ids=["skinned alone", "with a child", "a joint", "partly skinned"],
)
def test_skinned_meshes_are_roots_unless_something_else_needs_their_place(edit, apart):
    glb = read_foreign_glb(edited(skinned_glb(), edit), MOST)
    placement = np.diag([0.5, 0.5, 0.5, 1.0])
    placement[:3, 3] = (0.1, -0.2, 0.3)
    moved = shifted(glb) * np.float32(0.5) + np.float32([0.1, -0.2, 0.3])
    content, _ = write_moving_glb(glb, placement, moved, 10.0, {})
    tree = GlbReader(content).tree
    root, *others = tree["scenes"][0]["nodes"]
    assert tree["nodes"][root]["name"] == "dg4d placement" and others == ([2] if apart else [])
    np.testing.assert_allclose(played(content, 2), moved[2], atol=1e-5)


def test_vertices_of_a_skin_follow_the_joints_at_rest():
    model = read_foreign_glb(skinned_glb(), MOST).model
    tip, foot = model.vertices[8], model.vertices[0]
    np.testing.assert_allclose([tip, foot], [(1, 1, 0), (0, 0, 0)], atol=1e-6)  # the node's own transform is ignored


def bent(angle: float) -> np.ndarray:
    """Return the strip with its upper joint turned about z, as a player skins it."""
    turn = [0, 0, np.sin(angle / 2), np.cos(angle / 2)]
    posed = edited(skinned_glb(bound=True), lambda tree: tree["nodes"][1].update(rotation=turn))
    return read_foreign_glb(posed, MOST).model.vertices


def targets_of(content: bytes) -> np.ndarray:
    """Return the displacements of the first primitive's morph targets."""
    reader = GlbReader(content)
    primitive = reader.tree["meshes"][0]["primitives"][0]
    return np.stack([read_accessor(reader, target["POSITION"]) for target in primitive["targets"]])


def test_the_skeleton_moves_as_far_as_it_can():
    glb = read_foreign_glb(skinned_glb(bound=True), MOST)
    moved = np.stack([bent(angle) for angle in (0.0, 0.5, 1.5)])
    content, notes = write_moving_glb(glb, np.eye(4), moved, 10.0, {})
    tree = GlbReader(content).tree
    assert tree["skins"] == GlbReader(skinned_glb(bound=True)).tree["skins"]
    assert any("is animated by its skeleton" in note for note in notes)
    assert np.abs(targets_of(content)).max() < 1e-3  # nothing is left to morph targets
    channels = tree["animations"][0]["channels"]
    assert {(one["target"]["node"], one["target"]["path"]) for one in channels} >= {(1, "rotation"), (2, "weights")}
    for frame in range(3):
        np.testing.assert_allclose(played(content, frame), moved[frame], atol=1e-5)


def test_joints_given_as_matrices_and_meshes_that_hang_on_them_move():
    def edit(tree):
        tree["nodes"][1] = {
            "name": "tip",
            "matrix": [2.0, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 1, 0, 0, 1],
            "children": [3],
        }
        mesh = {"primitives": [{**tree["meshes"][0]["primitives"][0]}]}
        mesh["primitives"][0]["attributes"] = {"POSITION": mesh["primitives"][0]["attributes"]["POSITION"]}
        tree["meshes"].append(mesh)
        tree["nodes"].append({"name": "held", "mesh": 1, "translation": [0.0, 0.5, 0.0]})

    glb = read_foreign_glb(edited(skinned_glb(), edit), MOST)
    rest = glb.model.vertices
    c, s = np.cos(0.8), np.sin(0.8)
    turned = rest @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + np.array([0.1, 0, 0.2])
    moved = np.stack([rest, turned]).astype(np.float32)
    content, notes = write_moving_glb(glb, np.eye(4), moved, 10.0, {})
    assert any("is animated by its skeleton" in note for note in notes)
    for frame in range(2):
        np.testing.assert_allclose(played(content, frame), moved[frame], atol=1e-5)
    tree = GlbReader(content).tree
    held = next(node for node in tree["nodes"] if node.get("name") == "held")
    primitive = tree["meshes"][held["mesh"]]["primitives"][0]
    displacement = read_accessor(GlbReader(content), primitive["targets"][1]["POSITION"])
    assert np.abs(displacement).max() < 1e-3  # it moves with the joint that it hangs on


def hang_joints(tree, count: int) -> None:
    """Hang joints that move no vertex on the upper one."""
    numbers = list(range(len(tree["nodes"]), len(tree["nodes"]) + count))
    tree["nodes"][1]["children"] = numbers
    tree["skins"][0]["joints"] += numbers
    tree["nodes"] += [{} for _ in numbers]


def hang_a_joint_on_a_flat_node(tree) -> None:
    tree["nodes"][1]["children"] = [3]
    tree["nodes"] += [{"scale": [0.0, 1.0, 1.0], "children": [4]}, {}]
    tree["skins"][0]["joints"].append(4)


@pytest.mark.parametrize(
    ("edit", "reason"),
    [
        (lambda t: t["nodes"][0].update(scale=[1.0, 3.0, 1.0]), "unevenly"),
        (lambda t: t["nodes"][2].pop("skin"), "is not animated (it moves no vertex)"),
        (lambda t: hang_joints(t, 255), "257 joints; at most 256"),
        (hang_a_joint_on_a_flat_node, "singular scale"),
    ],
    ids=["uneven", "unused", "too many joints", "flat"],
)
def test_a_skeleton_that_cannot_move_is_kept_at_rest(edit, reason):
    glb = read_foreign_glb(edited(skinned_glb(), edit), MOST)
    rest = glb.model.vertices
    above = rest[:, 1:2] > 0.5
    moved = np.stack([rest, np.where(above, rest[:, [1, 0, 2]] * np.float32([-1, 1, 1]), rest)]).astype(np.float32)
    content, notes = write_moving_glb(glb, np.eye(4), moved, 10.0, {})
    assert any("skeleton" in note and reason in note for note in notes)
    assert [one["target"]["path"] for one in GlbReader(content).tree["animations"][0]["channels"]] == ["weights"]
    np.testing.assert_allclose(played(content, 1), moved[1], atol=1e-5)


def test_small_skins_are_read_and_flat_ones_refused():
    small = edited(skinned_glb(), lambda tree: tree["nodes"][0].update(scale=[1e-5] * 3))  # as of quantized meshes
    full = read_foreign_glb(skinned_glb(), MOST).model.vertices
    np.testing.assert_allclose(1e5 * read_foreign_glb(small, MOST).model.vertices, full, atol=1e-5)
    with pytest.raises(BadInput, match="collapses the mesh"):
        read_foreign_glb(edited(skinned_glb(), lambda tree: tree["nodes"][0].update(scale=[1, 0, 1])), MOST)


def test_long_motions_have_fewer_keys_and_last_as_long():
    glb = read_foreign_glb(box_glb(), MOST)
    content, notes = write_moving_glb(glb, np.eye(4), shifted(glb, 129), 10.0, {})
    reader = GlbReader(content)
    (mesh,) = reader.tree["meshes"]
    assert len(mesh["primitives"][0]["targets"]) == len(mesh["extras"]["targetNames"]) == 65
    assert mesh["extras"]["targetNames"][1] == "frame_002"
    times = read_accessor(reader, reader.tree["animations"][0]["samplers"][0]["input"]).ravel()
    np.testing.assert_allclose(times, [*np.arange(0, 129, 2) / 10, 12.9], atol=1e-5)
    assert any("a key every 2 frames" in note for note in notes)


def test_materials_of_older_exporters_have_their_color():
    def older(tree):
        tree["materials"][0] = {
            "extensions": {
                "KHR_materials_pbrSpecularGlossiness": {"diffuseTexture": {"index": 0}, "glossinessFactor": 1}
            }
        }

    ours, theirs = (read_foreign_glb(content, MOST).model for content in (edited(box_glb(), older), box_glb()))
    ids, middle = np.arange(12), np.full((12, 3), 1 / 3)
    np.testing.assert_array_equal(ours.sample(ids, middle)[0], theirs.sample(ids, middle)[0])


def test_a_skeleton_is_read_with_its_weights():
    glb = read_foreign_glb(skinned_glb(bound=True), MOST)
    skeleton = read_skeleton(glb)
    np.testing.assert_allclose(skeleton.places, [(0, 0, 0), (0, 0.5, 0)])
    np.testing.assert_array_equal(skeleton.parents, [-1, 0])
    heights = np.tile(np.linspace(0, 1, 9), 2)
    np.testing.assert_allclose(skeleton.weights.toarray(), np.stack([1 - heights, heights], 1), atol=1e-6)


def test_skeletons_that_move_little_or_nothing_are_not_used():
    assert read_skeleton(read_foreign_glb(box_glb(), MOST)) is None

    def with_a_rigid_copy(tree):
        copies = [{**tree["nodes"][2], "translation": [k, 0, 0]} for k in range(5)]
        tree["nodes"] += [{key: value for key, value in copy.items() if key != "skin"} for copy in copies]
        tree["scenes"][0]["nodes"] += list(range(3, 8))

    assert read_skeleton(read_foreign_glb(edited(skinned_glb(), with_a_rigid_copy), MOST)) is None


def test_meshes_that_hang_on_a_joint_have_its_whole_weight():
    def with_a_hat(tree):
        hat = {key: value for key, value in tree["nodes"][2].items() if key not in ("skin", "translation")}
        tree["nodes"].append(hat)
        tree["nodes"][1]["children"] = [3]

    weights = read_skeleton(read_foreign_glb(edited(skinned_glb(), with_a_hat), MOST)).weights.toarray()
    np.testing.assert_array_equal(weights[18:], [(0, 1)] * 18)


BROKEN = {
    "nan": (lambda t: t["nodes"][0].update(scale=[float("nan")] * 3), "not finite"),
    "no mesh": (lambda t: t["nodes"][0].pop("mesh"), "no triangles"),
    "missing texture": (lambda t: t["images"].__setitem__(0, {"uri": "paint.png"}), "texture .* missing"),
    "circle": (lambda t: t["nodes"][0].update(children=[1]), "circle"),
    "ktx2": (lambda t: t.update(extensionsRequired=["KHR_texture_basisu"]), "KTX2"),
    "instances": (lambda t: t.update(extensionsRequired=["EXT_mesh_gpu_instancing"]), "without instancing"),
    "far index": (lambda t: t["accessors"][2].update(byteOffset=10**9), "broken"),
    "huge count": (lambda t: t["accessors"][0].update(count=10**12), "broken"),
    "negative offset": (lambda t: t["accessors"][0].update(byteOffset=-64), "broken"),
    "wrong type": (lambda t: t.update(nodes={"a": 1}), "broken"),
    "old version": (lambda t: t["asset"].update(version="1.0"), "glTF 2.0"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_files_get_a_sentence(case):
    edit, sentence = BROKEN[case]
    with pytest.raises(BadInput, match=sentence):
        read_foreign_glb(edited(box_glb(), edit), MOST)


@pytest.mark.parametrize(("mode", "faces"), [(4, 12), (5, 34), (6, 34)], ids=["triangles", "strip", "fan"])
def test_too_many_triangles_are_refused_with_the_setting(mode: int, faces: int):
    content = edited(box_glb(), lambda tree: tree["meshes"][0]["primitives"][0].update(mode=mode))
    assert len(read_foreign_glb(content, faces).model.faces) == faces
    with pytest.raises(BadInput, match=rf"{faces} triangles; asset\.max_faces allows {faces - 1}.*max_faces={faces}"):
        read_foreign_glb(content, faces - 1)
