"""PLY meshes, ASCII or binary, with vertex colors, face colors or one texture."""

import re
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dg4d_lib.assets.formats.obj import FLOAT_COLORS, Decode, Read, read_texture
from dg4d_lib.assets.formats.ply_elements import Element, read_elements
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.ply import header_text
from dg4d_lib.mesh.models.model import Model, ModelPart, single_precision, to_linear
from dg4d_lib.mesh.models.polygons import triangulate

_FACES = re.compile(rb"^element face (\d+)", re.MULTILINE)
_TEXTURE = re.compile(rb"^comment TextureFile\s+(.+?)\s*$", re.MULTILINE)
_WIDE_COLORS = re.compile(rb"^property (ushort|uint16) (diffuse_)?(red|green|blue)\s*$", re.MULTILINE)
_BROKEN = (ValueError, KeyError, IndexError, TypeError, AttributeError, ArithmeticError, OSError, struct.error)
COLORS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"))  # names that programs give them
UVS = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"))
GRAY = 0.8  # of a mesh without color, sRGB; as of an OBJ


def declared_faces(content: bytes) -> int:
    """Return the number of faces that the header of a PLY declares; 0 if there are none, as in splats."""
    found = _FACES.search(header_text(content))
    return int(found[1]) if found else 0


def texture_file(content: bytes) -> str | None:
    """Return the name of the texture of a PLY."""
    found = _TEXTURE.search(header_text(content))
    return found[1].decode("utf-8", "replace") if found else None


def _too_many(count: int, most: int, what: str) -> str:
    """Return the error message for too many faces or triangles."""
    return (
        f"the model has {count} {what}; asset.max_faces allows {most}: simplify it, or raise the limit with "
        f"--set asset.max_faces={count}"
    )


def read_ply_mesh(content: bytes, read: Read, decode: Decode, max_faces: int) -> Model:
    """Read a mesh.

    Args:
        content: of the file.
        read: reads files beside it.
        decode: decodes pictures; given the content and the name.
        max_faces: largest number of triangles.

    Raises:
        BadInput: the file is broken, has no or too many triangles, numbers that are not finite or colors of 16
            bits, or its texture is missing.
    """
    count = declared_faces(content)
    if count > max_faces:
        raise BadInput(_too_many(count, max_faces, "faces"))
    if _WIDE_COLORS.search(header_text(content)):
        raise BadInput("the PLY has colors of 16 bits; export it with colors of 8 bits, or as GLB")
    try:
        elements = read_elements(content, ("vertex", "face"))
        return single_precision([_part(elements, max_faces, texture_file(content), read, decode)])
    except _BROKEN as error:
        raise BadInput(f"the PLY cannot be read ({error}); export it again, or as GLB") from error


def _part(elements: dict[str, Element], max_faces: int, texture: str | None, read: Read, decode: Decode) -> ModelPart:
    vertex, face = elements.get("vertex", Element({}, {})).scalars, elements["face"]
    if missing := [name for name in ("x", "y", "z") if name not in vertex]:
        raise ValueError(f"its vertices lack {', '.join(missing)}")
    points = np.stack([vertex[name].astype(np.float64) for name in ("x", "y", "z")], 1)
    polygons = face.lists.get("vertex_indices") or face.lists.get("vertex_index")
    if polygons is None:
        raise ValueError("its faces lack vertex_indices")
    indices, counts = polygons.values.astype(np.int64), polygons.counts
    triangles = int((counts - 2).clip(0).sum())
    if not triangles:
        raise ValueError("it has no triangles")
    if triangles > max_faces:
        raise BadInput(_too_many(triangles, max_faces, "triangles"))
    if not 0 <= indices.min() <= indices.max() < len(points):
        raise ValueError(f"faces refer to vertices beyond its {len(points)}")
    uvs = _uvs(vertex, face, indices, counts)
    picture = read_texture((texture,) if texture is not None and uvs is not None else (), read, decode, {})
    colors = None if picture is not None else _colors(vertex, face, indices, counts)
    attributes = uvs if picture is not None else colors
    rows = indices[:, None] if attributes is None else np.concatenate([indices[:, None], attributes], 1)
    unique, index = np.unique(rows, axis=0, return_inverse=True)
    shade = 1.0 if attributes is not None else float(to_linear(np.array(GRAY)))
    return ModelPart(
        "model",
        points[unique[:, 0].astype(np.int64)],
        index.reshape(-1)[triangulate(points, indices, counts)],
        np.stack([unique[:, 1], 1 - unique[:, 2]], 1) if picture is not None else None,
        picture,
        (shade, shade, shade),
        None if colors is None else to_linear(unique[:, 1:]),
    )


def _uvs(
    vertex: dict[str, NDArray[Any]], face: Element, indices: NDArray[np.int64], counts: NDArray[np.int64]
) -> NDArray[np.float64] | None:
    """Return texture coordinates of every corner, v up: of the faces, or else of the vertices; None without any."""
    listed = face.lists.get("texcoord")
    if listed is not None and (listed.counts == 2 * counts).all():
        return listed.values.astype(np.float64).reshape(-1, 2)
    for names in UVS:
        if all(name in vertex for name in names):
            return np.stack([vertex[name].astype(np.float64) for name in names], 1)[indices]
    return None


def _colors(
    vertex: dict[str, NDArray[Any]], face: Element, indices: NDArray[np.int64], counts: NDArray[np.int64]
) -> NDArray[np.float64] | None:
    """Return the sRGB color of every corner, in [0, 1]: of the vertices, or else of the faces; None without any."""
    for names in COLORS:
        for scalars, of_corners in ((vertex, indices), (face.scalars, np.repeat(np.arange(len(counts)), counts))):
            if all(name in scalars for name in names):
                values = np.stack([scalars[name] for name in names], 1)
                is_share = values.dtype.kind == "f" and np.nanmax(values) <= FLOAT_COLORS
                shares = np.nan_to_num(values.astype(np.float64) / (1 if is_share else 255))
                return shares.clip(0, 1)[of_corners]
    return None
