"""GLBs of other programs: triangles and base colors at rest.

Files are not trusted: every index, size and number is checked before it is used.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dg4d_lib.assets.formats import draco
from dg4d_lib.assets.formats.foreign_materials import BaseColors, is_transparent
from dg4d_lib.assets.formats.foreign_nodes import (
    Matrices,
    flattening,
    global_matrices,
    invisible_nodes,
    mesh_matrices,
    move_roots,
    transform_points,
)
from dg4d_lib.assets.formats.gltf import GlbReader, json_object, read_accessor
from dg4d_lib.errors import BadInput
from dg4d_lib.mesh.models.model import Model, ModelPart, far_center, moved_note, transform_normals

TRIANGLES, STRIP, FAN = 4, 5, 6
MORPHED = ("POSITION", "NORMAL")  # attributes whose morph targets are read
UNREADABLE = {
    "EXT_mesh_gpu_instancing": "it has one mesh at many places (EXT_mesh_gpu_instancing); export it without instancing",
    "KHR_meshopt_compression": "it is compressed with KHR_meshopt_compression; export it without compression",
    "KHR_texture_basisu": "its textures are in KTX2; export them as PNG or JPEG",
}
_FOREIGN = (KeyError, IndexError, TypeError, ValueError, ArithmeticError, AttributeError, OSError, struct.error)


@dataclass(frozen=True)
class Piece:
    """A primitive of a mesh where a node shows it.

    Attributes:
        node: index of the node.
        primitive: index in the mesh of the node.
        local: vertices in the coordinates of the mesh, with default morph weights.
        matrices: from there to the model, the same for all vertices or one per vertex (skinned).
        faces: triangles in the order of the file, counter-clockwise seen from outside in the coordinates of the mesh.
        morphed: attributes that default morph weights change, with these weights.
        part: vertices at rest in the coordinates of the model, triangles and colors.
    """

    node: int
    primitive: int
    local: NDArray[np.float32]
    matrices: NDArray[np.float64]
    faces: NDArray[np.int64]
    morphed: dict[str, NDArray[np.float32]]
    part: ModelPart


@dataclass(frozen=True)
class ForeignGlb:
    """GLB of another program.

    Attributes:
        reader: its tree and buffer.
        pieces: its visible triangles.
        notes: sentences about content that is not used.
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


