"""Animated textured meshes as GLB: core glTF 2.0, unless the settings select extensions.

A tracked mesh becomes one mesh whose base is frame 0, with a morph target per further frame, or with principal
components as morph targets. Very long animations, and textures per frame in core glTF, are split into several nodes
that share all other data. Meshes per frame become one node each, shown and hidden by its scale. All items are named.
The baked color is the base color of a rough dielectric. `largestError` in the extras of the root node bounds the errors
of vertices along each axis, in the units of the file.
"""

import io
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from dg4d_lib.asset_settings import GltfSettings
from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.assets.formats.foreign_nodes import global_matrices
from dg4d_lib.assets.formats.gltf import MAX_POSES, GlbReader, GltfDocument
from dg4d_lib.assets.formats.materials import WEBP, Atlas, add_material, add_texture, to_uint8
from dg4d_lib.assets.formats.morph_components import fit_components, principal_components
from dg4d_lib.assets.formats.normals import mesh_normal_groups
from dg4d_lib.assets.formats.primitives import MeshPrimitive, QuantizationCube, quantization_cube, reorder_mesh
from dg4d_lib.assets.formats.tracks import Animation, Span, split_into_spans
from dg4d_lib.errors import BadInput
from dg4d_lib.mesh.textured import TexturedMesh

DEFAULTS = GltfSettings(quantized=False)  # exact
NAME = "subject"
OFFSET_POINTER = "/materials/0/pbrMetallicRoughness/baseColorTexture/extensions/KHR_texture_transform/offset"
_FOREIGN = (KeyError, IndexError, TypeError, ValueError, ArithmeticError, OSError)  # raised by files of other layouts


def write_glb(asset: Asset4D, settings: GltfSettings = DEFAULTS) -> bytes:
    """Encode a tracked mesh as GLB.

    Raises:
        BadInput: no triangles, no frames, an fps that is not positive, numbers that are not finite, arrays of
            inconsistent sizes, or a texture too large for its format.
        BackendUnavailable: meshoptimizer is missing.
    """
    _check_asset(asset)
    document = GltfDocument(asset.extras, compressed=settings.meshopt)
    animation = Animation(document, asset.fps)
    asset, atlas = _rebase(_reordered(asset) if settings.meshopt else asset), None
    offsets = _floats(asset.offsets)
    if asset.textures is not None and settings.textures == "pointer":
        atlas = Atlas.of(asset.textures, settings.atlas_size)
        animation.add_pointer(OFFSET_POINTER, "texture offset", atlas.offsets())
    materials = _add_materials(document, asset, atlas, settings)
    cube = quantization_cube([_floats(asset.mesh.vertices)], offsets, settings)
    shape = _add_shape(document, NAME, asset.mesh, offsets, cube, atlas)
    if settings.components and len(materials) == 1:
        node = _add_components(document, animation, shape, materials[0], offsets, settings)
        animation.finish()
        return _finish(document, [node], cube)
    poses = {
        frame: shape.add_pose(_frame_name(frame), pose, normals=settings.moving_normals)
        for frame, pose in enumerate(offsets)
        if frame > 0 or len(offsets) == 1
    }
    nodes = []
    spans = split_into_spans(len(offsets), MAX_POSES if len(materials) == 1 else 1)
    for span in spans:
        primitive = _primitive(shape, materials[span.first if len(materials) > 1 else 0])
        name = NAME if len(spans) == 1 else _frame_name(span.first)
        nodes.append(_add_posed_node(document, name, span, {**primitive, "targets": [poses[i] for i in span.poses]}))
        animation.add_morph(nodes[-1], name, span.keys, span.weights(), settings.interpolation.upper())
        if len(spans) > 1:
            animation.add_visibility(nodes[-1], name, span)
    animation.finish()
    return _finish(document, nodes, cube)


