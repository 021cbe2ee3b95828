"""Textures of parts as tiles of one picture: wrap modes, repetitions and cut-outs."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from PIL import Image
from scipy import ndimage

from dg4d_lib.mesh.models.model import OPAQUE, ModelPart, to_linear, to_srgb

MOST_REPEATS = 4  # repetitions of a texture in its tile, per side
CLAMPED = (-1.0, 2.0)  # texture coordinates around a clamped texture in its tile, per side
GUTTER = 4  # texels of a tile around the region that its triangles show
SMALLEST_TILE = 2 * GUTTER + 2 * MOST_REPEATS  # texels per side
MOST_BLOCKS = 256  # per side of a texture, of texels that are searched for opaque ones together
SLACK = 1e-3  # rounding tolerance, share of a repetition


def split_by_tile(part: ModelPart) -> list[ModelPart]:
    """Return a part as two: triangles that its tile can show, and the others in the mean color of its texture.

    Triangles without an opaque texel are left out. Parts without a texture are returned as they are.
    """
    if part.texture is None or part.uvs is None:
        return [part]
    local = local_uvs(part)
    low = np.array([CLAMPED[0] if not mode.period else 0.0 for mode in part.wrap])
    high = np.array([CLAMPED[1] if not mode.period else MOST_REPEATS for mode in part.wrap])
    fits = ((local.min(1) >= low - SLACK) & (local.max(1) <= high + SLACK)).all(1)
    found = []
    if fits.any():
        near = replace(part, faces=part.faces[fits])
        found.append(replace(near, faces=near.faces[_shown(near)]))
    if not fits.all() and (mean := _mean(part)) is not None:
        red, green, blue = map(float, np.array(part.factor) * mean)
        found.append(
            replace(part, faces=part.faces[~fits], uvs=None, texture=None, factor=(red, green, blue), masked=False)
        )
    return [one for one in found if len(one.faces)]


def local_uvs(part: ModelPart) -> Float[np.ndarray, "f 3 2"]:
    """Return texture coordinates of the corners of triangles that show the same, as close to the origin as possible."""
    assert part.uvs is not None  # the caller has looked
    local = part.uvs[part.faces].astype(np.float64)
    for axis, mode in enumerate(part.wrap):
        low, high = local[..., axis].min(1), local[..., axis].max(1)
        if mode.period:
            local[..., axis] -= mode.period * np.floor(low / mode.period + 1e-6)[:, None]
        else:
            outside = (low >= 1) | (high <= 0)
            local[outside, :, axis] = local[outside, :, axis].clip(0, 1)
    return local


def full_size(part: ModelPart) -> int:
    """Return the texels per side that the repetitions of a part's texture have at its own size."""
    assert part.texture is not None  # the caller has looked
    low, high = _window(local_uvs(part))
    return int(((high - low) * part.texture.shape[1::-1]).max())


def draw_tile(part: ModelPart, size: int) -> tuple[UInt8[np.ndarray, "s s 3"], Float[np.ndarray, "f 3 2"]]:
    """Draw the texture of a part; return it with the texels at the corners of the triangles, x and y.

    The mean of the vertex colors multiplies the texture. Texels that are cut out have the color of the nearest one
    that is not.

    Args:
        part: of `split_by_tile`, with texture.
        size: texels per side.
    """
    assert part.texture is not None  # the caller has looked
    local = local_uvs(part)
    low, high = _window(local)
    sides = ((size - 2 * GUTTER) // (high - low)).clip(1)
    factor = np.array(part.factor)
    if part.colors is not None:
        factor = factor * part.colors[part.faces].mean((0, 1))
    given = part.texture if part.masked else part.texture[..., :3]
    small = np.array(Image.fromarray(given).resize((int(sides[0]), int(sides[1])), Image.Resampling.BOX))
    if part.masked:  # Pillow weights colors by alpha
        alpha = small[..., 3]
        holes = alpha < min(OPAQUE, int(alpha.max()))
        rows, columns = ndimage.distance_transform_edt(holes, return_distances=False, return_indices=True)
        small = small[rows, columns, :3]
    colors = (255 * to_srgb(to_linear(small / 255) * factor)).round().astype(np.uint8)
    across, down = (
        mode.texels(np.arange(size) + start * side - GUTTER, side)
        for mode, start, side in zip(part.wrap, low, map(int, sides), strict=True)
    )
    return colors[down][:, across], (local - low) * sides + GUTTER


def _window(local: Float[np.ndarray, "f 3 2"]) -> tuple[Int[np.ndarray, " 2"], Int[np.ndarray, " 2"]]:
    """Return the first repetition along u and v that triangles show, and the one after the last."""
    low = np.floor(local.min((0, 1)) + SLACK).astype(np.int64)
    return low, np.maximum(low + 1, np.ceil(local.max((0, 1)) - SLACK).astype(np.int64))


def _shown(part: ModelPart) -> Bool[np.ndarray, " f"]:
    """Return which triangles may show an opaque texel: one in the box around their texture coordinates."""
    if part.texture is None or not part.masked:
        return np.ones(len(part.faces), bool)
    local = local_uvs(part)
    low, high = _window(local)
    opaque = part.texture[..., 3] >= OPAQUE
    for axis, length in enumerate(opaque.shape):
        starts = np.arange(min(length, MOST_BLOCKS)) * length // min(length, MOST_BLOCKS)
        opaque = np.logical_or.reduceat(opaque, starts, axis)
    blocks = np.array(opaque.shape[::-1])  # along u and v
    across, down = (
        mode.texels(np.arange(first * count, last * count), int(count))
        for mode, first, last, count in zip(part.wrap, low, high, blocks, strict=True)
    )
    total = np.pad(opaque[down][:, across].cumsum(0).cumsum(1), ((1, 0), (1, 0)))  # in the box from the origin
    span = (high - low) * blocks
    start = np.floor((local.min(1) - low) * blocks + SLACK).astype(np.int64).clip(0, span - 1)
    stop = np.ceil((local.max(1) - low) * blocks - SLACK).astype(np.int64).clip(start + 1, span)
    inside = total[stop[:, 1], stop[:, 0]] - total[start[:, 1], stop[:, 0]]
    return inside - total[stop[:, 1], start[:, 0]] + total[start[:, 1], start[:, 0]] > 0


def _mean(part: ModelPart) -> Float[np.ndarray, " 3"] | None:
    """Return the mean of a texture's visible texels, linear; None if none is visible."""
    assert part.texture is not None  # the caller has looked
    visible = part.texture[part.texture[..., 3] >= OPAQUE] if part.masked else part.texture.reshape(-1, 4)
    if not len(visible):
        return None
    levels = to_linear(np.arange(256) / 255)
    return np.array([np.bincount(visible[:, channel], minlength=256) @ levels for channel in range(3)]) / len(visible)
