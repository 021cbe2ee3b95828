"""Scan-line rasterization in torch operations: runs on any device and defines the result of the CPU kernel.

The horizontal line through a row of pixel centers crosses two edges of a triangle or none; the triangle covers the
pixels whose centers lie between the crossings. A crossing is computed from its edge alone, upper end first, so adjacent
triangles compute the same number and no pixel between them is lost or drawn twice. A center on an edge belongs to the
triangle on its right, or below it. Along the line, 1/z is linear between the crossings, so it stays between the corner
values even in the thinnest triangle. All arithmetic is float64.

The nearest triangle of a pixel has the smallest 64-bit key: depth in the upper half, face index in the lower half.
"""

from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float, Float32, Float64, Int, Int32, Int64
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera, viewmats

NEAR = 0.2  # near plane, camera z in world units; a triangle with a nearer corner is not drawn
FAR_OFF = 1e9  # pixels from the image corner; a triangle with a corner this far away is not drawn
DEPTH_STEPS = 2**30  # depth levels from NEAR to infinity, uniform in 1/z; triangles in one level are equally near
EMPTY = 2**63 - 1  # key of a pixel without a triangle
AT_ONCE = 1 << 20  # triangle rows or pixels per chunk, about 100 bytes each; bounds memory


def rasterize(
    vertices: Float[Tensor, "*b v 3"], faces: Int[Tensor, "f 3"], cameras: Sequence[OrbitCamera]
) -> tuple[Int32[Tensor, "b h w"], Float32[Tensor, "b h w 3"], Float32[Tensor, "b h w"]]:
    """Return faces, barycentric coordinates and depth per pixel, as in `Fragments`."""
    size = cameras[0].height, cameras[0].width
    screen, faces = _project(vertices.detach(), cameras), faces.long()
    keys = torch.full((len(cameras) * size[0] * size[1],), EMPTY, device=screen.device)
    for view, face, row in _rows(screen, faces, size[0]):
        left, right = _crossings(screen[view[:, None], faces[face]], row)
        start, end = (torch.ceil((side[:, 0] - 0.5).clamp(0, size[1])).long() for side in (left, right))
        slope = (right[:, 1] - left[:, 1]) / (right[:, 0] - left[:, 0])  # infinite only where no pixel lies between
        for line, offset in _items(end - start):
            column = start[line] + offset
            near = left[line, 1] + (column + 0.5 - left[line, 0]) * slope[line]
            key = (((1 - NEAR * near) * DEPTH_STEPS).long() << 32) | face[line]
            keys.scatter_reduce_(0, (view[line] * size[0] + row[line]) * size[1] + column, key, "amin")
    return _resolve(screen, faces, keys.view(-1, *size))


def _project(vertices: Float[Tensor, "*b v 3"], cameras: Sequence[OrbitCamera]) -> Float64[Tensor, "b v 3"]:
    """Project every vertex for every camera to column, row and 1/z; zeros for vertices that cannot be drawn."""
    pose = viewmats(cameras).to(vertices.device)[..., None]
    focal = pose.new_tensor([camera.focal for camera in cameras])[:, None]
    a, b, c = vertices.double().unbind(-1)
    # Written out, because a matrix product may round equal vertices differently and open seams.
    x, y, z = (pose[:, i, 0] * a + pose[:, i, 1] * b + pose[:, i, 2] * c + pose[:, i, 3] for i in range(3))
    near = 1 / z
    column, row = 0.5 * cameras[0].width + focal * near * x, 0.5 * cameras[0].height + focal * near * y
    drawn = (z >= NEAR) & (column.abs() < FAR_OFF) & (row.abs() < FAR_OFF)  # False for NaN, too
    return torch.stack([torch.where(drawn, value, 0.0) for value in (column, row, near)], -1)