def write_frames_glb(
    meshes: Sequence[TexturedMesh],
    fps: float,
    extras: dict[str, Any] | None = None,
    settings: GltfSettings = DEFAULTS,
) -> bytes:
    """Encode unrelated meshes, one per frame, as GLB; each is shown at its frame (scale 1) and else hidden (scale 0).

    Raises:
        BadInput: no meshes, a mesh without triangles, an fps that is not positive, numbers that are not finite, or a
            texture too large for its format.
        BackendUnavailable: meshoptimizer is missing.
    """
    if not meshes:
        raise BadInput("an animated asset needs at least one mesh; given none")
    _check_fps(fps)
    for mesh in meshes:
        _check(mesh)
    document = GltfDocument(extras or {}, compressed=settings.meshopt)
    if settings.meshopt:
        meshes = [reorder_mesh(mesh)[0] for mesh in meshes]
    cube = quantization_cube([_floats(mesh.vertices) for mesh in meshes], (), settings)
    animation = Animation(document, fps)
    nodes = []
    for frame, mesh in enumerate(meshes):
        name = f"frame_{frame:03d}"
        nodes.append(document.add("nodes", name=name, mesh=_add_mesh(document, name, mesh, cube, settings)))
        animation.add_visibility(nodes[-1], name, Span(frame, frame + 1, len(meshes)))
    animation.finish()
    root = document.add("nodes", name=NAME, children=nodes)  # of one, too: its animated scale would replace the cube's
    return _finish(document, [root], cube)


def write_mesh_glb(mesh: TexturedMesh, settings: GltfSettings = DEFAULTS) -> bytes:
    """Encode one static mesh as GLB.

    Raises:
        BadInput: no triangles, numbers that are not finite, or a texture too large for its format.
        BackendUnavailable: meshoptimizer is missing.
    """
    _check(mesh)
    document = GltfDocument({}, compressed=settings.meshopt)
    if settings.meshopt:
        mesh, _ = reorder_mesh(mesh)
    cube = quantization_cube([_floats(mesh.vertices)], (), settings)
    node = document.add("nodes", name=NAME, mesh=_add_mesh(document, NAME, mesh, cube, settings))
    return _finish(document, [node], cube)


def read_glb(content: bytes) -> Asset4D:
    """Read a GLB of one mesh whose morph targets are its frames, as `write_glb` encodes it with any settings.

    Positions, texture coordinates and offsets are exact unless they were quantized, fps to six digits; images are as
    exact as their format. With textures per frame, that of the first frame becomes the texture of the mesh.

    Raises:
        BadInput: the file is corrupt or has another layout.
        BackendUnavailable: the file is compressed and meshoptimizer is missing.
    """
    parsed = GlbReader(content)
    try:
        nodes = _mesh_nodes(parsed)
        primitives = [_primitive_of(parsed, node) for node in nodes]
        if not all(primitive.get("targets") for primitive in primitives) or "animations" not in parsed.tree:
            raise BadInput("this GLB has no animated morph targets; give the GLB of a tracked mesh that dg4d wrote")
        mesh = _read_mesh(parsed, nodes)
        frames, fps = _read_frames(parsed, nodes)
        scale, _ = _placement(parsed, nodes[0])
        offsets = np.stack([_blend(parsed, targets, mesh) for targets, _ in frames]) * np.float32(scale)
        textures = _read_textures(parsed, [material for _, material in frames])
        extras = parsed.tree["asset"].get("extras", {})
        return Asset4D(mesh, torch.from_numpy(offsets), fps, extras, textures)
    except _FOREIGN as error:
        raise BadInput(
            f"this GLB does not have the form of an animated tracked mesh ({error!r}); give one that dg4d wrote"
        ) from error


def read_mesh_glb(content: bytes) -> TexturedMesh:
    """Read a GLB of one mesh, as `write_mesh_glb` encodes it; morph targets are ignored.

    Raises:
        BadInput: the file is corrupt or has another layout.
        BackendUnavailable: the file is compressed and meshoptimizer is missing.
    """
    parsed = GlbReader(content)
    try:
        return _read_mesh(parsed, _mesh_nodes(parsed))
    except _FOREIGN as error:
        raise BadInput(
            f"this GLB does not have the form of one textured mesh ({error!r}); give one that dg4d wrote"
        ) from error


def component_notes(name: str, content: bytes, meters_per_unit: float = 1.0) -> tuple[str, ...]:
    """Return a note on the error of the principal components in a file of `write_glb`; none if it has frames.

    Args:
        name: of the file.
        content: the file.
        meters_per_unit: scale of the asset, meters per world unit of the fit; the note gives distances in world units.
    """
    tree = GlbReader(content).tree
    errors = tree["nodes"][tree["scenes"][0]["nodes"][0]].get("extras", {})
    if "rmsError" not in errors:
        return ()
    rms, largest = errors["rmsError"] / meters_per_unit, errors["largestError"] / meters_per_unit
    return (
        f"{name} misses the motion by {rms:.2g} world units (rms), at most {largest:.2g}, by its principal components "
        "(pack.gltf.components)",
    )


def _frame_name(frame: int) -> str:
    return f"frame_{frame:03d}"


