"""Materials, visibility and places of GLBs of other programs, on a square of the side 1."""

from typing import Any

import numpy as np
import pytest
from foreign_models import png

from dg4d_lib.assets.formats.foreign_glb import ForeignGlb, read_foreign_glb
from dg4d_lib.assets.formats.foreign_motion import write_moving_glb
from dg4d_lib.assets.formats.gltf import INDEX_DATA, VERTEX_DATA, GlbReader, GltfDocument, read_accessor
from dg4d_lib.assets.formats.model_glb import write_model_glb
from dg4d_lib.errors import BadInput
from dg4d_lib.mesh.models.model import Model, Wrap

CORNERS = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], "<f4")
LEFT_RED = np.zeros((16, 16, 4), np.uint8)
LEFT_RED[..., 3], LEFT_RED[:, :8, 0], LEFT_RED[:, 8:, 2] = 255, 255, 255  # and right blue
NEAR_LEFT = np.array([[0.6, 0.2, 0.2]])  # in the first triangle, at x = 0.4
RED, BLUE = (1, 0, 0), (0, 0, 1)
PAINT = {"baseColorTexture": {"index": 0}}


def square(uvs: float = 0.0, sampler: dict[str, int] | None = None, **material: Any) -> GltfDocument:
    """Return a square whose texture coordinates start at `uvs`."""
    document = GltfDocument({})
    places = np.array([(0, 1), (1, 1), (1, 0), (0, 0)], "<f4") + np.float32([uvs, 0])
    attributes = {
        "POSITION": document.add_accessor("positions", CORNERS, VERTEX_DATA),
        "TEXCOORD_0": document.add_accessor("uvs", places, VERTEX_DATA),
    }
    indices = document.add_accessor("triangles", np.array([0, 1, 2, 0, 2, 3], "<u2"), INDEX_DATA)
    document.add("images", mimeType="image/png", bufferView=document.add_view("paint", png(LEFT_RED)))
    number = None if sampler is None else document.add("samplers", **sampler)
    document.add("textures", source=0, sampler=number)
    painted = document.add("materials", **{"pbrMetallicRoughness": PAINT, **material})
    primitive = {"attributes": attributes, "indices": indices, "material": painted}
    document.add("nodes", mesh=document.add("meshes", primitives=[primitive]))
    document.tree["scene"] = document.add("scenes", nodes=[0])
    return document


def read(document: GltfDocument) -> ForeignGlb:
    return read_foreign_glb(document.to_bytes(), 100)


def color(model: Model) -> np.ndarray:
    return model.sample(np.array([0]), NEAR_LEFT)[0][0]


@pytest.mark.parametrize(
    ("mode", "expected"), [(Wrap.REPEAT, RED), (Wrap.MIRROR, BLUE), (Wrap.CLAMP, BLUE), (7, RED), (None, RED)]
)
def test_textures_go_on_by_the_wrap_mode_of_their_sampler(mode: int | None, expected: tuple[int, ...]) -> None:
    sampler = {"magFilter": 9728} if mode is None else {"wrapS": int(mode)}
    model = read(square(1.0, sampler)).model
    again = read_foreign_glb(write_model_glb(model), 100).model
    for one in (model, again):
        np.testing.assert_allclose(color(one), expected, atol=1e-5)
        assert one.parts[0].wrap == model.parts[0].wrap and one.parts[0].wrap[1] is Wrap.REPEAT


@pytest.mark.parametrize("number", [7, -1, "no number"])
def test_a_sampler_that_does_not_exist_repeats(number: object) -> None:
    document = square(1.0, {"wrapS": int(Wrap.CLAMP)})
    document.tree["textures"][0]["sampler"] = number
    np.testing.assert_allclose(color(read(document).model), RED, atol=1e-5)


def test_textures_of_one_picture_and_two_wrap_modes_keep_both() -> None:
    repeated, mirrored = (read(square(1.0, {"wrapS": mode})).model.parts[0] for mode in (10497, 33648))
    parts = (repeated, type(mirrored)(**{**vars(mirrored), "texture": repeated.texture}))
    content = write_model_glb(Model((*parts, repeated)))
    assert [len(GlbReader(content).tree[name]) for name in ("images", "samplers", "textures")] == [1, 1, 2]
    found = read_foreign_glb(content, 100).model.parts
    assert [part.wrap[0] for part in found] == [Wrap.REPEAT, Wrap.MIRROR, Wrap.REPEAT]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_texture_coordinates_that_are_no_numbers_give_colors_of_the_texture(value: float) -> None:
    content = square(0.25).to_bytes().replace(np.float32(1.25).tobytes(), np.float32(value).tobytes())
    found = color(read_foreign_glb(content, 100).model)
    assert np.isfinite(found).all() and found.max() <= 1


