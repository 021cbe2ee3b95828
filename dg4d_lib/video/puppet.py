"""A cut-out picture on a sheet of rubber: a grid of nodes that may be moved, and the picture drawn on the moved grid.

Every pixel looks up where it came from in the picture, so edges come from the picture's own alpha, never from the grid,
and soft hair stays soft.
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

CELLS = 64  # of the grid along the picture's height
SMALLEST_CELL = 3  # pixels
FAINT = 0.02  # alpha above which a pixel is on the sheet
MARGIN = 4  # pixels of sheet around them
OFF_CENTER = 1e-3  # pixels: keeps the grid's edges off the pixel centers
BORDER = 8  # pixels by which the picture is continued for the splines
TRANSPARENT, OPAQUE = 2 / 255, 253 / 255  # alpha beyond is rounded: splines ring
TORN = 1.6  # times its length at rest, or the inverse: such a side only bridges a gap
FOOT = 0.08  # of the height: the lowest part, whose middle the subject stands on


@dataclass(frozen=True)
class SubjectBounds:
    """Where the subject stands in its picture, pixels, x to the right and y down.

    Attributes:
        left: of the subject.
        right: of the subject.
        top: of the subject.
        bottom: of the subject, where the feet are.
        middle: mean x.
        foot: mean x of the feet.
        cropped: whether the picture's lower border cuts the subject off.
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
        """From the feet to the top."""
        return self.bottom - self.top

    @property
    def width(self) -> float:
        """From the left to the right."""
        return self.right - self.left


class Puppet:
    """The grid at rest and the picture on it.

    Attributes:
        mask: the subject's pixels.
        bounds: where it stands.
        nodes: x and y at rest, pixels.
        triangles: indices into the nodes; the two halves of cell i are i and i + half of their number.
        cell: pixels between nodes.
    """

    def __init__(self, picture: Float64[np.ndarray, "h w 4"]) -> None:
        """Lay the grid over a picture (straight alpha, in [0, 1]).

        Raises:
            BadInput: the picture shows no subject.
        """
        alpha = picture[..., 3:]
        self.mask, _ = subject_mask(picture[..., 3])
        self.bounds = _measure(self.mask)
        self.cell = max(SMALLEST_CELL, picture.shape[0] // CELLS)
        self.nodes, self.triangles = _lay_grid(picture[..., 3] > FAINT, self.cell)
        premultiplied = np.concatenate([picture[..., :3] * alpha, alpha], -1)
        continued = np.pad(premultiplied, ((BORDER, BORDER), (BORDER, BORDER), (0, 0)), mode="edge")
        self._splines = [ndimage.spline_filter(plane, 3) for plane in np.moveaxis(continued, -1, 0)]

    def edges(self) -> Int64[np.ndarray, "e 2"]:
        """Every side of a triangle once."""
        sides = np.concatenate([self.triangles[:, [0, 1]], self.triangles[:, [1, 2]], self.triangles[:, [2, 0]]])
        return np.unique(np.sort(sides, 1), axis=0)

    def draw(
        self, places: Float64[np.ndarray, "n 2"], in_front: Bool[np.ndarray, " n"] | None = None
    ) -> Float64[np.ndarray, "h w 4"]:
        """The picture with its nodes moved.

        Args:
            places: where the nodes went, pixels.
            in_front: cells whose nodes are all marked are drawn over the others.

        Returns:
            Straight alpha, in [0, 1]; color 0 where alpha is 0.
        """
        if in_front is None:
            return self._draw_layer(places, self.triangles)
        first, second = in_front[self.triangles].all(1).reshape(2, -1)
        upper = np.tile(first & second, 2)
        below = self._draw_layer(places, self.triangles[~upper])
        above = self._draw_layer(places, self.triangles[upper])
        share, rest = above[..., 3:], below[..., 3:] * (1 - above[..., 3:])
        color = (above[..., :3] * share + below[..., :3] * rest) / np.maximum(share + rest, 1e-6)
        return np.concatenate([color, share + rest], -1)

    def _draw_layer(
        self, places: Float64[np.ndarray, "n 2"], triangles: Int64[np.ndarray, "f 3"]
    ) -> Float64[np.ndarray, "h w 4"]:
        height, width = self.mask.shape
        result = np.zeros((height, width, 4))
        camera = OrbitCamera(width=width, height=height)
        pixel = camera.radius / camera.focal  # a flat sheet at the camera's distance: space is picture
        flat = (places - np.array([width, height]) / 2) * np.array([pixel, -pixel])
        vertices = torch.from_numpy(np.pad(flat, ((0, 0), (0, 1))))
        torn = self._torn(places, triangles)  # a gap between two parts: whatever else is there hides it
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

    def _torn(self, places: Float64[np.ndarray, "n 2"], triangles: Int64[np.ndarray, "f 3"]) -> Bool[np.ndarray, " f"]:
        """Which triangles are turned over, or have a side that is much longer or shorter than at rest."""
        corners, rest = places[triangles], self.nodes[triangles]
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


def _lay_grid(drawn: Bool[np.ndarray, "h w"], cell: int) -> tuple[Float64[np.ndarray, "n 2"], Int64[np.ndarray, "f 3"]]:
    """Nodes and triangles of the cells that touch the picture or its margin."""
    near = ndimage.binary_dilation(drawn, iterations=MARGIN)
    down, across = math.ceil(drawn.shape[0] / cell), math.ceil(drawn.shape[1] / cell)
    padded = np.zeros((down * cell, across * cell), bool)
    padded[: drawn.shape[0], : drawn.shape[1]] = near
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
