"""Models as other programs write them: a textured box under nested nodes, and a skinned strip."""

import io

import numpy as np
from PIL import Image

from dg4d_lib.assets.formats.gltf import INDEX_DATA, VERTEX_DATA, GltfDocument

CORNERS = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)], np.float32)
BOX = np.array(
    [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4),
     (1, 5, 7), (1, 7, 3)]
)  # fmt: skip
RED_AND_BLUE = np.array([[[255, 0, 0, 255], [0, 0, 255, 255]]], np.uint8).repeat(2, 0)


def png(pixels: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    return buffer.getvalue()


def box_glb(**changes: object) -> bytes:
    """Return a box, half red and half blue by its x, 2 up and turned by 90 degrees about y; with an animation."""
    document = GltfDocument({"author": "somebody"})
    document.use_extension("KHR_materials_unlit")
    uvs = np.stack([0.5 + 0.5 * CORNERS[:, 0], 0.5 + CORNERS[:, 1]], 1).astype(np.float32)
    attributes = {
        "POSITION": document.add_accessor("positions", CORNERS, VERTEX_DATA),
        "TEXCOORD_0": document.add_accessor("uvs", uvs, VERTEX_DATA),
    }
    indices = document.add_accessor("triangles", BOX.ravel().astype("<u2"), INDEX_DATA)
    image = document.add(
        "images", name="paint", mimeType="image/png", bufferView=document.add_view("p", png(RED_AND_BLUE))
    )
    document.add("samplers", magFilter=9728)
    document.add("textures", name="paint", source=image, sampler=0)
    shading = {"baseColorTexture": {"index": 0}, "roughnessFactor": 0.3}
    material = document.add("materials", name="lacquer", pbrMetallicRoughness=shading, extras={"kept": True})
    primitive = {"attributes": attributes, "indices": indices, "material": material}
    mesh = document.add("meshes", name="box", primitives=[primitive], **changes)
    inner = document.add("nodes", name="inner", mesh=mesh, rotation=[0.0, 0.7071067811865476, 0.0, 0.7071067811865476])
    outer = document.add("nodes", name="outer", children=[inner], translation=[0.0, 2.0, 0.0])
    times = document.add_accessor("t", np.array([0.0, 1.0], np.float32))
    moves = document.add_accessor("m", np.zeros((2, 3), np.float32))
    sampler = {"input": times, "output": moves, "interpolation": "LINEAR"}
    channel = {"sampler": 0, "target": {"node": outer, "path": "translation"}}
    document.add("animations", name="old", samplers=[sampler], channels=[channel])
    document.tree["scene"] = document.add("scenes", name="all", nodes=[outer])
    return document.to_bytes()


def skinned_glb(bound: bool = False) -> bytes:
    """Return a strip of 8 quads along y on two joints.

    The upper joint is moved by 1 along x at rest, or with `bound` in the middle of the strip, where it is bound.
    """
    document = GltfDocument({})
    heights = np.linspace(0, 1, 9, dtype=np.float32)
    vertices = np.concatenate([np.stack([np.full(9, x), heights, np.zeros(9)], 1) for x in (0.0, 0.3)]).astype("<f4")
    faces = np.concatenate([[(k, k + 9, k + 1), (k + 1, k + 9, k + 10)] for k in range(8)])
    upper = np.tile(heights, 2)
    weights = np.stack([1 - upper, upper, 0 * upper, 0 * upper], 1).astype("<f4")
    joints = np.tile(np.array([0, 1, 0, 0], np.uint8), (18, 1))
    attributes = {
        "POSITION": document.add_accessor("positions", vertices, VERTEX_DATA),
        "JOINTS_0": document.add_accessor("joints", joints, VERTEX_DATA),
        "WEIGHTS_0": document.add_accessor("weights", weights, VERTEX_DATA),
    }
    indices = document.add_accessor("triangles", faces.ravel().astype("<u2"), INDEX_DATA)
    mesh = document.add("meshes", name="strip", primitives=[{"attributes": attributes, "indices": indices}])
    root = document.add("nodes", name="root")
    tip = document.add("nodes", name="tip", translation=[0.0, 0.5, 0.0] if bound else [1.0, 0.0, 0.0])
    document.tree["nodes"][root]["children"] = [tip]
    skin = document.add("skins", name="bones", joints=[root, tip])
    if bound:
        binding = np.tile(np.eye(4, dtype="<f4"), (2, 1, 1))
        binding[1, 3, 1] = -0.5  # column by column
        view = document.add_view("binding", binding.tobytes())
        matrices = document.add("accessors", bufferView=view, componentType=5126, count=2, type="MAT4")
        document.tree["skins"][skin]["inverseBindMatrices"] = matrices
    node = document.add("nodes", name="strip", mesh=mesh, skin=skin, translation=[9.0, 9.0, 9.0])
    document.tree["scene"] = document.add("scenes", nodes=[root, node])
    return document.to_bytes()
