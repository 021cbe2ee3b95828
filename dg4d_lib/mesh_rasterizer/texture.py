"""Texture sampling: trilinear between mip levels, each half as wide as the previous one.

The sampling positions do not depend on the texture, so `build_lookup` runs once and `sample_texture` as often as the
texture changes. The covered pixels of all images form one list and read one texture: a texture per image would need a
full-size gradient per image.

The mip level is chosen so that a pixel averages the area it covers. A square of side w has the variance w^2 / 12 along
both axes; reading texels of width w bilinearly has w^2 / 12 + w^2 / 6 = w^2 / 4. So the texel width is 1 / sqrt(3) of
the side of the pixel's footprint on the texture (the root mean square of its two sides, as the surface may be tilted).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float32, Float64, Int, Int64
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, grid_sample

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.mesh_rasterizer import texture_cpu
from dg4d_lib.mesh_rasterizer.zbuffer import Fragments


@dataclass(frozen=True)
class Taps:
    """Samples of one mip level.

    Attributes:
        pixels: indices into the list of covered pixels, ascending.
        uvs: texture coordinates in [0, 1], u right and v down.
        weights: of the sample in its pixel, in (0, 1]; the weights of a pixel sum to 1.
    """

    pixels: Int64[Tensor, " n"]
    uvs: Float[Tensor, "n 2"]
    weights: Float[Tensor, " n"]


@dataclass(frozen=True)
class TextureLookup:
    """Texture samples of the covered pixels of b images.

    Attributes:
        covered: pixels that show the mesh; listed in the order of `covered.nonzero()`.
        levels: taps of every mip level, from full resolution to the smallest level that is read.
    """

    covered: Bool[Tensor, "b h w"]
    levels: tuple[Taps, ...]


def build_lookup(
    vertices: Float[Tensor, "*b v 3"],
    faces: Int[Tensor, "f 3"],
    uvs: Float[Tensor, "v 2"],
    size: Sequence[int],
    cameras: Sequence[OrbitCamera],
    fragments: Fragments,
) -> TextureLookup:
    """Compute texture coordinates and mip levels of all covered pixels.

    Args:
        vertices: the vertices that were rasterized.
        faces: the faces that were rasterized.
        uvs: texture coordinates in [0, 1], u right and v down.
        size: height and width of the texture, texels.
        cameras: the b cameras of the fragments.
        fragments: output of the rasterizer.
    """
    covered = fragments.faces >= 0
    places = texture_cpu.texture_places if vertices.device.type == "cpu" else texture_places
    uv, level = places(texture_cpu.Rasterized(vertices, faces, uvs, cameras, fragments), size)
    coarsest = (max(size) - 1).bit_length()  # level of a single texel
    level = level.nan_to_num(0).clamp(0, coarsest)  # NaN in edge-on triangles
    return TextureLookup(covered, tuple(_taps(uv, level)))


def sample_texture(texture: Float[Tensor, "h w c"], lookup: TextureLookup) -> Float[Tensor, "p c"]:
    """Sample a texture at all covered pixels, in the order of the list; differentiable in the texture."""
    values = texture.new_zeros((int(lookup.covered.sum()), texture.shape[-1]))
    for taps, mip in zip(lookup.levels, _mip_levels(texture), strict=False):
        values.index_add_(0, taps.pixels, taps.weights[:, None].to(texture) * sample_bilinear(mip, taps.uvs))
    return values


def sample_bilinear(image: Float[Tensor, "h w c"], uvs: Float[Tensor, "n 2"]) -> Float[Tensor, "n c"]:
    """Sample an image bilinearly at coordinates in [0, 1], u right and v down; clamped at the border."""
    grid = (2 * uvs - 1).to(image)[None, None]
    return grid_sample(image.movedim(-1, 0)[None], grid, align_corners=False, padding_mode="border")[0, :, 0].T


def texture_places(
    rasterized: texture_cpu.Rasterized, size: Sequence[int]
) -> tuple[Float32[Tensor, "p 2"], Float32[Tensor, " p"]]:
    """Return texture coordinates and mip levels of all covered pixels, for a texture of that height and width."""
    vertices, faces, uvs, cameras, fragments = rasterized
    covered, indices, texels = fragments.faces >= 0, faces.long(), uvs.new_tensor((size[1], size[0]))
    pixel_uvs, levels = [], []
    for view, camera in enumerate(cameras):
        seen, state = covered[view], vertices if vertices.ndim == 2 else vertices[view]
        corners = indices[fragments.faces[view][seen].long()]
        corner_uvs = uvs[corners].double()
        uv = (fragments.barycentrics[view][seen][..., None].double() * corner_uvs).sum(1)
        sides = _uv_slopes(state.detach(), camera, corners, seen, corner_uvs - uv[:, None]) * texels
        pixel_uvs.append(uv.float())
        levels.append((0.5 * (sides.square().sum((1, 2)) / 2 / 3).log2()).float())
    return torch.cat(pixel_uvs), torch.cat(levels)


def _uv_slopes(
    vertices: Float[Tensor, "v 3"],
    camera: OrbitCamera,
    corners: Int64[Tensor, "p 3"],
    seen: Bool[Tensor, "h w"],
    relative: Float64[Tensor, "p 3 2"],
) -> Float64[Tensor, "p 2 2"]:
    """Return the change of the texture coordinates per column and per row of the image.

    A ray r meets the plane of the corners a, b, c (camera axes) where their weights are r.(b x c), r.(c x a) and
    r.(a x b), divided by their sum; one column or row more adds 1 / focal to x or y of the ray.

    Args:
        vertices: world units.
        camera: of this image.
        corners: vertices of the triangle that each pixel shows.
        seen: the covered pixels.
        relative: texture coordinates of the corners minus those of the pixel.
    """
    viewmat = camera.viewmat().to(vertices.device)
    a, b, c = (vertices.double() @ viewmat[:3, :3].T + viewmat[:3, 3])[corners].unbind(1)
    normals = torch.stack([b.cross(c, dim=-1), c.cross(a, dim=-1), a.cross(b, dim=-1)], 1)  # pixel, corner, axis
    row, column = (index.double() + 0.5 for index in seen.nonzero().T)
    x, y = (column - 0.5 * camera.width) / camera.focal, (row - 0.5 * camera.height) / camera.focal
    total = (normals * torch.stack([x, y, torch.ones_like(x)], -1)[:, None]).sum((1, 2))
    return normals[..., :2].mT @ relative / (camera.focal * total)[:, None, None]


def _taps(uvs: Float[Tensor, "p 2"], levels: Float[Tensor, " p"]) -> Iterator[Taps]:
    lower, upper = (rounded.to(torch.int8) for rounded in (levels.floor(), levels.ceil()))
    for level in range(int(upper.max()) + 1 if len(levels) else 0):
        pixels = ((lower == level) | (upper == level)).nonzero()[:, 0]
        yield Taps(pixels, uvs[pixels], 1 - (levels[pixels] - level).abs())


def _mip_levels(texture: Float[Tensor, "h w c"]) -> Iterator[Float[Tensor, "i j c"]]:
    """Yield the texture and its halvings; a texel averages 2 x 2 texels, or more where a side is odd."""
    mip = texture.movedim(-1, 0)
    while True:
        yield mip.movedim(0, -1)
        mip = adaptive_avg_pool2d(mip, (-(-mip.shape[1] // 2), -(-mip.shape[2] // 2)))
