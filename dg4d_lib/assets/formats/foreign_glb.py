"""GLBs of other programs: triangles and base colors at rest, and the same file with morph targets over time.

Everything in the file is kept: nodes, names, materials, textures, texture coordinates and skeletons. A skeleton moves,
and morph targets do what it cannot. Existing animations are dropped, since they would move the model twice; existing
morph targets keep their default weights.
Files are not trusted: every index, size and number is checked before it is used.
"""

import json
import math
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import repeat
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dg4d_lib.assets.formats import draco, meshopt
from dg4d_lib.assets.formats.foreign_nodes import (
    Matrices,
    global_matrices,
    mesh_attributes,
    mesh_matrices,
    parents_of,
    skin_of,
    skin_weights,
)
from dg4d_lib.assets.formats.foreign_skeleton import (
    JointTrack,
    SkeletonAtRest,
    SkeletonMotion,
    SkinnedVertices,
    fit_skeleton,
)
from dg4d_lib.assets.formats.gltf import MAX_POSES, VERTEX_DATA, GlbReader, GltfDocument, read_accessor
from dg4d_lib.assets.formats.joint_motion import close_loop
from dg4d_lib.assets.formats.model_pictures import decode_picture
from dg4d_lib.assets.formats.normals import SmoothNormals
from dg4d_lib.assets.formats.tracks import Animation
from dg4d_lib.errors import BadInput
from dg4d_lib.mesh.models.model import Model, ModelPart
from dg4d_lib.mesh.tracking.rig import continuous_quats

TRIANGLES, STRIP, FAN = 4, 5, 6
SAMPLE = 2000  # vertices, evenly chosen, that the motion of a skeleton is fitted to
FLAT = 1e-9  # determinant of a matrix that cannot be inverted, relative to the cube of its norm
PLACEMENT = "dg4d placement"
MOTION = "dg4d motion"
MOVES = "the skeleton of the model moves; what it cannot do is in morph targets"
AT_REST = "the skeleton of the model is kept at rest, for {}; morph targets have the motion"
UNREADABLE = {
    "EXT_mesh_gpu_instancing": "it has one mesh at many places (EXT_mesh_gpu_instancing); export it without instancing",
    "KHR_meshopt_compression": "it is compressed with KHR_meshopt_compression; export it without compression",
    "KHR_texture_basisu": "its textures are in KTX2; export them as PNG or JPEG",
}
SPECULAR = "KHR_materials_pbrSpecularGlossiness"  # materials of older exporters
_FOREIGN = (KeyError, IndexError, TypeError, ValueError, ArithmeticError, AttributeError, OSError, struct.error)


@dataclass(frozen=True)
class Piece:
    """A primitive of a mesh where a node shows it.

    Attributes:
        node: index of the node.
        primitive: index in the mesh of the node.
        local: vertices in the coordinates of the mesh, with default morph weights.
        matrices: from there to the model, the same for all vertices or one per vertex (skinned).
        part: vertices at rest in the coordinates of the model, triangles and colors.
    """

    node: int
    primitive: int
    local: NDArray[np.float32]
    matrices: NDArray[np.float64]
    part: ModelPart


@dataclass(frozen=True)
class ForeignGlb:
    """GLB of another program.

    Attributes:
        reader: its tree and buffer.
        pieces: its visible triangles.
        notes: sentences about what is not used.
    """

    reader: GlbReader
    pieces: tuple[Piece, ...]
    notes: tuple[str, ...] = field(default=())

    @property
    def model(self) -> Model:
        """Triangles and colors at rest, in the coordinates of the file."""
        return Model(tuple(piece.part for piece in self.pieces))


def read_foreign_glb(content: bytes, max_faces: int) -> ForeignGlb:
    """Read the triangles that a GLB shows, at rest.

    Args:
        content: of the file.
        max_faces: largest number of triangles.

    Raises:
        BadInput: the file is broken, has no or too many triangles, numbers that are not finite, missing textures, or
            a compression that cannot be read.
    """
    reader = GlbReader(content)
    try:
        return _read(reader, max_faces)
    except (*_FOREIGN, RecursionError) as error:
        raise BadInput(f"the model is a broken glTF ({error!r}); export it again") from error


def moved_pieces(glb: ForeignGlb) -> NDArray[np.float32]:
    """Return the vertices of all pieces where the nodes of the file are now, in the coordinates of the model."""
    globals_ = global_matrices(glb.reader.tree)
    places = [
        _transformed(mesh_matrices(glb.reader, piece.node, piece.primitive, globals_), piece.local.astype(np.float64))
        for piece in glb.pieces
    ]
    return np.concatenate(places).astype(np.float32)


