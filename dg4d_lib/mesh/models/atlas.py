"""One texture for all parts of a model, for viewers and formats that take one.

Textures become tiles of a grid, multiplied by the mean vertex color of their part: colors that vary within a textured
part are lost. Parts without texture get two by two texels per triangle, whose bilinear interpolation inside the
triangle is the linear one of its corners.
"""

import math

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from PIL import Image
from torch import Tensor

from dg4d_lib.mesh.models.model import Model, ModelPart, to_linear, to_srgb
from dg4d_lib.mesh.textured import TexturedMesh

MOST_REPEATS = 4  # repetitions of a texture in its tile, per side
GUTTER = 4  # texels of a tile that repeat its border
BLOCK = 2  # texels per side of the colors of a triangle


def merge_parts(model: Model, texture_size: int) -> tuple[TexturedMesh, Int[Tensor, " w"]]:
    """Return the model as one mesh, and the vertex of the model that each of its vertices copies.

    Args:
        model: parts with materials.
        texture_size: largest side of the texture; a single texture keeps its own size below that.
    """
    textured = [part for part in model.parts if _has_tile(part)]
    columns = max(1, math.ceil(math.sqrt(len(textured))))
    blocks = sum(len(part.faces) for part in model.parts if not _has_tile(part))
    rows = math.ceil(len(textured) / columns)
    largest = max((max(part.texture.shape[:2]) for part in textured if part.texture is not None), default=1)
    tile = min(texture_size // columns, max(largest, 16) + 2 * GUTTER) if textured else 0
    width = max(columns * tile, BLOCK * math.ceil(math.sqrt(blocks)), 16)
    per_row = width // BLOCK
    height = rows * tile + BLOCK * math.ceil(blocks / per_row)
    picture = np.full((max(height, 16), width, 3), 128, np.uint8)
    pieces, starts = {}, np.cumsum([0, *(len(part.vertices) for part in model.parts)])
    number, block = 0, 0
    for index, part in enumerate(model.parts):
        if _has_tile(part):
            corner = np.array([number % columns, number // columns]) * tile
            pieces[index] = _textured(part, picture, corner, tile)
            number += 1
        else:
            places = block + np.arange(len(part.faces))
            origin = np.stack([places % per_row * BLOCK, rows * tile + places // per_row * BLOCK], 1)
            pieces[index] = _plain(part, picture, origin)
            block += len(part.faces)
    sources, faces, uvs, count = [], [], [], 0
    for index in range(len(model.parts)):
        source, face, uv = pieces[index]
        sources.append(source + starts[index])
        faces.append(face + count)
        uvs.append(uv / (picture.shape[1], picture.shape[0]))
        count += len(source)
    order = torch.from_numpy(np.concatenate(sources))
    vertices = torch.from_numpy(model.vertices.astype(np.float32))[order]
    mesh = TexturedMesh(
        vertices,
        torch.from_numpy(np.concatenate(faces)),
        torch.from_numpy(np.concatenate(uvs).astype(np.float32)),
        torch.from_numpy(picture).float() / 255,
    )
    return mesh, order


def _has_tile(part: ModelPart) -> bool:
    return part.texture is not None and part.uvs is not None


Piece = tuple[Int[np.ndarray, " vertices"], Int[np.ndarray, "triangles 3"], Float[np.ndarray, "vertices 2"]]


def _textured(part: ModelPart, picture: UInt8[np.ndarray, "h w 3"], corner: Int[np.ndarray, " 2"], tile: int) -> Piece:
    """Draw the texture of a part into its tile; return vertices, triangles and texels of the vertices.

    The mean of the vertex colors multiplies the texture.
    """
    assert part.texture is not None and part.uvs is not None  # the caller has looked
    uvs = part.uvs[part.faces]  # f 3 2
    cell = np.floor(uvs.min(1) + 1e-6)
    local = uvs - cell[:, None]
    repeats = int(np.clip(np.ceil(local.max() - 1e-3), 1, MOST_REPEATS))
    inner = tile - 2 * GUTTER
    factor = np.array(part.factor)
    if part.colors is not None:
        factor = factor * part.colors[part.faces].mean((0, 1))
    pixels = to_srgb(to_linear(part.texture[..., :3] / 255) * factor)
    small = np.array(
        Image.fromarray((255 * pixels).round().astype(np.uint8)).resize(
            (max(1, inner // repeats),) * 2, Image.Resampling.BOX
        )
    )
    tiled = np.tile(small, (repeats, repeats, 1))
    side = len(tiled)
    padded = np.pad(tiled, ((GUTTER, tile - GUTTER - side), (GUTTER, tile - GUTTER - side), (0, 0)), mode="wrap")
    x, y = corner
    picture[y : y + tile, x : x + tile] = padded
    texels = np.minimum(local / repeats, 1) * side + GUTTER + corner
    keys = np.concatenate([part.faces.reshape(-1, 1), cell.repeat(3, 0)], 1)
    unique, first, index = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return unique[:, 0].astype(np.int64), index.reshape(-1, 3), texels.reshape(-1, 2)[first]


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