def _check_asset(asset: Asset4D) -> None:
    vertices = len(asset.mesh.vertices)
    if len(asset.offsets) == 0:
        raise BadInput("an animated asset needs at least one frame of offsets; given none")
    _check(asset.mesh)
    _check_fps(asset.fps)
    if asset.offsets.shape[1] != vertices:
        raise BadInput(
            f"the mesh has {vertices} vertices, but offsets for {asset.offsets.shape[1]}; extract the mesh again"
        )
    if not _finite(asset.offsets):
        raise BadInput("the offsets of the mesh hold numbers that are not finite; extract the mesh again")
    if asset.textures is not None and not _finite(asset.textures):
        raise BadInput("the textures of the frames hold numbers that are not finite; refine the texture again")


def _check_fps(fps: float) -> None:
    if not 0 < fps < float("inf"):
        raise BadInput(f"frames per second must be positive; given {fps}")


def _check(mesh: TexturedMesh) -> None:
    if len(mesh.faces) == 0:
        raise BadInput("a mesh without triangles cannot be written as GLB; extract the mesh again")
    if mesh.texture.numel() == 0:
        raise BadInput(f"a mesh needs a texture of at least one pixel; given shape {tuple(mesh.texture.shape)}")
    if not all(_finite(values) for values in (mesh.vertices, mesh.uvs, mesh.texture)):
        raise BadInput("the mesh holds numbers that are not finite; extract the mesh again")
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise BadInput(
            f"the triangles refer to vertices beyond the {len(mesh.vertices)} of the mesh; extract the mesh again"
        )


def _finite(values: Tensor) -> bool:
    return all(math.isfinite(bound) for bound in torch.aminmax(values))  # one pass, because textures are large


def _floats(values: Tensor) -> NDArray[np.float32]:
    return np.ascontiguousarray(values.detach().cpu().numpy().astype("<f4"))


def _rebase(asset: Asset4D) -> Asset4D:
    """Make frame 0 the mesh, so that its offsets are 0."""
    first = asset.offsets[0]
    mesh = replace(asset.mesh, vertices=asset.mesh.vertices + first)
    return replace(asset, mesh=mesh, offsets=asset.offsets - first)


def _reordered(asset: Asset4D) -> Asset4D:
    mesh, order = reorder_mesh(asset.mesh)
    return replace(asset, mesh=mesh, offsets=asset.offsets[:, order])


def _add_components(
    document: GltfDocument,
    animation: Animation,
    shape: MeshPrimitive,
    material: int,
    offsets: NDArray[np.float32],
    settings: GltfSettings,
) -> int:
    """Add a node with principal components as morph targets, and their error; return its index."""
    components, weights = principal_components(offsets, settings.components)
    # Integers stand for offsets inside the cube and changes in [-1, 1]; larger weights make up for smaller components.
    reach = shape.component_reach(components)
    changes: Sequence[NDArray[np.float32] | None] = [None] * len(components)
    if settings.moving_normals:
        turned = fit_components(np.stack([shape.turn_normals(pose) for pose in offsets]), weights)
        reach = np.maximum(reach, np.abs(turned).max((1, 2)))
        changes = list(turned / reach[:, None, None])
    components, weights = components / reach[:, None, None], weights * reach
    names = [f"component_{number:03d}" for number in range(len(components))]
    targets = [
        shape.add_component(name, component, change)
        for name, component, change in zip(names, components, changes, strict=True)
    ]
    primitive = {**_primitive(shape, material), "targets": targets}
    keys = list(range(len(offsets) + 1))
    track = np.concatenate((weights, weights[:1]))
    node = _add_morphed_node(document, NAME, primitive, weights[0].tolist(), names)
    animation.add_morph(node, NAME, keys, track, settings.interpolation.upper())
    missed = shape.distances(components, weights, offsets)
    errors = {"largestError": float(missed.max()), "rmsError": float(np.sqrt(np.square(missed).mean()))}
    document.tree["nodes"][node]["extras"] = errors
    return node


def _add_materials(document: GltfDocument, asset: Asset4D, atlas: Atlas | None, settings: GltfSettings) -> list[int]:
    """Add the material of all frames, or one per frame; return their indices."""
    if atlas is not None and asset.textures is not None:
        pictures = {NAME: atlas.pack(asset.textures)}
    elif asset.textures is not None:
        pictures = {_frame_name(frame): to_uint8(texture) for frame, texture in enumerate(asset.textures)}
    else:
        pictures = {NAME: to_uint8(asset.mesh.texture)}
    return [
        add_material(document, name, add_texture(document, name, pixels, settings), settings, atlas)
        for name, pixels in pictures.items()
    ]


