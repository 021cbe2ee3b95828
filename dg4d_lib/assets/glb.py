"""Animated textured meshes as one file of core glTF 2.0, without extensions.

A tracked mesh becomes one mesh with a morph target per frame and weights that are one-hot at every frame and linear
between; meshes per frame become one node each, shown and hidden by its scale. Both animations are closed: a last key,
one frame after the last frame, shows the first frame again, so a player that loops has no jump and the animation lasts
as long as the video. The baked color is the base color of a rough dielectric. Normals are those of the mesh at rest.
"""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.assets.gltf import INDEX_DATA, VERTEX_DATA, Document, Parsed
from dg4d_lib.errors import BadInput
from dg4d_lib.mesh.textured import TexturedMesh

LINEAR, LINEAR_MIPMAP_LINEAR, CLAMP_TO_EDGE = 9729, 9987, 33071
PNG_LEVEL = 4  # of 9; twice as fast as the default 6, files a few percent larger
MAX_SHORT_INDEX = 65534  # 65535 restarts primitives on some devices and is forbidden
TRANSFORMS = {"matrix", "translation", "rotation", "scale"}
_FOREIGN = (KeyError, IndexError, TypeError, ValueError, ArithmeticError, OSError)  # what another form runs into


def write_glb(asset: Asset4D) -> bytes:
    """A GLB of a tracked mesh.

    Raises:
        BadInput: no triangles, no frames, an fps that is not positive, or numbers that are not finite.
    """
    frames = len(asset.offsets)
    if frames == 0:
        raise BadInput("an animated asset needs at least one frame of offsets; given none")
    _check(asset.mesh, asset.fps)
    offsets = _array(asset.offsets)
    if not np.isfinite(offsets).all():
        raise BadInput("the offsets of the mesh hold numbers that are not finite")
    document = Document(asset.extras)
    primitive = _add_primitive(document, asset.mesh, "subject")
    names = [f"frame_{i:03d}" for i in range(frames)]
    primitive["targets"] = [
        {"POSITION": document.add_accessor(name, target, VERTEX_DATA)}
        for name, target in zip(names, offsets, strict=True)
    ]
    weights = np.eye(frames, dtype="<f4")
    mesh = document.add(
        "meshes", name="subject", primitives=[primitive], weights=weights[0].tolist(), extras={"targetNames": names}
    )
    node = document.add("nodes", name="subject", mesh=mesh)
    sampler = {
        "input": document.add_accessor("times", _key_times(frames, asset.fps)),
        "output": document.add_accessor("weights", np.concatenate((weights, weights[:1])).ravel()),
        "interpolation": "LINEAR",
    }
    channel = {"sampler": 0, "target": {"node": node, "path": "weights"}}
    document.add("animations", name="motion", samplers=[sampler], channels=[channel])
    return _finish(document, [node])


def read_glb(content: bytes) -> Asset4D:
    """Read a GLB of one mesh whose morph targets are its frames, as `write_glb` makes it.

    Positions, texture coordinates and offsets come back exactly, the texture in steps of 1/255, fps to six digits.

    Raises:
        BadInput: it is broken or has another form; says what is missing.
    """
    parsed = Parsed(content)
    try:
        mesh, primitive = _read_primitive(parsed)
        targets = [parsed.accessor(target["POSITION"]) for target in primitive.get("targets", ())]
        if not targets or "animations" not in parsed.tree:
            raise BadInput("this GLB has no morph targets with an animation; only animated tracked meshes can be read")
        (sampler,) = parsed.tree["animations"][0]["samplers"]
        times = parsed.accessor(sampler["input"])[:, 0]
        if {len(target) for target in targets} != {len(mesh.vertices)}:
            raise BadInput("the morph targets of this GLB do not have as many rows as the mesh has vertices")
        weights = parsed.accessor(sampler["output"]).reshape(len(times), len(targets))
        if not np.array_equal(weights[: len(targets)], np.eye(len(targets))):
            raise BadInput("the animation of this GLB does not show one morph target per key; use one written by dg4d")
        fps = float(f"{1 / (times[1] - times[0]):.6g}")
        return Asset4D(mesh, torch.from_numpy(np.stack(targets)), fps, parsed.tree["asset"].get("extras", {}))
    except _FOREIGN as error:
        raise BadInput(f"this GLB has not the form of an animated tracked mesh: {error!r}") from error