def _read(reader: GlbReader, max_faces: int) -> ForeignGlb:
    tree = reader.tree
    if not isinstance(tree, dict) or str(json_object(tree.get("asset")).get("version", ""))[:1] != "2":
        raise BadInput("the model is not a glTF 2.0 file; export it as GLB")
    for extension, remedy in UNREADABLE.items():
        if extension in tree.get("extensionsRequired", ()):
            raise BadInput(f"the model cannot be read: {remedy}")
    draco.unpack_draco(reader)
    globals_ = global_matrices(tree)
    invisible = invisible_nodes(tree, globals_)
    nodes = [
        node
        for node in sorted(globals_)
        if "mesh" in tree["nodes"][node]
        and node not in invisible
        and not _has_no_scale(tree["nodes"][node], globals_[node])
    ]
    shown, faces, notes = [], 0, []
    for node in nodes:
        mesh = tree["meshes"][tree["nodes"][node]["mesh"]]
        for number, primitive in enumerate(mesh["primitives"]):
            if is_transparent(tree, primitive):
                continue
            if primitive.get("mode", TRIANGLES) not in (TRIANGLES, STRIP, FAN):
                notes.append(f"points and lines of {mesh.get('name', 'a mesh')!r} are not animated and left out")
                continue
            count = tree["accessors"][primitive.get("indices", primitive["attributes"]["POSITION"])]["count"]
            faces += max(0, count // 3 if primitive.get("mode", TRIANGLES) == TRIANGLES else count - 2)
            shown.append((node, number))
    if faces > max_faces:
        raise BadInput(
            f"the model has {faces} triangles; asset.max_faces allows {max_faces}: simplify it, or raise the limit "
            f"with --set asset.max_faces={faces}"
        )
    colors = BaseColors(reader)
    pieces = _pieces(reader, shown, globals_, colors)
    center = far_center(np.concatenate([piece.part.vertices for piece in pieces]))
    if center.any():
        move_roots(tree, -center)
        pieces = _pieces(reader, shown, global_matrices(tree), colors)
        notes.append(moved_note(center))
    if not all(np.isfinite(piece.part.vertices).all() for piece in pieces):
        raise BadInput("the model has vertices that are not finite numbers (NaN or infinity); export it again")
    return ForeignGlb(reader, tuple(pieces), tuple(dict.fromkeys(notes)))


def _pieces(reader: GlbReader, shown: Sequence[tuple[int, int]], globals_: Matrices, colors: BaseColors) -> list[Piece]:
    """Return the pieces with triangles, of the given nodes and primitives."""
    pieces = [_piece(reader, node, number, globals_, colors) for node, number in shown]
    if not any(len(piece.part.faces) for piece in pieces):
        raise BadInput("the model contains no triangles; give a mesh with faces")
    return [piece for piece in pieces if len(piece.part.faces)]


def _has_no_scale(node: dict[str, Any], matrix: NDArray[np.float64]) -> bool:
    """Return whether a scale of 0 hides a mesh, as in flip-book animations; skinned meshes follow only joints."""
    return "skin" not in node and not matrix[:3, :3].any()


def _piece(
    reader: GlbReader,
    node: int,
    number: int,
    globals_: Matrices,
    base_colors: BaseColors,
) -> Piece:
    tree = reader.tree
    item = tree["nodes"][node]
    mesh = tree["meshes"][item["mesh"]]
    primitive = mesh["primitives"][number]
    attributes = primitive["attributes"]
    morphed = _default_morph(reader, primitive, item.get("weights", mesh.get("weights", ())))
    local = morphed["POSITION"] if "POSITION" in morphed else read_accessor(reader, attributes["POSITION"])
    count = len(local)
    matrices = mesh_matrices(reader, node, number, globals_)
    if len(matrices) > 1 and flattening(matrices).any():
        raise BadInput(
            "the rest pose of the skeleton collapses the mesh to a plane; apply the armature and export again"
        )
    faces = _faces(reader, primitive, count)
    shading = base_colors.read(primitive)
    uvs, colors, normals = shading.uvs, shading.colors, morphed.get("NORMAL")
    if normals is None and "NORMAL" in attributes:
        normals = read_accessor(reader, attributes["NORMAL"])
    if any(values is not None and len(values) != count for values in (uvs, colors, normals)):
        raise BadInput("the attributes of a mesh of the model have different lengths; export it again")
    with np.errstate(all="ignore"):
        vertices = transform_points(matrices, local).astype(np.float32)
        mirrored = np.broadcast_to(np.linalg.det(matrices[:, :3, :3]) < 0, count)  # glTF then reverses the winding
    part = ModelPart(
        str(mesh.get("name", f"mesh {item['mesh']}")),
        vertices,
        np.where(mirrored[faces[:, :1]], faces[:, ::-1], faces),
        uvs,
        shading.texture,
        shading.factor,
        colors,
        shading.masked,
        shading.wrap,
        None if normals is None else transform_normals(matrices, normals),
    )
    return Piece(node, number, local.astype(np.float32), matrices, faces, morphed, part)


def _default_morph(
    reader: GlbReader, primitive: dict[str, Any], weights: Sequence[float]
) -> dict[str, NDArray[np.float32]]:
    """Return the attributes of a primitive that morph weights change, with these weights."""
    attributes, found = primitive["attributes"], dict[str, NDArray[np.float64]]()
    for weight, target in zip(weights, primitive.get("targets", ()), strict=False):
        for name in MORPHED:
            if weight and name in target and name in attributes:
                values = found.setdefault(name, read_accessor(reader, attributes[name]).astype(np.float64))
                values += float(weight) * read_accessor(reader, target[name])
    with np.errstate(all="ignore"):
        if "NORMAL" in found:
            normals = found["NORMAL"]
            found["NORMAL"] = np.nan_to_num(normals / np.linalg.norm(normals, axis=1, keepdims=True))
        return {name: values.astype(np.float32) for name, values in found.items()}


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