def _add_mesh(
    document: GltfDocument, name: str, mesh: TexturedMesh, cube: QuantizationCube | None, settings: GltfSettings
) -> int:
    """Add a static mesh with its material; return its index."""
    texture = add_texture(document, name, to_uint8(mesh.texture), settings)
    shape = _add_shape(document, name, mesh, np.zeros((1, 1, 3), np.float32), cube)
    primitive = _primitive(shape, add_material(document, name, texture, settings))
    return document.add("meshes", name=name, primitives=[primitive])


def _add_shape(
    document: GltfDocument,
    name: str,
    mesh: TexturedMesh,
    offsets: NDArray[np.float32],
    cube: QuantizationCube | None,
    atlas: Atlas | None = None,
) -> MeshPrimitive:
    uvs = _floats(mesh.uvs) if atlas is None else atlas.to_atlas_uvs(_floats(mesh.uvs))
    vertices = _floats(mesh.vertices)
    groups = mesh_normal_groups(mesh, vertices + offsets)
    return MeshPrimitive(document, name, vertices, mesh.faces.cpu().numpy(), uvs, cube, groups)


def _primitive(shape: MeshPrimitive, material: int) -> dict[str, Any]:
    return {"attributes": shape.attributes, "indices": shape.indices, "material": material, "mode": 4}


def _add_posed_node(document: GltfDocument, name: str, span: Span, primitive: dict[str, Any]) -> int:
    """Add a node with the poses of a span as morph targets, in its first pose; return its index."""
    names = [_frame_name(pose) for pose in span.poses]
    return _add_morphed_node(document, name, primitive, span.weights()[0].tolist(), names)


def _add_morphed_node(
    document: GltfDocument, name: str, primitive: dict[str, Any], weights: list[float], names: list[str]
) -> int:
    mesh = document.add("meshes", name=name, primitives=[primitive], weights=weights, extras={"targetNames": names})
    return document.add("nodes", name=name, mesh=mesh)


def _finish(document: GltfDocument, nodes: list[int], cube: QuantizationCube | None) -> bytes:
    """Encode the document with a single root node, which holds the transform of the quantization cube."""
    root = nodes[0] if len(nodes) == 1 else document.add("nodes", name=NAME, children=nodes)
    if cube is not None:
        document.tree["nodes"][root] |= cube.node_transform()
        document.tree["nodes"][root].setdefault("extras", {"largestError": cube.max_error})
    document.tree["scene"] = document.add("scenes", name="asset", nodes=[root])
    return document.to_bytes()


def _mesh_nodes(parsed: GlbReader) -> list[int]:
    """Return the nodes that show the single mesh of a file."""
    nodes = [number for number, node in enumerate(parsed.tree["nodes"]) if "mesh" in node]
    shapes = []
    for number in nodes:
        primitives = parsed.tree["meshes"][parsed.tree["nodes"][number]["mesh"]]["primitives"]
        shapes += [(primitive["attributes"], primitive["indices"]) for primitive in primitives]
    if not nodes or any(shape != shapes[0] for shape in shapes) or len(shapes) > len(nodes):
        raise BadInput(f"this GLB shows {len(shapes)} meshes; give a file with one mesh and one material")
    return nodes


def _primitive_of(parsed: GlbReader, node: int) -> dict[str, Any]:
    primitive: dict[str, Any] = parsed.tree["meshes"][parsed.tree["nodes"][node]["mesh"]]["primitives"][0]
    return primitive


def _read_mesh(parsed: GlbReader, nodes: list[int]) -> TexturedMesh:
    """Read the mesh at rest, with the texture of the first node."""
    primitive = _primitive_of(parsed, nodes[0])
    attributes, indices = primitive["attributes"], parsed.accessor(primitive["indices"])
    if indices.dtype.kind != "u":
        raise BadInput("the triangle indices of this GLB are not unsigned integers; export it again")
    scale, shift = _placement(parsed, nodes[0])
    vertices = (parsed.accessor(attributes["POSITION"]) * scale + shift).astype(np.float32)
    pixels, atlas = _read_picture(parsed, primitive["material"])
    uvs = parsed.accessor(attributes["TEXCOORD_0"])
    mesh = TexturedMesh(
        torch.from_numpy(vertices),
        torch.from_numpy(indices.astype(np.int64).reshape(-1, 3)),
        torch.from_numpy(uvs.copy() if atlas is None else atlas.from_atlas_uvs(uvs)),
        _colors(pixels if atlas is None else atlas.unpack(pixels)[0]),
    )
    if len(mesh.uvs) != len(mesh.vertices) or not (mesh.faces < len(mesh.vertices)).all():
        raise BadInput("the triangles or texture coordinates of this GLB do not match its vertices; export it again")
    return mesh