def write_frames_glb(meshes: Sequence[TexturedMesh], fps: float, extras: dict[str, Any] | None = None) -> bytes:
    """A GLB of unrelated meshes, one per frame, each shown at its time (scale 1) and hidden else (scale 0).

    Raises:
        BadInput: no meshes, a mesh without triangles, an fps that is not positive, or numbers that are not finite.
    """
    if not meshes:
        raise BadInput("an animated asset needs at least one mesh; given none")
    for mesh in meshes:
        _check(mesh, fps)
    document = Document(extras or {})
    times = document.add_accessor("times", _key_times(len(meshes), fps))
    nodes, samplers, channels = [], [], []
    for i, mesh in enumerate(meshes):
        name = f"frame_{i:03d}"
        number = document.add("meshes", name=name, primitives=[_add_primitive(document, mesh, name)])
        nodes.append(document.add("nodes", name=name, mesh=number, scale=[float(i == 0)] * 3))
        shown = np.zeros((len(meshes) + 1, 3), "<f4")
        shown[i] = 1
        shown[-1] = shown[0]
        output = document.add_accessor(f"{name} shown", shown)
        samplers.append({"input": times, "output": output, "interpolation": "STEP"})
        channels.append({"sampler": i, "target": {"node": nodes[i], "path": "scale"}})
    document.add("animations", name="motion", samplers=samplers, channels=channels)
    return _finish(document, nodes)


def write_mesh_glb(mesh: TexturedMesh) -> bytes:
    """A GLB of one still mesh.

    Raises:
        BadInput: no triangles, or numbers that are not finite.
    """
    _check(mesh, 1.0)
    document = Document({})
    number = document.add("meshes", name="subject", primitives=[_add_primitive(document, mesh, "subject")])
    return _finish(document, [document.add("nodes", name="subject", mesh=number)])


def read_mesh_glb(content: bytes) -> TexturedMesh:
    """Read the one mesh of a GLB, as `write_mesh_glb` makes it; morph targets are left aside.

    Raises:
        BadInput: it is broken or has another form.
    """
    parsed = Parsed(content)
    try:
        return _read_primitive(parsed)[0]
    except _FOREIGN as error:
        raise BadInput(f"this GLB has not the form of one textured mesh: {error!r}") from error


def _check(mesh: TexturedMesh, fps: float) -> None:
    if len(mesh.faces) == 0:
        raise BadInput("a mesh without triangles cannot be written as GLB")
    if not fps > 0:
        raise BadInput(f"frames per second must be positive; given {fps}")
    if not all(values.isfinite().all() for values in (mesh.vertices, mesh.uvs, mesh.texture)):
        raise BadInput("the mesh holds numbers that are not finite")


def _array(values: Tensor) -> NDArray[Any]:
    return np.ascontiguousarray(values.detach().cpu().numpy().astype("<f4"))


def _key_times(frames: int, fps: float) -> NDArray[Any]:
    """Seconds of every frame, and of the closing key."""
    return (np.arange(frames + 1) / fps).astype("<f4")


def _add_primitive(document: Document, mesh: TexturedMesh, name: str) -> dict[str, Any]:
    vertices, faces = _array(mesh.vertices), mesh.faces.cpu().numpy()
    indices = faces.ravel().astype("<u2" if len(vertices) <= MAX_SHORT_INDEX + 1 else "<u4")
    return {
        "attributes": {
            "POSITION": document.add_accessor(f"{name} positions", vertices, VERTEX_DATA),
            "NORMAL": document.add_accessor(f"{name} normals", seamless_normals(vertices, faces), VERTEX_DATA),
            "TEXCOORD_0": document.add_accessor(f"{name} texture coordinates", _array(mesh.uvs), VERTEX_DATA),
        },
        "indices": document.add_accessor(f"{name} triangles", indices, INDEX_DATA),
        "material": _add_material(document, mesh.texture, name),
        "mode": 4,
    }


