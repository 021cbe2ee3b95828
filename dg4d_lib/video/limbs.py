"""Limb detection in a subject's silhouette, and limb animation."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy import ndimage, sparse
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from dg4d_lib.inflation.heights import outline_distance
from dg4d_lib.video.arap import ArapMesh
from dg4d_lib.video.puppet import Puppet, SubjectBounds

WAVE_DEG = 24.0  # amplitude, degrees
CORE = 0.55  # radius of the disc that defines the torso (by opening), in largest inscribed radii
CORE_MARGIN = 0.12  # dilation of the torso, in largest inscribed radii
SMALLEST = 0.012  # minimum area of a limb relative to the subject
LOWEST_ROOT, LOWEST_TIP = 0.78, 0.9  # maximum distance from the top, in subject heights; excludes legs
SLENDER = 0.8  # minimum ratio of length to thickness
MAX_LIMBS = 2  # limbs that wave
MUCH_WORSE = 0.5  # minimum score of a second limb relative to the first
TIP = 0.35  # share of the length whose nodes are handles
FREE = 1.2  # radius around a root in which nodes are free, in limb thicknesses
GAP = 6.0  # cells; adjacent nodes whose path lengths from the torso differ by more only bridge a gap


@dataclass(frozen=True)
class Limb:
    """Protruding part of the subject.

    Attributes:
        nodes: indices of the puppet's nodes in the limb.
        tip: x and y of the node farthest from the torso, pixels.
        root: x and y of the node nearest to the torso, pixels.
        length: path length from root to tip inside the subject, pixels.
        thickness: largest distance to the outline, pixels.
    """

    nodes: Int64[np.ndarray, " k"]
    tip: Float64[np.ndarray, "2"]
    root: Float64[np.ndarray, "2"]
    length: float
    thickness: float


class LimbAnimator:
    """Animator that rotates the tips of limbs about their roots; the torso stays and other nodes follow."""

    def __init__(self, puppet: Puppet, limbs: list[Limb]) -> None:
        """Build the deformable mesh for all poses.

        Args:
            puppet: the puppet to animate.
            limbs: at least one, from `waving_limbs`.
        """
        self._puppet, self._limbs = puppet, limbs
        edges, nodes = _edges_inside(puppet), puppet.nodes
        moving = np.zeros(len(nodes), bool)
        for limb in limbs:
            moving[limb.nodes] = True
        self._in_front = _dilate(moving, edges, 2)
        root_distance = np.min([np.linalg.norm(nodes - limb.root, axis=1) for limb in limbs], 0)
        fixed = ~_dilate(moving, edges, 3) & (root_distance > FREE * max(limb.thickness for limb in limbs))
        self._tips = [_tip_nodes(puppet, limb) for limb in limbs]
        fixed |= _components_without(np.concatenate(self._tips), edges, len(nodes))
        fixed[np.concatenate(self._tips)] = False
        self._fixed = np.flatnonzero(fixed)
        self._mesh = ArapMesh(nodes, edges, np.concatenate([self._fixed, *self._tips]))

    def draw(self, angle: float) -> Float64[np.ndarray, "h w 4"]:
        """Draw the puppet with its limbs raised by an angle in radians; limbs are drawn in front of the torso."""
        nodes = self._puppet.nodes
        targets = [nodes[self._fixed]]
        for limb, tip in zip(self._limbs, self._tips, strict=True):
            rotation = np.exp(1j * (-angle if limb.tip[0] > limb.root[0] else angle))  # y points down
            rotated = (nodes[tip] - limb.root) @ np.array([1, 1j]) * rotation
            targets.append(limb.root + np.stack([rotated.real, rotated.imag], -1))
        return self._puppet.draw(self._mesh.pose(np.concatenate(targets)), self._in_front)


def waving_limbs(puppet: Puppet) -> list[Limb]:
    """Select up to two limbs for waving, preferring long ones, raised ones and those at the sides."""
    bounds = puppet.bounds

    def score(limb: Limb) -> float:
        raised = 1.6 if limb.tip[1] < limb.root[1] else 1.0
        central = 0.5 if abs(limb.tip[0] - bounds.middle) <= 0.15 * bounds.width else 1.0
        return limb.length / bounds.height * raised * central

    able = sorted((limb for limb in find_limbs(puppet) if _may_wave(limb, bounds)), key=score, reverse=True)[:MAX_LIMBS]
    return [limb for limb in able if score(limb) >= MUCH_WORSE * score(able[0])]


def find_limbs(puppet: Puppet) -> list[Limb]:
    """Find all protruding parts: connected parts of the silhouette outside the torso."""
    distance = outline_distance(puppet.mask) * puppet.mask
    radius = distance.max()
    core = ndimage.distance_transform_edt(distance <= CORE * radius) <= CORE * radius
    core = ndimage.binary_dilation(core, iterations=max(1, int(CORE_MARGIN * radius)))
    parts, count = ndimage.label(puppet.mask & ~core)
    sizes = np.bincount(parts.ravel())
    rows, columns = _pixels(puppet)
    thickness, part = distance[rows, columns], parts[rows, columns] * puppet.mask[rows, columns]
    path = _path_from_core(puppet)
    limbs = []
    for number in range(1, count + 1):
        nodes = np.flatnonzero((part == number) & np.isfinite(path))
        if sizes[number] < SMALLEST * puppet.mask.sum() or len(nodes) < 3:
            continue
        tip, root = nodes[path[nodes].argmax()], nodes[path[nodes].argmin()]
        length = float(path[tip] - path[root])
        limbs.append(Limb(nodes, puppet.nodes[tip], puppet.nodes[root], length, float(thickness[nodes].max())))
    return limbs


def _may_wave(limb: Limb, bounds: SubjectBounds) -> bool:
    return bool(
        limb.root[1] < bounds.top + LOWEST_ROOT * bounds.height
        and limb.tip[1] < bounds.top + LOWEST_TIP * bounds.height
        and limb.length > SLENDER * limb.thickness
    )


def _pixels(puppet: Puppet) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
    """Return row and column of the pixel under every node."""
    columns, rows = np.clip(puppet.nodes.astype(np.int64), 0, np.array(puppet.mask.shape[::-1]) - 1).T
    return rows, columns


def _path_from_core(puppet: Puppet) -> Float64[np.ndarray, " n"]:
    """Return the length of the shortest path inside the subject from its thickest point, pixels; infinite if none."""
    inside = puppet.mask[_pixels(puppet)]
    thickness = outline_distance(puppet.mask)[_pixels(puppet)]
    edges = puppet.edges()
    edges = edges[inside[edges].all(1)]
    lengths = np.linalg.norm(puppet.nodes[edges[:, 0]] - puppet.nodes[edges[:, 1]], axis=1)
    n = len(puppet.nodes)
    graph = sparse.csr_matrix((lengths, (edges[:, 0], edges[:, 1])), shape=(n, n))
    start = int(np.argmax(np.where(inside, thickness, -1)))
    return np.asarray(dijkstra(graph, directed=False, indices=[start])[0])


def _edges_inside(puppet: Puppet) -> Int64[np.ndarray, "e 2"]:
    """Return the grid's edges without those that only bridge a gap, such as between a raised hand and the head."""
    path = _path_from_core(puppet)
    reached = np.flatnonzero(np.isfinite(path))
    nearest = reached[cKDTree(puppet.nodes[reached]).query(puppet.nodes)[1]]
    edges = puppet.edges()
    return edges[np.abs(np.diff(path[nearest][edges], axis=1)[:, 0]) < GAP * puppet.cell]


def _dilate(marked: Bool[np.ndarray, " n"], edges: Int64[np.ndarray, "e 2"], rings: int) -> Bool[np.ndarray, " n"]:
    """Mark the neighbors of marked nodes, repeatedly."""
    for _ in range(rings):
        dilated = marked.copy()
        dilated[edges[marked[edges].any(1)]] = True
        marked = dilated
    return marked


def _components_without(
    handles: Int64[np.ndarray, " k"], edges: Int64[np.ndarray, "e 2"], n: int
) -> Bool[np.ndarray, " n"]:
    """Mark the nodes of connected components that contain no handle."""
    graph = sparse.csr_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
    _, part = connected_components(graph, directed=False)
    return ~np.isin(part, part[handles])


def _tip_nodes(puppet: Puppet, limb: Limb) -> Int64[np.ndarray, " k"]:
    reach = np.linalg.norm(puppet.nodes[limb.nodes] - limb.tip, axis=1)
    return limb.nodes[reach < max(1.5 * puppet.cell, TIP * limb.length)]
