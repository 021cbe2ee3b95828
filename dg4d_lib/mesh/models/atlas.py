"""One texture for all parts of a model, for viewers and formats that take one.

Textures become tiles of a grid, multiplied by the mean vertex color of their part: colors that vary within a textured
part are lost. Triangles that repeat a texture more often than a tile does have its mean color, and those that a mask
hides are left out. Parts without texture get two by two texels per triangle, whose bilinear interpolation inside the
triangle is the linear one of its corners.
"""

import math

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.mesh.models.model import TRANSPARENT, Model, ModelPart
from dg4d_lib.mesh.models.tiles import GUTTER, SMALLEST_TILE, draw_tile, full_size, split_by_tile
from dg4d_lib.mesh.textured import TexturedMesh

BLOCK = 2  # texels per side of the colors of a triangle


def merge_parts(model: Model, texture_size: int) -> tuple[TexturedMesh, Int[Tensor, " w"]]:
    """Return the model as one mesh, and the vertex of the model that each of its vertices copies.

    Args:
        model: parts with materials.
        texture_size: largest side of the texture, unless it has many tiles or plain triangles; a single texture, with
            its repetitions, keeps its own size below that.

    Raises:
        BadInput: masks hide all triangles.
    """
    starts = np.cumsum([0, *(len(part.vertices) for part in model.parts)])
    parts = [(one, start) for part, start in zip(model.parts, starts, strict=False) for one in split_by_tile(part)]
    if not parts:
        raise BadInput(TRANSPARENT)
    textured = [part for part, _ in parts if _has_tile(part)]
    columns = max(1, math.ceil(math.sqrt(len(textured))))
    blocks = sum(len(part.faces) for part, _ in parts if not _has_tile(part))
    rows = math.ceil(len(textured) / columns)
    largest = max(map(full_size, textured), default=1)
    tile = max(min(texture_size // columns, max(largest, 16) + 2 * GUTTER), SMALLEST_TILE) if textured else 0
    width = max(columns * tile, BLOCK * math.ceil(math.sqrt(blocks)), 16)
    per_row = width // BLOCK
    height = rows * tile + BLOCK * math.ceil(blocks / per_row)
    picture = np.full((max(height, 16), width, 3), 128, np.uint8)
    pieces: list[Piece] = []
    number, block = 0, 0
    for part, _ in parts:
        if _has_tile(part):
            corner = np.array([number % columns, number // columns]) * tile
            pieces.append(_textured(part, picture, corner, tile))
            number += 1
        else:
            places = block + np.arange(len(part.faces))
            origin = np.stack([places % per_row * BLOCK, rows * tile + places // per_row * BLOCK], 1)
            pieces.append(_plain(part, picture, origin))
            block += len(part.faces)
    sources, faces, uvs, count = [], [], [], 0
    for (source, face, uv), (_, start) in zip(pieces, parts, strict=True):
        sources.append(source + start)
        faces.append(face + count)
        uvs.append(uv / (picture.shape[1], picture.shape[0]))
        count += len(source)
    order = torch.from_numpy(np.concatenate(sources))
    vertices = torch.from_numpy(model.vertices.astype(np.float32))[order]
    groups = model.smoothing_groups
    mesh = TexturedMesh(
        vertices,
        torch.from_numpy(np.concatenate(faces)),
        torch.from_numpy(np.concatenate(uvs).astype(np.float32)),
        torch.from_numpy(picture).float() / 255,
        None if groups is None else torch.from_numpy(groups)[order],
    )
    return mesh, order


def _has_tile(part: ModelPart) -> bool:
    return part.texture is not None and part.uvs is not None


Piece = tuple[Int[np.ndarray, " vertices"], Int[np.ndarray, "triangles 3"], Float[np.ndarray, "vertices 2"]]


def _textured(part: ModelPart, picture: UInt8[np.ndarray, "h w 3"], corner: Int[np.ndarray, " 2"], tile: int) -> Piece:
    """Draw the texture of a part into its tile; return vertices, triangles and texels of the vertices."""
    x, y = corner
    picture[y : y + tile, x : x + tile], texels = draw_tile(part, tile)
    keys = np.concatenate([part.faces[..., None], texels], -1).reshape(-1, 3)
    unique, first, index = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return unique[:, 0].astype(np.int64), index.reshape(-1, 3), texels.reshape(-1, 2)[first] + corner


def _plain(part: ModelPart, picture: UInt8[np.ndarray, "h w 3"], origin: Int[np.ndarray, "f 2"]) -> Piece:
    """Draw the corner colors of every triangle; return vertices, triangles and texels of the vertices."""
    corners = np.repeat(np.eye(3)[None], len(part.faces), 0)
    ids = np.arange(len(part.faces))
    colors = np.stack([part.sample(ids, corners[:, k])[0] for k in range(3)], 1)  # f 3 3
    fourth = (colors[:, 1] + colors[:, 2] - colors[:, 0]).clip(0, 1)
    for (dx, dy), color in zip(((0, 0), (1, 0), (0, 1), (1, 1)), (*colors.transpose(1, 0, 2), fourth), strict=True):
        picture[origin[:, 1] + dy, origin[:, 0] + dx] = (255 * color).round().astype(np.uint8)
    texels = origin[:, None] + 0.5 + np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)])
    return part.faces.ravel(), np.arange(3 * len(part.faces)).reshape(-1, 3), texels.reshape(-1, 2)
