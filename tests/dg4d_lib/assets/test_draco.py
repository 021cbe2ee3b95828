"""Models that are compressed with Draco."""

import json
import struct

import DracoPy
import numpy as np
import pytest
from foreign_models import BOX, CORNERS, RED_AND_BLUE, box_glb, png

from dg4d_lib.assets.formats import draco
from dg4d_lib.assets.formats.foreign_glb import read_foreign_glb
from dg4d_lib.assets.formats.foreign_motion import write_moving_glb
from dg4d_lib.assets.formats.gltf import GlbReader, GltfDocument
from dg4d_lib.errors import BadInput

STEP = 1 / 2**14  # of the compressed coordinates
UVS = np.stack([0.5 + 0.5 * CORNERS[:, 0], 0.5 + CORNERS[:, 1]], 1).astype(np.float32)


def compressed_box(content: bytes | None = None, twice: bool = False) -> bytes:
    """Return the box of `box_glb` at rest, compressed; with `twice`, as two primitives that share their bytes."""
    document = GltfDocument({})
    packed = DracoPy.encode(
        CORNERS, BOX.astype(np.uint32), quantization_bits=14, tex_coord=UVS.astype(np.float64), preserve_order=True
    )
    view = document.add_view("packed", packed if content is None else content)
    bounds = {"min": CORNERS.min(0).tolist(), "max": CORNERS.max(0).tolist()}
    positions = document.add("accessors", componentType=5126, count=8, type="VEC3", **bounds)
    uvs = document.add("accessors", componentType=5126, count=8, type="VEC2")
    indices = document.add("accessors", componentType=5123, count=36, type="SCALAR")
    image = document.add("images", mimeType="image/png", bufferView=document.add_view("p", png(RED_AND_BLUE)))
    document.add("textures", source=image)
    material = document.add("materials", pbrMetallicRoughness={"baseColorTexture": {"index": 0}})
    primitive = {
        "attributes": {"POSITION": positions, "TEXCOORD_0": uvs},
        "indices": indices,
        "material": material,
        "extensions": {draco.EXTENSION: {"bufferView": view, "attributes": {"POSITION": 1, "TEXCOORD_0": 0}}},
    }
    mesh = document.add("meshes", name="box", primitives=[primitive, json.loads(json.dumps(primitive))][: 1 + twice])
    document.tree["scene"] = document.add("scenes", nodes=[document.add("nodes", mesh=mesh)])
    document.use_extension(draco.EXTENSION, required=True)
    return document.to_bytes()


def test_a_compressed_model_is_the_model() -> None:
    model = read_foreign_glb(compressed_box(), 100).model
    np.testing.assert_allclose(model.vertices[model.faces], CORNERS[BOX], atol=STEP)
    assert model.parts[0].uvs is not None
    np.testing.assert_allclose(model.parts[0].uvs[model.faces], UVS[BOX], atol=1e-3)
    plain = read_foreign_glb(box_glb(), 100).model
    ids, middle = np.arange(12), np.full((12, 3), 1 / 3)
    np.testing.assert_allclose(model.sample(ids, middle)[0], plain.sample(ids, middle)[0], atol=0.02)


def test_what_primitives_share_stays_shared() -> None:
    assert len(read_foreign_glb(compressed_box(twice=True), 100).model.faces) == 24


def test_the_moving_model_is_not_compressed_any_more() -> None:
    glb = read_foreign_glb(compressed_box(), 100)
    moved = np.stack([glb.model.vertices, glb.model.vertices + np.float32([0, 1, 0])])
    content, _ = write_moving_glb(glb, np.eye(4), moved, 10.0, {})
    tree = GlbReader(content).tree
    assert draco.EXTENSION not in json.dumps(tree)
    assert all(view["byteLength"] < 400 for view in tree["bufferViews"])  # nothing of the compressed bytes stays
    accessor = tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    np.testing.assert_array_equal(accessor["max"], read_foreign_glb(content, 100).pieces[0].local.max(0))


def test_too_many_triangles_are_refused_by_what_is_in_the_bytes() -> None:
    with pytest.raises(BadInput, match=r"12 triangles; asset\.max_faces allows 11"):
        read_foreign_glb(compressed_box(), 11)


POINTS = DracoPy.encode(CORNERS)


@pytest.mark.parametrize("content", [b"nothing", POINTS, struct.pack("<5sBBBBH", b"DRACO", 2, 2, 1, 1, 0)])
def test_broken_bytes_get_a_sentence(content: bytes) -> None:
    with pytest.raises(BadInput, match="Draco and broken"):
        read_foreign_glb(compressed_box(content), 100)