def _placement(parsed: GlbReader, node: int) -> tuple[float, NDArray[np.float64]]:
    """Return world scale and origin of a node; an animated scale (which shows and hides nodes) counts as 1."""
    tree = parsed.tree
    targets = [channel["target"] for animation in tree.get("animations", []) for channel in animation["channels"]]
    shown = {target["node"] for target in targets if target["path"] == "scale"}
    matrix = global_matrices(tree, unscaled=shown)[node]
    scale = float(matrix[0, 0])
    if not np.array_equal(matrix[:3, :3], scale * np.eye(3)):
        raise BadInput("the mesh of this GLB has a transform; apply the transform and export it again")
    return scale, matrix[:3, 3]


def _blend(parsed: GlbReader, targets: dict[int, float], mesh: TexturedMesh) -> NDArray[np.float32]:
    """Return the offsets of a frame: accessors of morph targets times their weights."""
    offsets = np.zeros(mesh.vertices.shape, np.float32)
    for number, weight in targets.items():
        rows = parsed.accessor(number)
        if rows.shape != offsets.shape:
            raise BadInput(
                f"the morph targets of this GLB have {len(rows)} rows, the mesh has {len(offsets)} vertices; "
                "export it again"
            )
        offsets += rows * np.float32(weight)
    return offsets


def _read_frames(parsed: GlbReader, nodes: list[int]) -> tuple[list[tuple[dict[int, float], int]], float]:
    """Return positions and weights of the morph targets and the material of every frame, and the frames per second."""
    (animation,) = parsed.tree["animations"]
    tracks = {
        channel["target"]["node"]: animation["samplers"][channel["sampler"]]
        for channel in animation["channels"]
        if channel["target"]["path"] == "weights"
    }
    times = [parsed.accessor(tracks[node]["input"])[:, 0] for node in nodes]
    fps = float(f"{1 / (times[0][1] - times[0][0]):.6g}")
    frames: dict[int, tuple[dict[int, float], int]] = {}
    for node, seconds in zip(nodes, times, strict=True):
        primitive = _primitive_of(parsed, node)
        positions = [target["POSITION"] for target in primitive["targets"]]
        weights = parsed.accessor(tracks[node]["output"]).reshape(len(seconds), len(positions))
        for second, row in zip(seconds[:-1], weights, strict=False):
            blend = {position: float(weight) for position, weight in zip(positions, row, strict=True) if weight}
            frames[round(float(second * fps))] = (blend, primitive["material"])
    if sorted(frames) != list(range(len(frames))):
        raise BadInput("the animation of this GLB omits frames; give a GLB that dg4d wrote")
    return [frames[frame] for frame in range(len(frames))], fps


def _read_textures(parsed: GlbReader, materials: list[int]) -> Float[Tensor, "t h w 3"] | None:
    """Read the textures of all frames; None if there is only one."""
    pixels, atlas = _read_picture(parsed, materials[0])
    if atlas is not None:
        return _colors(atlas.unpack(pixels))
    if len(set(materials)) == 1:
        return None
    return _colors(np.stack([_read_picture(parsed, material)[0] for material in materials]))


def _read_picture(parsed: GlbReader, material: int) -> tuple[NDArray[np.uint8], Atlas | None]:
    """Read the base color image of a material, and its atlas layout if it is an atlas."""
    tree = parsed.tree
    item = tree["materials"][material]
    texture = tree["textures"][item["pbrMetallicRoughness"]["baseColorTexture"]["index"]]
    source = texture.get("extensions", {}).get(WEBP, texture)["source"]
    with Image.open(io.BytesIO(parsed.view(tree["images"][source]["bufferView"]))) as picture:
        pixels = np.array(picture.convert("RGB"))
    layout = item.get("extras", {}).get("atlas")
    return pixels, None if layout is None else Atlas(**layout)


def _colors(pixels: NDArray[np.uint8]) -> Float[Tensor, "*t h w 3"]:
    return torch.from_numpy(pixels).float() / 255
