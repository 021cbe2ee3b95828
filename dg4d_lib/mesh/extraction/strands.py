"""Strands of a subject that the grid of its surface is too coarse for: legs of insects, antennae, whiskers.

A picture of the subject shows them. Each becomes a tube that grows out of the vertex nearest to its root, at the depth
of that vertex, so the surface keeps its topology.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from scipy import ndimage
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree
from skimage.morphology import skeletonize
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.mesh.extraction.silhouettes import enlarged_masks, surroundings
from dg4d_lib.mesh.folds import DefectFinder
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh

SIZE = 1024  # pixels of the compared masks
NEAR = 6.0  # pixels: tolerance of the surface's outline
THICKEST = 8.0  # pixels: largest radius of a strand
SHORTEST = 24.0  # pixels: least length of a strand beyond the outline of the surface
GAP = 8.0  # pixels: largest gap in a strand, where it is thinner than a pixel of the picture
SLENDER = 4.0  # least length of a strand, in its radii
MARGIN = 16  # pixels around uncovered parts of the mask
REACH = 48.0  # pixels from the root of a strand to the vertex that it grows out of
ROUNDS = 4  # branches grow one round after their strand
MOST = 16  # strands that are tried in a round, the longest ones: fringes of a cut-out are not legs
SMOOTH = 4.0  # standard deviation of the middle line along its pixels
THINNEST = 2.0  # pixels: least radius
TIP = 6  # pixels of the middle line from which it is extrapolated
ATTEMPTS = 8  # vertices that a strand may grow out of
CAMERA = OrbitCamera(width=SIZE, height=SIZE)


class Strand(NamedTuple):
    """Middle line of a strand in the picture.

    Attributes:
        points: column and row of its pixels, from the root to the tip.
        radii: from there to the side, pixels.
    """

    points: Float64[np.ndarray, "p 2"]
    radii: Float64[np.ndarray, " p"]


class MiddleLines(NamedTuple):
    """Middle lines of the parts of a mask that a surface does not cover.

    Attributes:
        marks: pixels of the lines, in a part of the picture.
        beyond: distance of the pixels of that part from covered ones.
        radius: their distance from the outside of the mask.
        corner: column and row of the first of them.
    """

    marks: Bool[np.ndarray, "i j"]
    beyond: Float[np.ndarray, "i j"]
    radius: Float[np.ndarray, "i j"]
    corner: Int[np.ndarray, " 2"]


class Tube(NamedTuple):
    """Vertices of a strand on a surface.

    Attributes:
        root: the ring of vertices that it grew out of.
        rings: of its own, from there to the tip.
        tip: vertex at its end.
    """

    root: Int[np.ndarray, " n"]
    rings: Int[np.ndarray, "k n"]
    tip: int


class Grown(NamedTuple):
    """Surface with strands.

    Attributes:
        vertices: those of the surface without strands come first, some of which became tips.
        faces: counter-clockwise seen from outside.
        tubes: the strands; some grow out of others before them.
    """

    vertices: Float64[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    tubes: tuple[Tube, ...] = ()


def with_strands(
    vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], alpha: Float[Tensor, "i j"]
) -> tuple[Float[Tensor, "w 3"], Int[Tensor, "g 3"]]:
    """Return a surface with the strands that a picture shows beyond its outline.

    Args:
        vertices: welded, world units.
        faces: counter-clockwise seen from outside.
        alpha: of the subject at the input view.
    """
    mask = enlarged_masks(alpha[None], SIZE)[0].numpy()
    surface = Grown(vertices.double().numpy(), faces.numpy())
    for _ in range(ROUNDS):
        before = len(surface.tubes)
        strands = find_strands(middle_lines(mask, covered_pixels(surface.vertices, surface.faces)))
        for strand in sorted(strands, key=lambda one: -len(one.points))[:MOST]:
            surface = with_strand(surface, strand) or surface
        if len(surface.tubes) == before:
            break
    return torch.from_numpy(surface.vertices).to(vertices), torch.from_numpy(surface.faces).to(faces)


def covered_pixels(vertices: Float64[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Bool[np.ndarray, "h w"]:
    """Mark the pixels of the input view that a surface covers, of `SIZE` by `SIZE`."""
    fragments = rasterize_mesh(torch.from_numpy(vertices).float(), torch.from_numpy(faces), [CAMERA])
    covered: Bool[np.ndarray, "h w"] = (fragments.faces[0] >= 0).numpy()
    return covered


def find_strands(lines: MiddleLines) -> list[Strand]:
    """Return the longest strand of every part of a mask that is not covered."""
    pixels = np.stack(np.nonzero(lines.marks), 1)
    pairs = cKDTree(pixels).query_pairs(GAP, output_type="ndarray") if len(pixels) else np.zeros((0, 2), np.int64)
    gaps = np.linalg.norm(pixels[pairs[:, 0]] - pixels[pairs[:, 1]], axis=1)
    tree = minimum_spanning_tree(coo_array((gaps, tuple(pairs.T)), shape=(len(pixels), len(pixels))).tocsr())
    parts = connected_components(tree, directed=False)[1]
    strands = []
    for part in np.unique(parts):
        here = np.flatnonzero(parts == part)
        path = pixels[_longest_path(tree, int(here[lines.beyond[tuple(pixels[here].T)].argmin()]))]
        radii = lines.radius[tuple(path.T)]
        if len(path) >= max(SHORTEST, SLENDER * radii.mean()) and np.median(radii) <= THICKEST:
            points = ndimage.gaussian_filter1d(path[:, ::-1] + lines.corner + 0.5, SMOOTH, axis=0, mode="nearest")
            strands.append(Strand(points, ndimage.gaussian_filter1d(radii, SMOOTH, mode="nearest").clip(THINNEST)))
    return strands


def middle_lines(mask: Bool[np.ndarray, "h w"], covered: Bool[np.ndarray, "h w"]) -> MiddleLines:
    """Return the middle lines of the parts of a mask that are not covered."""
    whole = surroundings(mask, 1)
    beyond = ndimage.distance_transform_edt(~covered[whole]) if covered.any() else np.full(mask[whole].shape, np.inf)
    uncovered = mask[whole] & (beyond > NEAR)
    part = surroundings(uncovered, MARGIN)
    beyond, here = beyond[part], mask[whole][part]
    marks, radius = skeletonize(here) & (beyond > NEAR), ndimage.distance_transform_edt(here)
    corner = np.array([whole[1].start + part[1].start, whole[0].start + part[0].start])
    return MiddleLines(marks, beyond, radius, corner)


def _longest_path(tree: csr_array, root: int) -> list[int]:
    """Return the nodes from the root of a tree to the one that is most steps away."""
    order, before = breadth_first_order(tree, root, directed=False)
    at, path = int(order[-1]), []
    while at >= 0:
        path.append(at)
        at = int(before[at])
    return path[::-1]


def pixels_of(points: Float64[np.ndarray, "k 3"]) -> tuple[Float64[np.ndarray, "k 2"], Float64[np.ndarray, " k"]]:
    """Return column and row of points at the input view, of `SIZE` pixels, and their depth, world units."""
    view = CAMERA.viewmat().numpy()
    in_camera = points @ view[:3, :3].T + view[:3, 3]
    return in_camera[:, :2] / in_camera[:, 2:] * CAMERA.focal + SIZE / 2, in_camera[:, 2]


def with_strand(grown: Grown, strand: Strand) -> Grown | None:
    """Return the surface with a tube that grows out of a vertex where no other does; None if no attempt is sound."""
    vertices, faces, view = grown.vertices, grown.faces, CAMERA.viewmat().numpy()
    taken = np.zeros(len(vertices), bool)
    for tube in grown.tubes:
        taken[[tube.tip, *tube.root]] = True
    pixels, depths = pixels_of(vertices)
    distances = np.linalg.norm(pixels - strand.points[0], axis=1) + np.where(taken, np.inf, 0)
    for base in np.argsort(distances)[:ATTEMPTS]:
        root = _ring(faces, int(base))
        if distances[base] > REACH or root is None or taken[root].any():
            continue
        depth = depths[base]
        flat = (strand.points - SIZE / 2) * depth / CAMERA.focal
        path = (np.concatenate([flat, np.full((len(flat), 1), depth)], 1) - view[:3, 3]) @ view[:3, :3]
        larger = _with_tube(grown, int(base), root, path, strand.radii * depth / CAMERA.focal)
        new = np.arange(len(larger.faces)) >= (faces != base).all(1).sum()
        if not DefectFinder(larger.faces).defective(larger.vertices, new).any():
            return larger
    return None


def _ring(faces: Int[np.ndarray, "f 3"], base: int) -> Int[np.ndarray, " n"] | None:
    """Return the neighbors of a vertex, counter-clockwise seen from outside; None if they are not a ring."""
    following = {}
    for face in faces[(faces == base).any(1)]:
        k = int(np.flatnonzero(face == base)[0])
        following[int(face[(k + 1) % 3])] = int(face[(k + 2) % 3])
    ring = [next(iter(following), base)]
    while len(ring) < len(following) and following.get(ring[-1], ring[0]) != ring[0]:
        ring.append(following[ring[-1]])
    whole = len(ring) == len(following) >= 3 and following.get(ring[-1]) == ring[0]
    return np.array(ring) if whole else None


def _with_tube(
    grown: Grown,
    base: int,
    root: Int[np.ndarray, " n"],
    path: Float64[np.ndarray, "p 3"],
    radii: Float64[np.ndarray, " p"],
) -> Grown:
    """Return the surface with a tube in place of the faces at a vertex, which becomes the tip."""
    vertices, faces = grown.vertices, grown.faces
    tip = path[-1] - path[-1 - TIP :][0]  # a middle line ends before it
    path = np.concatenate([path, path[-1:] + tip / max(np.linalg.norm(tip), 1e-12) * radii[-1]])
    along = np.concatenate([[0], np.linalg.norm(np.diff(path, axis=0), axis=1).cumsum()])
    spacing = np.linalg.norm(vertices[root] - vertices[base], axis=1).mean()
    places = np.linspace(0, along[-1], max(2, round(along[-1] / spacing)) + 1)
    centers = np.stack([np.interp(places, along, path[:, axis]) for axis in range(3)], 1)
    widths = np.interp(places, along, np.append(radii, radii[-1]))
    directions = np.gradient(np.concatenate([vertices[base, None], centers]), axis=0)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True).clip(1e-12)
    across = vertices[root[0]] - vertices[root].mean(0)
    count, rings = len(root), []
    widths = widths * np.sqrt(2 * np.pi / (count * np.sin(2 * np.pi / count)))  # a polygon of the area of the circle
    angles = 2 * np.pi * np.arange(count)[:, None] / count
    for center, width, direction in zip(centers[:-1], widths, directions[1:], strict=False):
        across = across - direction * (across @ direction)
        across /= np.linalg.norm(across).clip(1e-12)
        rings.append(center + width * (np.cos(angles) * across + np.sin(angles) * np.cross(direction, across)))
    moved = np.concatenate([vertices, *rings])
    moved[base] = centers[-1]
    own = len(vertices) + np.arange(len(rings) * count).reshape(-1, count)
    low, high = np.concatenate([root[None], own[:-1]]), own
    low_next, high_next = np.roll(low, -1, 1), np.roll(high, -1, 1)
    sides = np.stack([np.stack([low, low_next, high_next], -1), np.stack([low, high_next, high], -1)])
    cap = np.stack([own[-1], np.roll(own[-1], -1), np.full(count, base)], 1)
    corners = np.concatenate([faces[(faces != base).all(1)], sides.reshape(-1, 3), cap]).astype(faces.dtype)
    return Grown(moved, corners, (*grown.tubes, Tube(root, own, base)))
