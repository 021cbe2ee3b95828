"""Image warping with a triangle grid over a cut-out picture.

Every output pixel looks up its source position in the picture, so edges come from the picture's alpha, not from the
grid, and soft edges such as hair stay soft.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from scipy import ndimage

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.inflation.mask import subject_mask
from dg4d_lib.mesh_rasterizer.zbuffer import interpolate, rasterize_mesh

CELLS = 64  # grid cells along the picture's height
SMALLEST_CELL = 3  # pixels
FAINT = 0.02  # alpha above which the grid covers a pixel
MARGIN = 4  # width of the grid's margin around these pixels, pixels
OFF_CENTER = 1e-3  # shift that keeps the grid's edges off the pixel centers, pixels
BORDER = 8  # edge padding for spline interpolation, pixels
TRANSPARENT, OPAQUE = 2 / 255, 253 / 255  # alpha outside is rounded to 0 or 1, because splines ring
TORN = 1.6  # ratio of a side to its rest length, or inverse, beyond which the triangle only bridges a gap
FOOT = 0.08  # height of the feet relative to the subject; their mean x is the standing point


@dataclass(frozen=True)
class SubjectBounds:
    """Bounding box and standing point of the subject, pixels, x right and y down.

    Attributes:
        left: left edge.
        right: right edge.
        top: upper edge.
        bottom: lower edge, at the feet.
        middle: mean x of the subject.
        foot: mean x of the feet.
        cropped: True if the subject is cut off at the lower border of the picture.
    """

    left: float
    right: float
    top: float
    bottom: float
    middle: float
    foot: float
    cropped: bool

    @property
    def height(self) -> float:
        """Height of the bounding box, pixels."""
        return self.bottom - self.top

    @property
    def width(self) -> float:
        """Width of the bounding box, pixels."""
        return self.right - self.left


class Puppet:
    """Triangle grid over a picture, for drawing it deformed.

    Attributes:
        mask: the subject's pixels.
        bounds: bounding box and standing point of the subject.
        nodes: x and y at rest, pixels.
        triangles: indices into the nodes; the two halves of cell i are i and i + half of their number.
        cell: distance of nodes, pixels.
    """

    def __init__(self, picture: Float64[np.ndarray, "h w 4"]) -> None:
        """Build the grid over a picture (straight alpha, in [0, 1]).

        Raises:
            BadInput: the picture shows no subject.
        """
        alpha = picture[..., 3:]
        self.mask, _ = subject_mask(picture[..., 3])
        self.bounds = _measure(self.mask)
        self.cell = max(SMALLEST_CELL, picture.shape[0] // CELLS)
        self.nodes, self.triangles = _build_grid(picture[..., 3] > FAINT, self.cell)
        premultiplied = np.concatenate([picture[..., :3] * alpha, alpha], -1)
        padded = np.pad(premultiplied, ((BORDER, BORDER), (BORDER, BORDER), (0, 0)), mode="edge")
        self._splines = [ndimage.spline_filter(plane, 3) for plane in np.moveaxis(padded, -1, 0)]

    def edges(self) -> Int64[np.ndarray, "e 2"]:
        """Return every edge of the grid once."""
        sides = np.concatenate([self.triangles[:, [0, 1]], self.triangles[:, [1, 2]], self.triangles[:, [2, 0]]])
        return np.unique(np.sort(sides, 1), axis=0)

    def draw(
        self, positions: Float64[np.ndarray, "n 2"], in_front: Bool[np.ndarray, " n"] | None = None
    ) -> Float64[np.ndarray, "h w 4"]:
        """Draw the picture with moved nodes.

        Args:
            positions: of the moved nodes, pixels.
            in_front: marks nodes; cells with all nodes marked are drawn over the others.

        Returns:
            Image with straight alpha, in [0, 1]; color 0 where alpha is 0.
        """
        if in_front is None:
            return self._draw_layer(positions, self.triangles)
        first, second = in_front[self.triangles].all(1).reshape(2, -1)
        upper = np.tile(first & second, 2)
        below = self._draw_layer(positions, self.triangles[~upper])
        above = self._draw_layer(positions, self.triangles[upper])
        share, rest = above[..., 3:], below[..., 3:] * (1 - above[..., 3:])
        color = (above[..., :3] * share + below[..., :3] * rest) / np.maximum(share + rest, 1e-6)
        return np.concatenate([color, share + rest], -1)

    def _draw_layer(
        self, positions: Float64[np.ndarray, "n 2"], triangles: Int64[np.ndarray, "f 3"]
    ) -> Float64[np.ndarray, "h w 4"]:
        height, width = self.mask.shape
        result = np.zeros((height, width, 4))
        camera = OrbitCamera(width=width, height=height)
        pixel = camera.radius / camera.focal  # size of a pixel in the plane through the origin, world units
        flat = (positions - np.array([width, height]) / 2) * np.array([pixel, -pixel])
        vertices = torch.from_numpy(np.pad(flat, ((0, 0), (0, 1))))
        torn = self._torn(positions, triangles)  # drawn last, so that all other triangles hide them
        faces = torch.from_numpy(np.concatenate([triangles[~torn], triangles[torn]]))
        fragments = rasterize_mesh(vertices, faces, [camera])
        source = interpolate(fragments, faces, torch.from_numpy(self.nodes))[0].numpy()
        covered = fragments.faces[0].numpy() >= 0
        rows_columns = source[covered].T[::-1] - 0.5 + BORDER
        values = [ndimage.map_coordinates(p, rows_columns, order=3, prefilter=False) for p in self._splines]
        color, alpha = np.stack(values[:3], -1), values[3]
        alpha = np.where(alpha < TRANSPARENT, 0, np.where(alpha > OPAQUE, 1, alpha))
        straight = np.clip(color / np.maximum(values[3], 1e-3)[:, None], 0, 1) * (alpha > 0)[:, None]
        result[covered] = np.column_stack([straight, alpha])
        return result

    def _torn(
        self, positions: Float64[np.ndarray, "n 2"], triangles: Int64[np.ndarray, "f 3"]
    ) -> Bool[np.ndarray, " f"]:
        """Mark triangles that are flipped, or have a side much longer or shorter than at rest."""
        corners, rest = positions[triangles], self.nodes[triangles]
        sides, resting = corners - np.roll(corners, 1, 1), rest - np.roll(rest, 1, 1)
        stretch = np.linalg.norm(sides, axis=-1) / np.linalg.norm(resting, axis=-1)
        area = sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]  # positive at rest: rows point down
        return (area <= 0) | (stretch > TORN).any(1) | (stretch < 1 / TORN).any(1)


def _measure(mask: Bool[np.ndarray, "h w"]) -> SubjectBounds:
    rows, columns = np.nonzero(mask)
    top, bottom = float(rows.min()), float(rows.max() + 1)
    feet = columns[rows >= bottom - max(FOOT * (bottom - top), 1)]
    return SubjectBounds(
        left=float(columns.min()),
        right=float(columns.max() + 1),
        top=top,
        bottom=bottom,
        middle=float(columns.mean() + 0.5),
        foot=float(feet.mean() + 0.5),
        cropped=bool(mask[-1].any()),
    )


def _build_grid(
    visible: Bool[np.ndarray, "h w"], cell: int
) -> tuple[Float64[np.ndarray, "n 2"], Int64[np.ndarray, "f 3"]]:
    """Return nodes and triangles of the cells that touch visible pixels or the margin around them."""
    near = ndimage.binary_dilation(visible, iterations=MARGIN)
    down, across = math.ceil(visible.shape[0] / cell), math.ceil(visible.shape[1] / cell)
    padded = np.zeros((down * cell, across * cell), bool)
    padded[: visible.shape[0], : visible.shape[1]] = near
    used = padded.reshape(down, cell, across, cell).any((1, 3))
    touched = np.zeros((down + 1, across + 1), bool)
    for dy in (0, 1):
        for dx in (0, 1):
            touched[dy : dy + down, dx : dx + across] |= used
    index = np.cumsum(touched.ravel()).reshape(touched.shape) - 1
    rows, columns = np.nonzero(touched)
    nodes = np.stack([columns, rows], -1) * float(cell) + OFF_CENTER
    y, x = np.nonzero(used)
    a, b, c, d = index[y, x], index[y, x + 1], index[y + 1, x + 1], index[y + 1, x]
    return nodes, np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
