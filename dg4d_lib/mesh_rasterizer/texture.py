"""What pixels read from a texture: trilinear between mip levels, each half as wide as the one before.

Where a mesh lies in its pictures does not depend on its texture, so `look_up` is called once, and `read` as often as
the texture changes. The covered pixels of all pictures are one list with one texture: a texture per picture would have
a gradient of its size per picture.

The mip level of a pixel lets it read as wide a spot as it sees. A square of side w has the variance w^2 / 12 along both
axes; reading texels of width w bilinearly has w^2 / 12 + w^2 / 6 = w^2 / 4. So texels are 1 / sqrt(3) of the pixel's
side on the texture (of the root mean square of its two sides: the texture is inclined).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64, Int, Int64
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, grid_sample

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.mesh_rasterizer.zbuffer import Fragments


@dataclass(frozen=True)
class Taps:
    """Which pixels read one mip level, where, and how much.

    Attributes:
        pixels: places in the list of covered pixels, ascending.
        places: on the texture, in [0, 1], u right and v down.
        shares: of what the pixel sees, in (0, 1]; a pixel's shares have the sum 1.
    """

    pixels: Int64[Tensor, " n"]
    places: Float[Tensor, "n 2"]
    shares: Float[Tensor, " n"]


@dataclass(frozen=True)
class Lookup:
    """Where the covered pixels of b pictures look into a texture.

    Attributes:
        covered: pixels that see the mesh; their list is in the order of `covered.nonzero()`.
        levels: taps of every mip level, from the texture itself to the smallest that is read.
    """

    covered: Bool[Tensor, "b h w"]
    levels: tuple[Taps, ...]


def look_up(
    vertices: Float[Tensor, "*b v 3"],
    faces: Int[Tensor, "f 3"],
    uvs: Float[Tensor, "v 2"],
    size: Sequence[int],
    cameras: Sequence[OrbitCamera],
    fragments: Fragments,
) -> Lookup:
    """Where the pixels of drawings look into a texture.

    Args:
        vertices: as they were drawn.
        faces: as they were drawn.
        uvs: texture coordinates in [0, 1], u right and v down.
        size: height and width of the texture, texels.
        cameras: the b cameras that drew.
        fragments: what they drew.
    """
    covered, indices, texels = fragments.faces >= 0, faces.long(), uvs.new_tensor((size[1], size[0]))
    places, levels = [], []
    for view, camera in enumerate(cameras):
        seen, state = covered[view], vertices if vertices.ndim == 2 else vertices[view]
        corners = indices[fragments.faces[view][seen].long()]
        ends = uvs[corners].double()
        place = (fragments.barycentrics[view][seen][..., None].double() * ends).sum(1)
        sides = _slopes(state.detach(), camera, corners, seen, ends - place[:, None]) * texels
        places.append(place.float())
        levels.append(0.5 * (sides.square().sum((1, 2)) / 2 / 3).log2())
    smallest = (max(size) - 1).bit_length()  # of one texel
    level = torch.cat(levels).nan_to_num(0).clamp(0, smallest)  # not a number in a triangle that is seen edge on
    return Lookup(covered, tuple(_taps(torch.cat(places), level.float())))


def read(texture: Float[Tensor, "h w c"], lookup: Lookup) -> Float[Tensor, "p c"]:
    """What the covered pixels see of a texture, one after the other; differentiable in the texture."""
    seen = texture.new_zeros((int(lookup.covered.sum()), texture.shape[-1]))
    for taps, picture in zip(lookup.levels, _pyramid(texture), strict=False):
        seen.index_add_(0, taps.pixels, taps.shares[:, None].to(texture) * bilinear(picture, taps.places))
    return seen


def bilinear(picture: Float[Tensor, "h w c"], places: Float[Tensor, "n 2"]) -> Float[Tensor, "n c"]:
    """Samples of a picture at places in [0, 1], u right and v down; its border goes on outside."""
    grid = (2 * places - 1).to(picture)[None, None]
    return grid_sample(picture.movedim(-1, 0)[None], grid, align_corners=False, padding_mode="border")[0, :, 0].T


def _slopes(
    vertices: Float[Tensor, "v 3"],
    camera: OrbitCamera,
    corners: Int64[Tensor, "p 3"],
    seen: Bool[Tensor, "h w"],
    relative: Float64[Tensor, "p 3 2"],
) -> Float64[Tensor, "p 2 2"]:
    """Change of the place on the texture per column and per row of the picture.

    A ray r meets the plane of the corners a, b, c (camera axes) where their weights are r.(b x c), r.(c x a) and
    r.(a x b), divided by their sum; a column or a row more adds 1 / focal to x or y of the ray.

    Args:
        vertices: world units.
        camera: that drew.
        corners: vertices of the triangle that each pixel sees.
        seen: these pixels.
        relative: places of the corners minus the place of the pixel.
    """
    pose = camera.world_to_camera().to(vertices.device)
    a, b, c = (vertices.double() @ pose[:3, :3].T + pose[:3, 3])[corners].unbind(1)
    normals = torch.stack([b.cross(c, dim=-1), c.cross(a, dim=-1), a.cross(b, dim=-1)], 1)  # pixel, corner, axis
    row, column = (index.double() + 0.5 for index in seen.nonzero().T)
    x, y = (column - 0.5 * camera.width) / camera.focal, (row - 0.5 * camera.height) / camera.focal
    total = (normals * torch.stack([x, y, torch.ones_like(x)], -1)[:, None]).sum((1, 2))
    return normals[..., :2].mT @ relative / (camera.focal * total)[:, None, None]


def _taps(places: Float[Tensor, "p 2"], levels: Float[Tensor, " p"]) -> Iterator[Taps]:
    for level in range(int(levels.max().ceil()) + 1 if len(levels) else 0):
        shares = 1 - (levels - level).abs()
        pixels = (shares > 0).nonzero()[:, 0]
        yield Taps(pixels, places[pixels], shares[pixels])


def _pyramid(texture: Float[Tensor, "h w c"]) -> Iterator[Float[Tensor, "i j c"]]:
    """The texture, its half, and so on; a texel of a half is the mean of two by two, or of more where a side is odd."""
    picture = texture.movedim(-1, 0)
    while True:
        yield picture.movedim(0, -1)
        picture = adaptive_avg_pool2d(picture, (-(-picture.shape[1] // 2), -(-picture.shape[2] // 2)))
