"""Flat triangulation of a silhouette."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64


@dataclass(frozen=True)
class Sheet:
    """Flat triangulation of a silhouette: a node on every pixel of the mask and on every crossing of the outline.

    Attributes:
        points: column and row of the nodes, pixels, centers at +0.5, measured from the middle of the picture.
        pixels: row and column of the pixel whose values the node carries.
        inside: whether it is a pixel (1) or a crossing (0); pixels come first.
        triangles: clockwise in the picture.
        mask: the silhouette.
    """

    points: Float64[np.ndarray, "k 2"]
    pixels: Int64[np.ndarray, "k 2"]
    inside: Bool[np.ndarray, " k"]
    triangles: Int64[np.ndarray, "f 3"]
    mask: Bool[np.ndarray, "h w"]

    def at(self, values: Float64[np.ndarray, "h w *c"]) -> Float64[np.ndarray, "k *c"]:
        """Return a picture's values at the nodes."""
        return values[self.pixels[:, 0], self.pixels[:, 1]]

    def covers(self, points: Float64[np.ndarray, "m 2"]) -> Bool[np.ndarray, " m"]:
        """Return true for points whose pixels belong to the silhouette."""
        size = np.array(self.mask.shape[::-1])
        columns, rows = np.clip(np.floor(points + size / 2).astype(np.int64), 0, size - 1).T
        return self.mask[rows, columns]


def triangulate(mask: Bool[np.ndarray, "h w"], alpha: Float64[np.ndarray, "h w"]) -> Sheet:
    """Triangulate by marching squares over pixel centers; the outline, alpha 0.5, is forced to the mask's side."""
    inside = np.pad(mask, 1)  # the picture's border cuts the subject off
    level = np.pad(np.where(mask, np.maximum(alpha, 0.501), np.minimum(alpha, 0.499)), 1)
    height, width = inside.shape
    node = np.full(inside.shape, -1)
    rows, columns = np.nonzero(inside)
    node[rows, columns] = np.arange(len(rows))
    pixels = [np.stack([rows, columns], -1)]
    points = [pixels[0].astype(np.float64)]
    count = len(rows)
    crossings = []  # along rows, along columns: index of the node between two neighbors
    for across in (True, False):
        step = np.array([0, 1] if across else [1, 0])
        here, there = (inside[:, :-1], inside[:, 1:]) if across else (inside[:-1], inside[1:])
        start = np.argwhere(here != there)
        end = start + step
        a, b = level[tuple(start.T)], level[tuple(end.T)]
        share = np.clip((0.5 - a) / (b - a), 0.02, 0.98)
        points.append(start + share[:, None] * step)
        pixels.append(np.where(inside[tuple(start.T)][:, None], start, end))
        index = np.full(here.shape, -1)
        index[tuple(start.T)] = count + np.arange(len(start))
        crossings.append(index)
        count += len(start)
    along_row, along_column = crossings
    corners = (node[:-1, :-1], node[:-1, 1:], node[1:, 1:], node[1:, :-1])  # clockwise from the top left
    sides = (along_row[:-1], along_column[:, 1:], along_row[1:], along_column[:, :-1])  # side i follows corner i
    case = sum((corner >= 0) << i for i, corner in enumerate(corners))
    triangles = [
        np.stack([(*corners, *sides)[slot][case == number] for slot in triangle], -1)
        for number in range(1, 16)
        for triangle in _triangles_of_cell(number)
    ]
    return Sheet(
        points=np.concatenate(points)[:, ::-1] + 0.5 - np.array([width, height]) / 2,
        pixels=np.clip(np.concatenate(pixels) - 1, 0, None),
        inside=np.arange(count) < len(rows),
        triangles=np.concatenate(triangles),
        mask=mask,
    )


def _triangles_of_cell(case: int) -> list[tuple[int, int, int]]:
    """Return the triangles over four neighboring pixels, clockwise: corners are 0 to 3, the sides behind them 4 to 7.

    Args:
        case: bit i says whether corner i is inside. Corners that only meet across the diagonal stay apart.
    """
    inside = [bool(case >> i & 1) for i in range(4)]
    if case in (0b0101, 0b1010):
        return [(i, 4 + i, 4 + (i - 1) % 4) for i in range(4) if inside[i]]
    outline: list[int] = []
    for i in range(4):
        outline += [i] if inside[i] else []
        outline += [4 + i] if inside[i] != inside[(i + 1) % 4] else []
    return [(outline[0], outline[i], outline[i + 1]) for i in range(1, len(outline) - 1)]