def _rows(
    screen: Float64[Tensor, "b v 3"], faces: Int64[Tensor, "f 3"], height: int
) -> Iterator[tuple[Int64[Tensor, " n"], Int64[Tensor, " n"], Int64[Tensor, " n"]]]:
    """Yield view, face and row of every triangle on every row it crosses."""
    lines = torch.ceil(screen[..., 1] - 0.5).long()[:, faces]  # first row below each corner
    first, last = lines.amin(-1).clamp(0, height), lines.amax(-1).clamp(0, height)
    drawn = (screen[..., 2] > 0)[:, faces].all(-1)
    for triangle, offset in _items(torch.where(drawn, last - first, 0).flatten()):
        view, face = triangle // len(faces), triangle % len(faces)
        yield view, face, first[view, face] + offset


def _items(counts: Int64[Tensor, " n"]) -> Iterator[tuple[Int64[Tensor, " m"], Int64[Tensor, " m"]]]:
    """Expand counts to items: yield each item's owner and its index within the owner, `AT_ONCE` at a time."""
    ends = counts.cumsum(0)
    total = int(counts.sum())
    for start in range(0, total, AT_ONCE):
        item = torch.arange(start, min(start + AT_ONCE, total), device=counts.device)
        owner = torch.searchsorted(ends, item, right=True)
        yield owner, item - (ends[owner] - counts[owner])


def _crossings(
    corners: Float64[Tensor, "n 3 3"], row: Int64[Tensor, " n"]
) -> tuple[Float64[Tensor, "n 2"], Float64[Tensor, "n 2"]]:
    """Return column and 1/z of the left and right crossing of a row with a triangle."""
    top, bottom = corners[..., 1].argmin(-1), corners[..., 1].argmax(-1)
    each = torch.arange(len(corners), device=corners.device)
    upper, middle, lower = corners[each, top], corners[each, 3 - top - bottom], corners[each, bottom]
    y = row.double() + 0.5
    below = (row >= torch.ceil(middle[:, 1] - 0.5))[:, None]  # below the middle corner
    long = _on_edge(upper, lower, y)
    short = _on_edge(torch.where(below, middle, upper), torch.where(below, lower, middle), y)
    swapped = (long[:, 0] > short[:, 0])[:, None]
    return torch.where(swapped, short, long), torch.where(swapped, long, short)


def _on_edge(
    upper: Float64[Tensor, "n 3"], lower: Float64[Tensor, "n 3"], y: Float64[Tensor, " n"]
) -> Float64[Tensor, "n 2"]:
    """Return column and 1/z of the point at height y on an edge."""
    slope = (lower[:, ::2] - upper[:, ::2]) * (1 / (lower[:, 1] - upper[:, 1]))[:, None]
    return upper[:, ::2] + (y - upper[:, 1])[:, None] * slope


def _resolve(
    screen: Float64[Tensor, "b v 3"], faces: Int64[Tensor, "f 3"], keys: Int64[Tensor, "b h w"]
) -> tuple[Int32[Tensor, "b h w"], Float32[Tensor, "b h w 3"], Float32[Tensor, "b h w"]]:
    """Decode the keys to faces, perspective-correct barycentrics and depth of the nearest triangles."""
    found = keys < EMPTY
    ids = torch.where(found, keys & 0xFFFFFFFF, -1).int()
    weights = torch.zeros(*keys.shape, 3, device=keys.device)
    depth = torch.zeros(keys.shape, device=keys.device)
    for pixels in found.nonzero().split(AT_ONCE):
        view, row, column = pixels.unbind(1)
        corners = screen[view[:, None], faces[ids[view, row, column].long()]]
        xa, xb, xc = (corners[..., 0] - (column[:, None] + 0.5)).T
        ya, yb, yc = (corners[..., 1] - (row[:, None] + 0.5)).T
        areas = torch.stack([xb * yc - xc * yb, xc * ya - xa * yc, xa * yb - xb * ya], -1)
        areas = (areas * areas.sum(-1, keepdim=True).sign()).clamp_min(0)
        areas = torch.where(areas.sum(-1, keepdim=True) > 0, areas, 1.0)  # edge-on triangle
        shares = areas * corners[..., 2]
        total = shares.sum(-1)
        weights[view, row, column] = (shares / total[:, None]).float()
        depth[view, row, column] = (areas.sum(-1) / total).float()
    return ids, weights, depth
