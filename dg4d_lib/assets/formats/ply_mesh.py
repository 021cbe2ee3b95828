"""PLY meshes, ASCII or binary, with vertex colors, face colors or one texture; read by trimesh."""

import io
import re
import struct
from typing import Any

import numpy as np
import trimesh

from dg4d_lib.assets.formats.obj import Decode, Read, read_texture
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.ply import header_text
from dg4d_lib.mesh.models.model import Model, ModelPart, to_linear

_FACES = re.compile(rb"^element face (\d+)", re.MULTILINE)
_TEXTURE = re.compile(rb"^comment TextureFile\s+(.+?)\s*$", re.MULTILINE)
_WIDE_COLORS = re.compile(rb"^property (ushort|uint16) (red|green|blue)\s*$", re.MULTILINE)  # trimesh cuts them
_BROKEN = (ValueError, KeyError, IndexError, TypeError, AttributeError, ArithmeticError, OSError, struct.error)
GRAY = 0.8  # of a mesh without color, sRGB; as of an OBJ


def declared_faces(content: bytes) -> int:
    """Return the number of faces that the header of a PLY declares; 0 if there are none, as in splats."""
    found = _FACES.search(header_text(content))
    return int(found[1]) if found else 0


def texture_file(content: bytes) -> str | None:
    """Return the name of the texture of a PLY."""
    found = _TEXTURE.search(header_text(content))
    return found[1].decode("utf-8", "replace") if found else None


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
        raise BadInput(
            f"the model has {count} faces; asset.max_faces allows {max_faces}: simplify it, or raise the limit with "
            f"--set asset.max_faces={count}"
        )
    header = header_text(content)
    if _WIDE_COLORS.search(header):
        raise BadInput("the PLY has colors of 16 bits; export it with colors of 8 bits, or as GLB")
    try:
        mesh: Any = trimesh.load(
            io.BytesIO(header.replace(b"comment TextureFile", b"comment") + content[len(header) :]),
            file_type="ply",
            process=False,
        )
        if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
            raise ValueError("it has no triangles")
        if not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
            raise ValueError(f"faces refer to vertices beyond its {len(mesh.vertices)}")
        return Model((_part(mesh, texture_file(content), read, decode),))
    except _BROKEN as error:
        raise BadInput(f"the PLY cannot be read ({error}); export it again, or as GLB") from error


def _part(mesh: Any, texture: str | None, read: Read, decode: Decode) -> ModelPart:
    kind: str | None = mesh.visual.kind
    uvs: Any = getattr(mesh.visual, "uv", None)
    if kind == "face":
        mesh.unmerge_vertices()
    colors = to_linear(mesh.visual.vertex_colors[:, :3] / 255) if kind in ("vertex", "face") else None
    names = (texture,) if texture is not None and uvs is not None else ()
    picture = read_texture(names, read, decode, {})
    vertices = np.asarray(mesh.vertices, np.float32)
    if not np.isfinite(vertices).all():
        raise BadInput("the model has vertices that are not finite numbers (NaN or infinity); export it again")
    shade = 1.0 if picture is not None or colors is not None else float(to_linear(np.array(GRAY)))
    return ModelPart(
        "model",
        vertices,
        np.asarray(mesh.faces, np.int64),
        np.stack([uvs[:, 0], 1 - uvs[:, 1]], 1) if picture is not None else None,
        picture,
        (shade, shade, shade),
        colors,
    )
