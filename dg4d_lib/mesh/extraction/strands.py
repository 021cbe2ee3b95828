"""Strands of a subject that the grid of its surface is too coarse for: legs of insects, antennae, whiskers.

A picture of the subject shows them. Each becomes a tube that grows out of the vertex nearest to its root, at the depth
of that vertex, so the surface keeps its topology.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order
from scipy.spatial import cKDTree
from skimage.morphology import skeletonize
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.mesh.extraction.silhouettes import enlarged_masks
from dg4d_lib.mesh.folds import DefectFinder
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh

SIZE = 1024  # pixels of the compared masks
NEAR = 6.0  # pixels by which the outline of the surface may be wrong without a strand
THICKEST = 8.0  # pixels from the middle of a strand to its side
SHORTEST = 24.0  # pixels of a strand beyond the outline of the surface
SLENDER = 4.0  # length of a strand, in its radii, at least
REACH = 48.0  # pixels from the root of a strand to the vertex that it grows out of
ROUNDS = 4  # branches of a strand grow in the round after it
SMOOTH = 4.0  # standard deviation of the middle line along its pixels
THINNEST = 2.0  # pixels of radius
TIP = 6  # pixels of the middle line that show where it goes on
ATTEMPTS = 4  # vertices that a strand may grow out of


class Strand(NamedTuple):
    """Middle line of a strand in the picture.

    Attributes:
        points: column and row of its pixels, from the root to the tip.
        radii: from there to the side, pixels.
    """

    points: Float64[np.ndarray, "p 2"]
    radii: Float64[np.ndarray, " p"]


def grow_strands(
    vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], alpha: Float[Tensor, "i j"]
) -> tuple[Float[Tensor, "w 3"], Int[Tensor, "g 3"]]:
    """Return the surface with the strands that the picture shows beyond its outline.

    Args:
        vertices: welded, world units.
        faces: counter-clockwise seen from outside.
        alpha: of the subject at the input view.
    """
    mask = enlarged_masks(alpha[None], SIZE)[0].numpy()
    grown, corners = vertices.double().numpy(), faces.numpy().astype(np.int64)
    taken = np.zeros(len(grown), bool)
    for _ in range(ROUNDS):
        strands = _strands(mask, _covered(grown, corners))
        before = len(grown)
        for strand in strands:
            larger = _with_strand(grown, corners, strand, taken)
            if larger is not None:
                grown, corners, taken = larger
        if len(grown) == before:
            break
    return torch.from_numpy(grown).to(vertices), torch.from_numpy(corners).to(faces)


def _covered(vertices: Float64[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Bool[np.ndarray, "h w"]:
    camera = OrbitCamera(width=SIZE, height=SIZE)
    fragments = rasterize_mesh(torch.from_numpy(vertices).float(), torch.from_numpy(faces), [camera])
    covered: Bool[np.ndarray, "h w"] = (fragments.faces[0] >= 0).numpy()
    return covered


def _strands(mask: Bool[np.ndarray, "h w"], covered: Bool[np.ndarray, "h w"]) -> list[Strand]:
    """Return the longest strand of every part of the mask that is not covered."""
    beyond = ndimage.distance_transform_edt(~covered)
    radius = ndimage.distance_transform_edt(mask)
    labels, count = ndimage.label(skeletonize(mask) & (beyond > NEAR), np.ones((3, 3)))
    strands = []
    for label in range(1, count + 1):
        pixels = np.stack(np.nonzero(labels == label), 1)
        path = _longest_path(pixels, beyond[tuple(pixels.T)])
        radii = radius[tuple(path.T)]
        length = len(path)
        if length >= max(SHORTEST, SLENDER * radii.mean()) and np.median(radii) <= THICKEST:
            points = ndimage.gaussian_filter1d(path[:, ::-1] + 0.5, SMOOTH, axis=0, mode="nearest")
            strands.append(Strand(points, ndimage.gaussian_filter1d(radii, SMOOTH, mode="nearest").clip(THINNEST)))
    return strands


def _longest_path(pixels: Int[np.ndarray, "p 2"], beyond: Float[np.ndarray, " p"]) -> Int[np.ndarray, "q 2"]:
    """Return the pixels from the one nearest to the surface to that farthest from it along the others."""
    pairs = cKDTree(pixels).query_pairs(1.5, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(len(pixels), len(pixels))).tocsr()
    order, before = breadth_first_order(links, int(beyond.argmin()), directed=False)
    at, path = int(order[-1]), []
    while at >= 0:
        path.append(at)
        at = int(before[at])
    return pixels[path[::-1]]


def _with_strand(
    vertices: Float64[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], strand: Strand, taken: Bool[np.ndarray, " v"]
) -> tuple[Float64[np.ndarray, "w 3"], Int[np.ndarray, "g 3"], Bool[np.ndarray, " w"]] | None:
    """Return the surface with a tube, and its vertices that others may not grow out of; None if none is sound."""
    camera = OrbitCamera(width=SIZE, height=SIZE)
    view = camera.viewmat().numpy()
    in_camera = vertices @ view[:3, :3].T + view[:3, 3]
    pixels = in_camera[:, :2] / in_camera[:, 2:] * camera.focal + SIZE / 2
    distances = np.linalg.norm(pixels - strand.points[0], axis=1) + np.where(taken, np.inf, 0)
    sound = ~DefectFinder(faces).defective(vertices)
    for base in np.argsort(distances)[:ATTEMPTS]:
        if distances[base] > REACH:
            break
        depth = in_camera[base, 2]
        flat = (strand.points - SIZE / 2) * depth / camera.focal
        path = (np.concatenate([flat, np.full((len(flat), 1), depth)], 1) - view[:3, 3]) @ view[:3, :3]
        around = _ring(faces, int(base))
        if around is None or taken[around].any():
            continue
        spacing = np.linalg.norm(vertices[around] - vertices[base], axis=1).mean()
        tube = _tube(vertices, faces, int(base), around, path, strand.radii * depth / camera.focal, spacing)
        bad = DefectFinder(tube[1]).defective(tube[0])
        kept = (faces != base).all(1)  # they come first
        if (bad[: kept.sum()] & sound[kept]).any() or bad[kept.sum() :].any():
            continue
        marked = np.concatenate([taken, np.zeros(len(tube[0]) - len(taken), bool)])
        marked[[base, *around]] = True
        return *tube, marked
    return None


def _ring(faces: Int[np.ndarray, "f 3"], base: int) -> Int[np.ndarray, " n"] | None:
    """Return the neighbors of a vertex, counter-clockwise seen from outside; None if they are no ring."""
    following = {}
    for face in faces[(faces == base).any(1)]:
        k = int(np.flatnonzero(face == base)[0])
        following[int(face[(k + 1) % 3])] = int(face[(k + 2) % 3])
    ring = [next(iter(following), base)]
    while len(ring) < len(following) and following.get(ring[-1], ring[0]) != ring[0]:
        ring.append(following[ring[-1]])
    whole = len(ring) == len(following) >= 3 and following.get(ring[-1]) == ring[0]
    return np.array(ring) if whole else None


def _tube(
    vertices: Float64[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    base: int,
    around: Int[np.ndarray, " n"],
    path: Float64[np.ndarray, "p 3"],
    radii: Float64[np.ndarray, " p"],
    spacing: float,
) -> tuple[Float64[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    """Return the surface with a tube in place of the faces at a vertex, which becomes the tip."""
    tip = path[-1] - path[-1 - TIP :][:1]  # a middle line ends before it
    path = np.concatenate([path, path[-1:] + tip / max(np.linalg.norm(tip), 1e-12) * radii[-1]])
    radii = np.append(radii, radii[-1])
    along = np.concatenate([[0], np.linalg.norm(np.diff(path, axis=0), axis=1).cumsum()])
    places = np.linspace(0, along[-1], max(2, round(along[-1] / spacing)) + 1)
    centers = np.stack([np.interp(places, along, path[:, axis]) for axis in range(3)], 1)
    widths = np.interp(places, along, radii)
    directions = np.gradient(np.concatenate([vertices[base, None], centers]), axis=0)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True).clip(1e-12)
    ring = vertices[around] - vertices[around].mean(0)
    first = ring[0] - directions[0] * (ring[0] @ directions[0])
    count, rings = len(around), []
    angles = 2 * np.pi * np.arange(count) / count
    for center, width, direction in zip(centers[:-1], widths, directions[1:], strict=False):
        first = first - direction * (first @ direction)
        first /= np.linalg.norm(first).clip(1e-12)
        second = np.cross(direction, first)
        rings.append(center + width * (np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second))
    moved = vertices.copy()
    moved[base] = centers[-1]
    numbers = np.concatenate([around[None], len(vertices) + np.arange(len(rings) * count).reshape(-1, count)])
    low, high = numbers[:-1], numbers[1:]
    low_next, high_next = np.roll(low, -1, 1), np.roll(high, -1, 1)
    sides = np.stack([np.stack([low, low_next, high_next], -1), np.stack([low, high_next, high], -1)])
    last = numbers[-1]
    cap = np.stack([last, np.roll(last, -1), np.full(count, base)], 1)
    kept = faces[(faces != base).all(1)]
    return np.concatenate([moved, *rings]), np.concatenate([kept, sides.reshape(-1, 3), cap]).astype(faces.dtype)