def _add_material(document: Document, texture: Float[Tensor, "h w 3"], name: str) -> int:
    pixels = (texture.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG", compress_level=PNG_LEVEL)
    view = document.add_view(f"{name} color", file.getvalue())
    image = document.add("images", name=f"{name} color", mimeType="image/png", bufferView=view)
    sampler = document.add(
        "samplers",
        name=f"{name} sampler",
        magFilter=LINEAR,
        minFilter=LINEAR_MIPMAP_LINEAR,
        wrapS=CLAMP_TO_EDGE,
        wrapT=CLAMP_TO_EDGE,
    )
    number = document.add("textures", name=f"{name} color", sampler=sampler, source=image)
    surface = {"baseColorTexture": {"index": number}, "metallicFactor": 0.0, "roughnessFactor": 1.0}
    return document.add("materials", name=f"{name} surface", pbrMetallicRoughness=surface, doubleSided=True)


def _finish(document: Document, nodes: list[int]) -> bytes:
    document.tree["scene"] = document.add("scenes", name="asset", nodes=nodes)
    return document.to_bytes()


def _read_primitive(parsed: Parsed) -> tuple[TexturedMesh, dict[str, Any]]:
    """The one mesh of a file, and the glTF primitive that describes it."""
    tree = parsed.tree
    holders = [node for node in tree["nodes"] if "mesh" in node]
    if len(holders) != 1 or len(tree["meshes"][holders[0]["mesh"]]["primitives"]) != 1:
        raise BadInput(f"this GLB shows {len(holders)} meshes; only one mesh with one material can be read")
    if TRANSFORMS & holders[0].keys():
        raise BadInput("the mesh of this GLB stands under a transform; apply the transform and export it again")
    primitive: dict[str, Any] = tree["meshes"][holders[0]["mesh"]]["primitives"][0]
    surface = tree["materials"][primitive["material"]]["pbrMetallicRoughness"]
    image = tree["images"][tree["textures"][surface["baseColorTexture"]["index"]]["source"]]
    with Image.open(io.BytesIO(parsed.view(image["bufferView"]))) as picture:
        pixels = np.array(picture.convert("RGB"))
    attributes, indices = primitive["attributes"], parsed.accessor(primitive["indices"])
    if indices.dtype.kind != "u":
        raise BadInput("the triangles of this GLB are not given by whole numbers")
    mesh = TexturedMesh(
        torch.from_numpy(parsed.accessor(attributes["POSITION"]).copy()),
        torch.from_numpy(indices.astype(np.int64).reshape(-1, 3)),
        torch.from_numpy(parsed.accessor(attributes["TEXCOORD_0"]).copy()),
        torch.from_numpy(pixels).float() / 255,
    )
    if len(mesh.uvs) != len(mesh.vertices) or not (mesh.faces < len(mesh.vertices)).all():
        raise BadInput("the triangles or texture coordinates of this GLB do not fit its vertices")
    return mesh, primitive


def seamless_normals(vertices: NDArray[Any], faces: NDArray[Any]) -> NDArray[Any]:
    """Unit normals, weighted by area, equal at vertices that lie at the same place (the copies along texture seams).

    A vertex of no triangle, or of triangles without area, gets +y.
    """
    corners = vertices[faces].astype(np.float64)
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    places, place_of = np.unique(vertices, axis=0, return_inverse=True)
    sums = np.zeros((len(places), 3))
    for corner in range(3):
        np.add.at(sums, place_of.ravel()[faces[:, corner]], doubled)
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    unit = np.where(lengths > 0, sums / np.maximum(lengths, np.finfo(np.float64).tiny), (0.0, 1.0, 0.0))
    return unit[place_of.ravel()].astype("<f4")
