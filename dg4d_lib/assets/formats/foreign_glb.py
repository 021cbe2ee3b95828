"""GLBs of other programs: triangles and base colors at rest.

Files are not trusted: every index, size and number is checked before it is used.
"""

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dg4d_lib.assets.formats import draco
from dg4d_lib.assets.formats.foreign_nodes import Matrices, flattening, global_matrices, mesh_matrices, transform_points
from dg4d_lib.assets.formats.gltf import GlbReader, json_object, read_accessor
from dg4d_lib.assets.formats.model_pictures import decode_picture
from dg4d_lib.errors import BadInput
from dg4d_lib.mesh.models.model import Model, ModelPart

TRIANGLES, STRIP, FAN = 4, 5, 6
MORPHED = ("POSITION", "NORMAL", "TANGENT")  # attributes whose morph targets are read
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
        transform_points(
            mesh_matrices(glb.reader, piece.node, piece.primitive, globals_), piece.local.astype(np.float64)
        )
        for piece in glb.pieces
    ]
    return np.concatenate(places).astype(np.float32)


def _read(reader: GlbReader, max_faces: int) -> ForeignGlb:
    tree = reader.tree
    if not isinstance(tree, dict) or str(json_object(tree.get("asset")).get("version", ""))[:1] != "2":
        raise BadInput("the model is no glTF 2.0; export it as GLB")
    for extension, remedy in UNREADABLE.items():
        if extension in tree.get("extensionsRequired", ()):
            raise BadInput(f"the model cannot be read: {remedy}")
    draco.unpack_draco(reader)
    globals_ = global_matrices(tree)
    nodes = [n for n in sorted(globals_) if "mesh" in tree["nodes"][n] and not _hidden(tree["nodes"][n], globals_[n])]
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


def _hidden(node: dict[str, Any], matrix: NDArray[np.float64]) -> bool:
    """Tell if a scale of 0 hides a mesh, as where frames are shown in turn; skinned ones follow their joints alone."""
    return "skin" not in node and not matrix[:3, :3].any()


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
    morphed = _default_morph(reader, primitive, item.get("weights", mesh.get("weights", ())))
    local = morphed["POSITION"] if "POSITION" in morphed else read_accessor(reader, attributes["POSITION"])
    count = len(local)
    matrices = mesh_matrices(reader, node, number, globals_)
    if len(matrices) > 1 and flattening(matrices).any():
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
        vertices = transform_points(matrices, local).astype(np.float32)
        mirrored = np.broadcast_to(np.linalg.det(matrices[:, :3, :3]) < 0, count)  # glTF then reverses the winding
    part = ModelPart(
        str(mesh.get("name", f"mesh {item['mesh']}")),
        vertices,
        np.where(mirrored[faces[:, :1]], faces[:, ::-1], faces),
        uvs,
        texture,
        (factor[0], factor[1], factor[2]),
        None if colors is None else colors.astype(np.float64),
        masked=material.get("alphaMode", "OPAQUE") != "OPAQUE",
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
                values[:, :3] += float(weight) * read_accessor(reader, target[name])
    with np.errstate(all="ignore"):
        for values in (found[name] for name in found if name != "POSITION"):
            values[:, :3] = np.nan_to_num(values[:, :3] / np.linalg.norm(values[:, :3], axis=1, keepdims=True))
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


def _base_color(material: dict[str, Any]) -> dict[str, Any]:
    """Return the shading of a material by metal and roughness, or what equals its base color in an older one."""
    specular = json_object(json_object(material.get("extensions")).get(SPECULAR))
    if "pbrMetallicRoughness" in material or not specular:
        return json_object(material.get("pbrMetallicRoughness"))
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
    extensions = json_object(texture.get("extensions"))
    source = next(
        (v["source"] for v in (json_object(extensions.get("EXT_texture_webp")), texture) if "source" in v), None
    )
    transform = json_object(json_object(info.get("extensions")).get("KHR_texture_transform"))
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
