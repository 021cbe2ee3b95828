"""Closed, colored surface inflated from a cut-out picture.

Two sheets over one triangulation of the silhouette, welded along the outline: the front one carries the picture, the
back one a guess. Both slide inwards along the rays of the input camera as they leave the plane z = 0: the front sheet
covers the picture exactly in the input view, and the back sheet its mirror image in the opposite view, unless it would
then show through a hole or a notch in the input view, where it slides inwards less.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor
from torch.nn.functional import normalize

from dg4d_lib.cameras.orbit import RADIUS
from dg4d_lib.errors import BadInput
from dg4d_lib.images import resize_planes
from dg4d_lib.inflation.colors import back_colors, front_colors
from dg4d_lib.inflation.heights import heights
from dg4d_lib.inflation.hints import NO_HINT, DepthHint, pixel_size
from dg4d_lib.inflation.mask import subject_mask
from dg4d_lib.inflation.relief import relief
from dg4d_lib.inflation.sheet import Sheet, triangulate

SLIDES = (0.75, 0.5, 0.25, 0.0)  # places tried for the back sheet, outmost first
CELLS = 1 << 10  # of a space-filling curve, per axis


@dataclass(frozen=True)
class InflatedSurface:
    """Closed triangle mesh with a color at every vertex.

    Attributes:
        vertices: world units.
        faces: indices into `vertices`, counter-clockwise seen from outside.
        colors: in [0, 1].
        seen: true for vertices that the picture shows; the others are guesses.
    """

    vertices: Float[Tensor, "v 3"]
    faces: Int[Tensor, "f 3"]
    colors: Float[Tensor, "v 3"]
    seen: Bool[Tensor, " v"]


def inflate(
    cutout: Float[Tensor, "h w 4"],
    size: int,
    hint: DepthHint = NO_HINT,
    disparity: Float[Tensor, "{size} {size}"] | None = None,
    depth_weight: float = 0.0,
) -> InflatedSurface:
    """Inflate the subject of a picture taken by the input camera (azimuth and elevation 0, radius 2).

    An opaque picture has no silhouette and becomes a slab.

    Args:
        cutout: square; straight alpha, color and alpha in [0, 1].
        size: pixels of a side at which the surface is built.
        hint: at the depth of the subject.
        disparity: estimated inverse depth of the picture, up to scale and offset; None: none.
        depth_weight: share of its relief that the surface takes on.

    Raises:
        BadInput: the picture is not square, or shows no subject.
    """
    if cutout.shape[0] != cutout.shape[1]:
        raise BadInput(f"a picture to inflate must be square; given {cutout.shape[1]} x {cutout.shape[0]} pixels")
    picture = resample(cutout, size).double().cpu().numpy()
    mask, alpha = subject_mask(picture[..., 3])
    pixel = pixel_size(size)
    bulge = heights(mask, pixel)
    middle, _ = hint.middle(size)
    if disparity is not None:
        middle = middle + relief(disparity.double().cpu().numpy(), middle + bulge, mask, depth_weight)
    front = front_colors(picture[..., :3], alpha, mask)
    sheet = triangulate(mask, alpha)
    return _two_sheets(
        sheet,
        sheet.at(bulge) * sheet.inside,
        sheet.at(middle),
        sheet.at(front),
        sheet.at(back_colors(front, mask)),
        pixel,
    )


def sample_surface(
    surface: InflatedSurface, count: int, generator: torch.Generator
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Float[Tensor, "n 3"], float]:
    """Sample points evenly over the area.

    The triangles are lined up along a space-filling curve and the line is cut into `count` pieces of equal area, each
    of which gets one point.

    Args:
        surface: mesh to sample.
        count: number of points n.
        generator: source of the place of each point in its piece.

    Returns:
        Points (world units), outward unit normals, colors in [0, 1], and the surface's area (world units squared).
    """
    corners = surface.vertices.double()[surface.faces]
    order = _curve_order(corners.mean(1))
    corners, colors = corners[order], surface.colors[surface.faces[order]]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    ends = torch.cumsum(normals.norm(dim=-1), 0)
    along, u, v = torch.rand(3, count, generator=generator, dtype=torch.float64)
    target = (torch.arange(count) + along) / count * ends[-1]
    face = torch.searchsorted(ends, target, right=True).clamp(max=len(ends) - 1)
    root = u.sqrt()
    weights = torch.stack([1 - root, root * (1 - v), root * v], -1)[..., None]
    return (
        (weights * corners[face]).sum(1).to(surface.vertices),
        normalize(normals[face], dim=-1).to(surface.vertices),
        (weights * colors[face]).sum(1).to(surface.colors),
        0.5 * ends[-1].item(),
    )


def resample(cutout: Float[Tensor, "h w 4"], size: int) -> Float[Tensor, "{size} {size} 4"]:
    """Resize a cut-out; the colors of transparent pixels do not bleed in."""
    if cutout.shape[0] == cutout.shape[1] == size:
        return cutout
    alpha = cutout[..., 3:]
    planes = torch.cat([cutout[..., :3] * alpha, alpha], -1).permute(2, 0, 1)[None]
    planes = resize_planes(planes, (size, size), "bicubic")[0].permute(1, 2, 0)
    return torch.cat([planes[..., :3] / planes[..., 3:].clamp(min=1e-4), planes[..., 3:]], -1).clamp(0, 1)


def _two_sheets(
    sheet: Sheet,
    bulge: Float64[np.ndarray, " k"],
    plane: Float64[np.ndarray, " k"],
    front: Float64[np.ndarray, "k 3"],
    back: Float64[np.ndarray, "k 3"],
    pixel: float,
) -> InflatedSurface:
    """Lift the sheet by `bulge` (world units, 0 on the outline) to both sides of `plane` and weld it at the outline."""
    ray = sheet.points * np.array([pixel, -pixel]) / RADIUS  # x and y per unit of distance from the camera's plane
    place = ray * (RADIUS - plane - bulge)[:, None]
    behind = np.flatnonzero(sheet.inside)
    far_place = ray * (RADIUS - plane + (2 * _hidden_share(sheet, plane, bulge) - 1) * bulge)[:, None]
    twin = np.arange(len(place))
    twin[behind] = len(place) + np.arange(len(behind))
    vertices = np.concatenate(
        [np.column_stack([place, plane + bulge]), np.column_stack([far_place, plane - bulge])[behind]]
    )
    faces = np.concatenate([sheet.triangles[:, ::-1], twin[sheet.triangles]])
    return InflatedSurface(
        vertices=torch.from_numpy(vertices).float(),
        faces=torch.from_numpy(faces),
        colors=torch.from_numpy(np.concatenate([front, back[behind]])).float(),
        seen=torch.arange(len(vertices)) < len(place),
    )


def _hidden_share(
    sheet: Sheet, plane: Float64[np.ndarray, " k"], bulge: Float64[np.ndarray, " k"]
) -> Float64[np.ndarray, " k"]:
    """Return the share by which the back sheet must stay out to be hidden: 0 as far in as the front, 1 on its ray."""
    share, hidden = np.ones(len(bulge)), np.ones(len(bulge), bool)
    for step in SLIDES:
        reach = (RADIUS - plane + (2 * step - 1) * bulge) / (RADIUS - plane + bulge)  # where the input view sees it
        hidden &= sheet.covers(sheet.points * reach[:, None])
        share[hidden] = step
    return share


def _curve_order(points: Float[Tensor, "n 3"]) -> Int[Tensor, " n"]:
    """Return the order of points along Morton's curve: near in the order is near in space."""
    low = points.amin(0)
    cell = ((points - low) / (points - low).amax().clamp(min=1e-9) * (CELLS - 1)).long()
    code = torch.zeros(len(points), dtype=torch.long, device=points.device)
    for bit in range(CELLS.bit_length() - 1):
        for axis in range(3):
            code |= (cell[:, axis] >> bit & 1) << (3 * bit + axis)
    return torch.argsort(code, stable=True)