def write_moving_glb(
    glb: ForeignGlb,
    placement: NDArray[np.float64],
    moved: NDArray[np.float32],
    fps: float,
    extras: dict[str, Any],
    interpolation: str = "LINEAR",
    moving_normals: bool = True,
) -> tuple[bytes, tuple[str, ...]]:
    """Write the file with a morph target per frame, and its skeleton in motion, in the coordinates of the world.

    Args:
        glb: the file at rest.
        placement: from the coordinates of the model to the world.
        moved: vertices of all pieces in their order, at every frame, world units.
        fps: frames per second.
        extras: JSON that is added to the asset.
        interpolation: between frames, LINEAR or STEP.
        moving_normals: True to move the normals of primitives that have some.

    Returns:
        The GLB, and notes about it.

    Raises:
        BadInput: the file would be larger than a GLB may be.
    """
    notes = list(glb.notes)
    document = _reopened(glb.reader, extras)
    tree = document.tree
    if tree.pop("animations", None):
        notes.append("the animations of the model were dropped: the new motion takes their place")
    step = -(-len(moved) // MAX_POSES)
    if step > 1:
        notes.append(f"the animated model has every {step}. frame as a key; {MAX_POSES} morph targets are allowed")
    moved, rate = moved[::step], fps / step
    keys = list(range(len(moved) + 1))  # the last one shows frame 0 again
    track = np.eye(len(moved), dtype=np.float32)[np.array(keys) % len(moved)]  # the base is the model as given
    back: NDArray[np.float64] = np.linalg.inv(placement).astype(np.float64)
    animation = Animation(document, rate)
    skeleton = None
    if "skins" in tree:
        try:
            skeleton, tracks = _moving_skeleton(glb, moved, back)
            _animate_joints(document, animation, skeleton.joints, tracks, keys, interpolation)
            notes.append(MOVES)
        except SkeletonAtRest as reason:
            notes.append(AT_REST.format(reason))
    start = 0
    for node, pieces in _by_node(glb.pieces).items():
        mesh = {**tree["meshes"][tree["nodes"][node]["mesh"]]}
        mesh["primitives"] = [{**primitive} for primitive in mesh["primitives"]]
        for primitive in mesh["primitives"]:
            primitive.pop("targets", None)
        for piece in pieces:
            states = moved[:, start : start + len(piece.local)]
            start += len(piece.local)
            primitive = mesh["primitives"][piece.primitive]
            inverses = _inverses(glb, piece, skeleton, back)
            primitive["targets"] = _targets(document, piece, states, inverses, primitive, moving_normals)
        mesh["primitives"] = [one for one in mesh["primitives"] if "targets" in one]  # all need as many targets
        mesh["weights"] = track[0].tolist()
        mesh["extras"] = {**_object(mesh.get("extras")), "targetNames": [f"frame_{pose:03d}" for pose in keys[:-1]]}
        tree["nodes"][node] = {key: value for key, value in tree["nodes"][node].items() if key != "weights"}
        tree["nodes"][node]["mesh"] = document.add("meshes", **mesh)
        animation.add_morph(node, str(tree["nodes"][node].get("name", f"node {node}")), keys, track, interpolation)
    animation.finish()
    tree["animations"][-1]["name"] = MOTION
    _place(document, placement)
    _drop_unused_meshes(tree)
    return document.to_bytes(), tuple(notes)


def _moving_skeleton(
    glb: ForeignGlb, moved: NDArray[np.float32], back: NDArray[np.float64]
) -> tuple[SkeletonMotion, list[JointTrack]]:
    """Return the motion of the model's skeleton, and that of every joint relative to its parent.

    Args:
        glb: the file at rest.
        moved: vertices of all pieces at every frame, world units.
        back: from the world to the coordinates of the model.

    Raises:
        SkeletonAtRest: it cannot move.
    """
    tree, start, skinned = glb.reader.tree, 0, []
    skins = [skin_of(tree, piece.node, piece.primitive) for piece in glb.pieces]
    step = max(1, sum(len(piece.local) for piece, skin in zip(glb.pieces, skins, strict=True) if skin) // SAMPLE)
    for piece, skin in zip(glb.pieces, skins, strict=True):
        rows = slice(start, start := start + len(piece.local), step)
        if skin is not None:
            indices, weights = skin_weights(glb.reader, mesh_attributes(tree, piece.node, piece.primitive))
            states = moved[:, rows] @ back[:3, :3].T + back[:3, 3]
            rest = piece.part.vertices[::step]
            skinned.append(SkinnedVertices(skin["joints"], indices[::step], weights[::step], rest, states))
    matrices = global_matrices(tree)
    skeleton = fit_skeleton(matrices, parents_of(tree, matrices), skinned)
    return skeleton, [skeleton.track(joint) for joint in skeleton.joints]


def _animate_joints(
    document: GltfDocument,
    animation: Animation,
    joints: Sequence[int],
    tracks: Sequence[JointTrack],
    keys: list[int],
    interpolation: str,
) -> None:
    """Add the motion of the joints; they get translations, rotations and scales in place of matrices."""
    quats = continuous_quats(np.stack([track.rotations for track in tracks]))[..., [1, 2, 3, 0]]
    nodes = document.tree["nodes"]
    for number, (joint, track) in enumerate(zip(joints, tracks, strict=True)):
        places, turns = close_loop(track.translations), close_loop(quats[:, number])
        node = {key: value for key, value in nodes[joint].items() if key != "matrix"}
        node.update(translation=places[0].tolist(), rotation=turns[0].tolist(), scale=track.scale.tolist())
        nodes[joint] = node
        animation.add_transform(joint, str(node.get("name", f"node {joint}")), keys, places, turns, interpolation)


def _inverses(
    glb: ForeignGlb, piece: Piece, skeleton: SkeletonMotion | None, back: NDArray[np.float64]
) -> Iterable[NDArray[np.float64]]:
    """Return what leads from the world to the coordinates of a piece's mesh, at every frame."""
    if skeleton is None:
        return repeat(_inverse(piece.matrices) @ back)
    skin = skin_of(glb.reader.tree, piece.node, piece.primitive)
    needed = {node: skeleton.matrices(node) for node in (skin["joints"] if skin else [piece.node])}
    frames = ({node: moving[frame] for node, moving in needed.items()} for frame in range(len(skeleton.maps)))
    return (_inverse(mesh_matrices(glb.reader, piece.node, piece.primitive, one)) @ back for one in frames)


def _by_node(pieces: Sequence[Piece]) -> dict[int, list[Piece]]:
    found: dict[int, list[Piece]] = {}
    for piece in pieces:
        found.setdefault(piece.node, []).append(piece)
    return found


def _targets(
    document: GltfDocument,
    piece: Piece,
    states: NDArray[np.float32],
    inverses: Iterable[NDArray[np.float64]],
    primitive: dict[str, Any],
    moving_normals: bool,
) -> list[dict[str, int]]:
    """Add displacements in the coordinates of the mesh; return the morph targets.

    `inverses` lead there from the world, at every frame.
    """
    turning = "NORMAL" in primitive["attributes"] and moving_normals
    normals_of = SmoothNormals(piece.local, piece.part.faces) if turning else None
    rest = normals_of(piece.local) if normals_of else None
    targets = []
    for frame, (state, inverse) in enumerate(zip(states, inverses, strict=False)):
        local = _transformed(inverse, state).astype(np.float32)
        name = f"{piece.part.name} frame_{frame:03d}"
        target = {"POSITION": document.add_accessor(name, local - piece.local, VERTEX_DATA)}
        if normals_of is not None and rest is not None:
            target["NORMAL"] = document.add_accessor(f"{name} normals", normals_of(local) - rest, VERTEX_DATA)
        targets.append(target)
    return targets


def _place(document: GltfDocument, placement: NDArray[np.float64]) -> None:
    """Put all root nodes of the scene under a node that moves them into the world."""
    tree = document.tree
    scene = tree["scenes"][tree.get("scene", 0)]
    root = document.add("nodes", name=PLACEMENT, children=scene["nodes"], matrix=placement.T.ravel().tolist())
    scene["nodes"] = [root]


def _drop_unused_meshes(tree: dict[str, Any]) -> None:
    """Remove meshes that no node shows any more; others keep their order."""
    used = sorted({node["mesh"] for node in tree["nodes"] if "mesh" in node})
    tree["meshes"] = [tree["meshes"][index] for index in used]
    for node in tree["nodes"]:
        if "mesh" in node:
            node["mesh"] = used.index(node["mesh"])


def _reopened(reader: GlbReader, extras: dict[str, Any]) -> GltfDocument:
    """Return the file as a document that can be added to, without compression."""
    document = GltfDocument({})
    tree = json.loads(json.dumps(reader.tree))
    views = []
    for index, view in enumerate(tree.get("bufferViews", [])):
        content = reader.view(index)
        view.get("extensions", {}).pop(meshopt.EXTENSION, None)
        view.update(buffer=0, byteOffset=len(document.binary), byteLength=len(content))
        document.binary += content + bytes(-len(content) % 4)
        views.append(view)
    tree["bufferViews"] = views
    for names in (tree.get("extensionsUsed", []), tree.get("extensionsRequired", [])):
        if meshopt.EXTENSION in names:
            names.remove(meshopt.EXTENSION)
    for collection in [name for name, value in tree.items() if value == []]:
        del tree[collection]  # glTF allows no empty arrays
    tree["asset"] = {**tree["asset"], "extras": {**_object(tree["asset"].get("extras")), **extras}}
    document.tree = tree
    return document


def _object(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _read(reader: GlbReader, max_faces: int) -> ForeignGlb:
    tree = reader.tree
    if not isinstance(tree, dict) or str(_object(tree.get("asset")).get("version", ""))[:1] != "2":
        raise BadInput("the model is no glTF 2.0; export it as GLB")
    for extension, remedy in UNREADABLE.items():
        if extension in tree.get("extensionsRequired", ()):
            raise BadInput(f"the model cannot be read: {remedy}")
    draco.unpack_draco(reader)
    globals_ = global_matrices(tree)
    nodes = [n for n in sorted(globals_) if "mesh" in tree["nodes"][n]]
    faces, notes = 0, []
    for node in nodes:
        for primitive in tree["meshes"][tree["nodes"][node]["mesh"]]["primitives"]:
            count = tree["accessors"][primitive.get("indices", primitive["attributes"]["POSITION"])]["count"]
            most = {TRIANGLES: count // 3, STRIP: count - 2, FAN: count - 2}
            faces += max(0, most.get(primitive.get("mode", TRIANGLES), 0))
    if faces > max_faces:
        raise BadInput(
            f"the model has {faces} triangles; asset.max_faces allows {max_faces}: simplify it, or raise the limit "
            f"with --set asset.max_faces={faces}"
        )
    pieces: list[Piece] = []
    pictures: dict[int, NDArray[np.uint8]] = {}
    for node in nodes:
        mesh = tree["meshes"][tree["nodes"][node]["mesh"]]
        for number, primitive in enumerate(mesh["primitives"]):
            if primitive.get("mode", TRIANGLES) not in (TRIANGLES, STRIP, FAN):
                notes.append(f"points and lines of {mesh.get('name', 'a mesh')!r} are not animated and left out")
                continue
            pieces.append(_piece(reader, node, number, globals_, pictures))
    pieces = [piece for piece in pieces if len(piece.part.faces)]
    if not pieces:
        raise BadInput("the model shows no triangles; give a mesh with faces")
    if not all(np.isfinite(piece.part.vertices).all() for piece in pieces):
        raise BadInput("the model has vertices that are not finite numbers (NaN or infinity); export it again")
    return ForeignGlb(reader, tuple(pieces), tuple(dict.fromkeys(notes)))


def _piece(
    reader: GlbReader,
    node: int,
    number: int,
    globals_: Matrices,
    pictures: dict[int, NDArray[np.uint8]],
) -> Piece:
    tree = reader.tree
    item = tree["nodes"][node]
    mesh = tree["meshes"][item["mesh"]]
    primitive = mesh["primitives"][number]
    attributes = primitive["attributes"]
    local = read_accessor(reader, attributes["POSITION"]).astype(np.float64)
    weights = item.get("weights", mesh.get("weights", ()))
    for weight, target in zip(weights, primitive.get("targets", ()), strict=False):
        if weight and "POSITION" in target:
            local = local + float(weight) * read_accessor(reader, target["POSITION"])
    count = len(local)
    matrices = mesh_matrices(reader, node, number, globals_)
    if len(matrices) > 1 and _flat(matrices).any():
        raise BadInput("the skeleton of the model flattens it at rest; apply it and export the mesh again")
    faces = _faces(reader, primitive, count)
    material = tree["materials"][primitive["material"]] if "material" in primitive else {}
    shading = _base_color(material)
    texture, uvs = _texture(reader, shading.get("baseColorTexture"), attributes, pictures)
    colors = read_accessor(reader, attributes["COLOR_0"])[:, :3] if "COLOR_0" in attributes else None
    factor = [float(value) for value in shading.get("baseColorFactor", (1, 1, 1, 1))]
    if any(values is not None and len(values) != count for values in (uvs, colors)):
        raise BadInput("the attributes of a mesh of the model have different lengths; export it again")
    with np.errstate(all="ignore"):
        vertices = _transformed(matrices, local).astype(np.float32)
    part = ModelPart(
        str(mesh.get("name", f"mesh {item['mesh']}")),
        vertices,
        faces,
        uvs,
        texture,
        (factor[0], factor[1], factor[2]),
        None if colors is None else colors.astype(np.float64),
        masked=material.get("alphaMode", "OPAQUE") != "OPAQUE",
    )
    return Piece(node, number, local.astype(np.float32), matrices, part)


def _faces(reader: GlbReader, primitive: dict[str, Any], count: int) -> NDArray[np.int64]:
    if "indices" in primitive:
        order = read_accessor(reader, primitive["indices"], raw=True)[:, 0].astype(np.int64)
    else:
        order = np.arange(count)
    if len(order) and not 0 <= order.min() <= order.max() < count:
        raise BadInput(f"triangles of the model refer to vertices beyond its {count}; export it again")
    match primitive.get("mode", TRIANGLES):
        case 4:
            return order[: len(order) // 3 * 3].reshape(-1, 3)
        case 5:
            strip = np.stack([order[:-2], order[1:-1], order[2:]], 1)
            strip[1::2] = strip[1::2, [1, 0, 2]]
            return strip
        case _:
            return np.stack([np.full(len(order) - 2, order[0]), order[1:-1], order[2:]], 1)


def _base_color(material: dict[str, Any]) -> dict[str, Any]:
    """Return the shading of a material by metal and roughness, or what equals its base color in an older one."""
    specular = _object(_object(material.get("extensions")).get(SPECULAR))
    if "pbrMetallicRoughness" in material or not specular:
        return _object(material.get("pbrMetallicRoughness"))
    renamed = {"diffuseFactor": "baseColorFactor", "diffuseTexture": "baseColorTexture"}
    return {renamed[key]: value for key, value in specular.items() if key in renamed}


def _texture(
    reader: GlbReader, info: Any, attributes: dict[str, int], pictures: dict[int, NDArray[np.uint8]]
) -> tuple[NDArray[np.uint8] | None, NDArray[np.float64] | None]:
    """Return the base color texture and its coordinates; both None without one."""
    if not isinstance(info, dict):
        return None, None
    tree = reader.tree
    texture = tree["textures"][info["index"]]
    extensions = _object(texture.get("extensions"))
    source = next((v["source"] for v in (_object(extensions.get("EXT_texture_webp")), texture) if "source" in v), None)
    transform = _object(_object(info.get("extensions")).get("KHR_texture_transform"))
    name = f"TEXCOORD_{transform.get('texCoord', info.get('texCoord', 0))}"
    if source is None or name not in attributes:
        return None, None
    if source not in pictures:
        pictures[source] = _picture(reader, source)
    uvs = read_accessor(reader, attributes[name]).astype(np.float64)
    turn = float(transform.get("rotation", 0))
    c, s = math.cos(turn), math.sin(turn)
    uvs = (uvs * transform.get("scale", (1, 1))) @ np.array([[c, -s], [s, c]]) + transform.get("offset", (0, 0))
    return pictures[source], uvs


def _picture(reader: GlbReader, index: int) -> NDArray[np.uint8]:
    image = reader.tree["images"][index]
    if "bufferView" not in image:
        raise BadInput(
            f"the texture {str(image.get('uri', index))[:80]!r} of the model is missing; put it beside the model, or "
            "export the model as GLB with its textures"
        )
    return decode_picture(reader.view(image["bufferView"]), str(image.get("name", index)))


def _inverse(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverses; where a twisted joint flattens a vertex's surroundings, the nearest thing to one."""
    flat = _flat(matrices)
    found: NDArray[np.float64] = np.linalg.inv(np.where(flat[:, None, None], np.eye(4), matrices))
    if flat.any():
        found[flat] = np.linalg.pinv(matrices[flat])
    return found


def _flat(matrices: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell which matrices flatten what they move; small ones need not, as of quantized meshes."""
    linear = matrices[:, :3, :3]
    flat: NDArray[np.bool_] = np.abs(np.linalg.det(linear)) <= FLAT * np.linalg.norm(linear, axis=(1, 2)) ** 3
    return flat


def _transformed(matrices: NDArray[np.float64], points: NDArray[Any]) -> NDArray[np.float64]:
    """Apply one affine matrix, or one per point."""
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], 1)
    if len(matrices) == 1:
        return (homogeneous @ matrices[0].T)[:, :3]
    return np.einsum("vij,vj->vi", matrices, homogeneous)[:, :3]