BLACK = {"baseColorFactor": [0, 0, 0, 1]}
GREEN_LIGHT = {
    "emissiveFactor": [0, 0.2, 0],
    "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 9}},
}


@pytest.mark.parametrize(
    ("material", "expected"),
    [
        ({"pbrMetallicRoughness": BLACK, "emissiveFactor": [1, 1, 1], "emissiveTexture": {"index": 0}}, RED),
        ({"pbrMetallicRoughness": BLACK, **GREEN_LIGHT}, (0, 1, 0)),
        ({"pbrMetallicRoughness": BLACK}, (0, 0, 0)),
        ({"pbrMetallicRoughness": PAINT, **GREEN_LIGHT}, RED),
    ],
    ids=["texture", "strong", "dark", "not black"],
)
def test_black_materials_have_the_color_of_their_light(material: dict[str, Any], expected: tuple[int, ...]) -> None:
    np.testing.assert_allclose(color(read(square(**material)).model), expected, atol=1e-5)


def faded(alpha: float, mode: str, **more: Any) -> GltfDocument:
    return square(pbrMetallicRoughness={"baseColorFactor": [1, 1, 1, alpha]}, alphaMode=mode, **more)


def test_materials_that_are_transparent_everywhere_are_no_part_of_the_model() -> None:
    for shown in (faded(0, "OPAQUE"), faded(0.5, "MASK"), faded(0.2, "MASK", alphaCutoff=0.1), faded(0.1, "BLEND")):
        assert len(read(shown).model.faces) == 2
    for hidden in (faded(0.4, "MASK"), faded(0.7, "MASK", alphaCutoff=0.8), faded(0, "BLEND")):
        with pytest.raises(BadInput, match="no triangles"):
            read(hidden)


def test_nodes_that_are_not_visible_hide_all_below_them() -> None:
    document = square()
    document.use_extension("KHR_node_visibility")
    document.tree["nodes"] += [
        {"mesh": 0, "translation": [3, 0, 0]},
        {"children": [1], "extensions": {"KHR_node_visibility": {"visible": False}}},
        {"mesh": 0, "translation": [0, 3, 0], "extensions": {"KHR_node_visibility": {"visible": True}}},
    ]
    document.tree["scenes"][0]["nodes"] = [0, 2, 3]
    assert [piece.node for piece in read(document).pieces] == [0, 3]


def test_scenes_that_share_a_root_are_dropped_from_the_model_in_motion() -> None:
    document = square()
    document.add("nodes", mesh=0, translation=[5, 0, 0])
    document.add("scenes", nodes=[0, 1])
    glb = read(document)
    content, notes = write_moving_glb(glb, np.eye(4), np.stack([glb.model.vertices] * 2), 10.0, {})
    tree = GlbReader(content).tree
    children = {child for node in tree["nodes"] for child in node.get("children", ())}
    assert tree["scene"] == 0 and not children & {root for scene in tree["scenes"] for root in scene["nodes"]}
    assert any("scenes" in note for note in notes)


@pytest.mark.parametrize("form", ["translation", "matrix"])
def test_models_far_from_the_origin_keep_their_shape(form: str) -> None:
    document = square()
    place = [450123.3, 5412345.3, -7.0]
    document.tree["nodes"][0] |= (
        {"translation": place} if form == "translation" else {"matrix": [*np.eye(4).ravel()[:12].tolist(), *place, 1.0]}
    )
    document.tree["nodes"].append({"mesh": 0, "translation": [450124.4, 5412345.3, -7.0]})
    document.tree["scenes"][0]["nodes"] = [0, 1]
    glb = read(document)
    rest = glb.model.vertices
    expected = np.concatenate([CORNERS, CORNERS + np.float32([1.1, 0, 0])])
    np.testing.assert_allclose(rest - rest.mean(0), expected - expected.mean(0), atol=1e-5)
    assert np.abs(rest).max() < 2 and any("far from the origin" in note for note in glb.notes)
    moved = np.stack([rest, rest + np.float32([0, 0, 0.25])])
    content, _ = write_moving_glb(glb, np.eye(4), moved, 10.0, {})
    tree = GlbReader(content).tree
    assert read_foreign_glb(content, 100).notes == ()
    shifts = read_accessor(GlbReader(content), tree["meshes"][0]["primitives"][0]["targets"][1]["POSITION"])
    np.testing.assert_allclose(shifts, [(0, 0, 0.25)] * 4, atol=1e-6)


def test_models_near_the_origin_stay_where_they_are() -> None:
    document = square()
    document.tree["nodes"][0]["translation"] = [50.0, 0.0, 0.0]
    glb = read(document)
    np.testing.assert_array_equal(glb.model.vertices, CORNERS + np.float32([50, 0, 0]))
    assert glb.notes == ()
