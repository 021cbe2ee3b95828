"""Which parts of a subject stick out, and waving with them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy import ndimage, sparse
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from dg4d_lib.inflation.heights import outline_distance
from dg4d_lib.video.arap import ArapMesh
from dg4d_lib.video.puppet import Puppet, SubjectBounds

WAVE_DEG = 24.0
CORE = 0.55  # of the greatest inscribed radius: what a disc of this size can reach is body
CORE_MARGIN = 0.12  # of the same radius
SMALLEST = 0.012  # of the subject's area
LOWEST_ROOT, LOWEST_TIP = 0.78, 0.9  # of the height below the top: legs do not wave
SLENDER = 0.8  # least length over thickness
MOST = 2  # limbs that wave
MUCH_WORSE = 0.5  # a second limb with less than this share of the first one's score stays still
TIP = 0.35  # of the length: the part that is led
FREE = 1.2  # thicknesses around a root that are not held
GAP = 6.0  # cells: neighbors whose ways from the core differ by more only bridge a gap


@dataclass(frozen=True)
class Limb:
    """A part that sticks out.

    Attributes:
        nodes: of the puppet, by index.
        tip: x and y of the node farthest from the core, pixels.
        root: x and y of the nearest one.
        length: from root to tip inside the subject, pixels.
        thickness: greatest distance to the outline, pixels.
    """

    nodes: Int64[np.ndarray, " k"]
    tip: Float64[np.ndarray, "2"]
    root: Float64[np.ndarray, "2"]
    length: float
    thickness: float


class LimbAnimator:
    """Turns the ends of limbs about their roots; the rest of the puppet stays or follows."""

    def __init__(self, puppet: Puppet, limbs: list[Limb]) -> None:
        """Prepare for many poses.

        Args:
            puppet: to be moved.
            limbs: at least one, from `waving_limbs`.
        """
        self._puppet, self._limbs = puppet, limbs
        edges, nodes = _edges_of_flesh(puppet), puppet.nodes
        moving = np.zeros(len(nodes), bool)
        for limb in limbs:
            moving[limb.nodes] = True
        self._in_front = _grown(moving, edges, 2)
        reach = np.min([np.linalg.norm(nodes - limb.root, axis=1) for limb in limbs], 0)
        held = ~_grown(moving, edges, 3) & (reach > FREE * max(limb.thickness for limb in limbs))
        self._tips = [_tip_nodes(puppet, limb) for limb in limbs]
        held |= _untouched_parts(np.concatenate(self._tips), edges, len(nodes))
        held[np.concatenate(self._tips)] = False
        self._held = np.flatnonzero(held)
        self._sheet = ArapMesh(nodes, edges, np.concatenate([self._held, *self._tips]))

    def draw(self, angle: float) -> Float64[np.ndarray, "h w 4"]:
        """The puppet with its limbs raised by this angle in radians; they pass in front of the bounds."""
        nodes = self._puppet.nodes
        targets = [nodes[self._held]]
        for limb, tip in zip(self._limbs, self._tips, strict=True):
            turn = np.exp(1j * (-angle if limb.tip[0] > limb.root[0] else angle))  # rows point down
            spun = (nodes[tip] - limb.root) @ np.array([1, 1j]) * turn
            targets.append(limb.root + np.stack([spun.real, spun.imag], -1))
        return self._puppet.draw(self._sheet.pose(np.concatenate(targets)), self._in_front)


def waving_limbs(puppet: Puppet) -> list[Limb]:
    """The one or two parts that wave best: long, high up, at the sides; none where nothing sticks out."""
    bounds = puppet.bounds

    def score(limb: Limb) -> float:
        raised = 1.6 if limb.tip[1] < limb.root[1] else 1.0
        central = 0.5 if abs(limb.tip[0] - bounds.middle) <= 0.15 * bounds.width else 1.0
        return limb.length / bounds.height * raised * central

    able = sorted((limb for limb in find_limbs(puppet) if _may_wave(limb, bounds)), key=score, reverse=True)[:MOST]
    return [limb for limb in able if score(limb) >= MUCH_WORSE * score(able[0])]


def find_limbs(puppet: Puppet) -> list[Limb]:
    """All parts outside of the core."""
    distance = outline_distance(puppet.mask) * puppet.mask
    radius = distance.max()
    core = ndimage.distance_transform_edt(distance <= CORE * radius) <= CORE * radius
    core = ndimage.binary_dilation(core, iterations=max(1, int(CORE_MARGIN * radius)))
    parts, count = ndimage.label(puppet.mask & ~core)
    sizes = np.bincount(parts.ravel())
    rows, columns = _pixels(puppet)
    thickness, part = distance[rows, columns], parts[rows, columns] * puppet.mask[rows, columns]
    way = _way_from_core(puppet)
    limbs = []
    for number in range(1, count + 1):
        nodes = np.flatnonzero((part == number) & np.isfinite(way))
        if sizes[number] < SMALLEST * puppet.mask.sum() or len(nodes) < 3:
            continue
        tip, root = nodes[way[nodes].argmax()], nodes[way[nodes].argmin()]
        length = float(way[tip] - way[root])
        limbs.append(Limb(nodes, puppet.nodes[tip], puppet.nodes[root], length, float(thickness[nodes].max())))
    return limbs


def _may_wave(limb: Limb, bounds: SubjectBounds) -> bool:
    return bool(
        limb.root[1] < bounds.top + LOWEST_ROOT * bounds.height
        and limb.tip[1] < bounds.top + LOWEST_TIP * bounds.height
        and limb.length > SLENDER * limb.thickness
    )


def _pixels(puppet: Puppet) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
    """Row and column under every node."""
    columns, rows = np.clip(puppet.nodes.astype(np.int64), 0, np.array(puppet.mask.shape[::-1]) - 1).T
    return rows, columns


def _way_from_core(puppet: Puppet) -> Float64[np.ndarray, " n"]:
    """Length of the shortest way inside the subject from its thickest place, pixels; infinite where there is none."""
    inside = puppet.mask[_pixels(puppet)]
    thickness = outline_distance(puppet.mask)[_pixels(puppet)]
    edges = puppet.edges()
    edges = edges[inside[edges].all(1)]
    lengths = np.linalg.norm(puppet.nodes[edges[:, 0]] - puppet.nodes[edges[:, 1]], axis=1)
    n = len(puppet.nodes)
    graph = sparse.csr_matrix((lengths, (edges[:, 0], edges[:, 1])), shape=(n, n))
    start = int(np.argmax(np.where(inside, thickness, -1)))
    return np.asarray(dijkstra(graph, directed=False, indices=[start])[0])


def _edges_of_flesh(puppet: Puppet) -> Int64[np.ndarray, "e 2"]:
    """The grid's edges but for those that only bridge a gap, such as between a raised hand and the head."""
    way = _way_from_core(puppet)
    reached = np.flatnonzero(np.isfinite(way))
    nearest = reached[cKDTree(puppet.nodes[reached]).query(puppet.nodes)[1]]
    edges = puppet.edges()
    return edges[np.abs(np.diff(way[nearest][edges], axis=1)[:, 0]) < GAP * puppet.cell]


def _grown(marked: Bool[np.ndarray, " n"], edges: Int64[np.ndarray, "e 2"], rings: int) -> Bool[np.ndarray, " n"]:
    """The marked nodes and their neighbors."""
    for _ in range(rings):
        grown = marked.copy()
        grown[edges[marked[edges].any(1)]] = True
        marked = grown
    return marked


def _untouched_parts(led: Int64[np.ndarray, " k"], edges: Int64[np.ndarray, "e 2"], n: int) -> Bool[np.ndarray, " n"]:
    """Nodes of the grid's separate parts in which nothing is led."""
    graph = sparse.csr_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
    _, part = connected_components(graph, directed=False)
    return ~np.isin(part, part[led])


def _tip_nodes(puppet: Puppet, limb: Limb) -> Int64[np.ndarray, " k"]:
    reach = np.linalg.norm(puppet.nodes[limb.nodes] - limb.tip, axis=1)
    return limb.nodes[reach < max(1.5 * puppet.cell, TIP * limb.length)]
