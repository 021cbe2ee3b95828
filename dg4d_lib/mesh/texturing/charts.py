"""Segmentation of a surface into few charts that flatten with little distortion.

Charts are split in two until each is a disk that flattens without overlap and with an even texel density, and are then
merged again where the union passes the same test; if many are left, within wider limits. A split groups the faces
around two directions of normals, by growth over the surface (Sander et al. 2003, section 3).
"""

import heapq
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from dg4d_lib.kernels.compiling import njit
from dg4d_lib.mesh.neighbors import half_edges, twin_half_edges
from dg4d_lib.mesh.texturing.flatten import flat_areas, flatten, overlapping

DENSITIES = (0.72, 1.35)  # bounds of the linear texel density in a chart, relative to its mean
LLOYD = 4  # rounds of new seeds and growth per split
TURN_COST = 1.05  # cost of growth per length along normals at a right angle to the seed's; 0.05 along equal ones
SMOOTHING = 10  # maximum rounds over all faces that straighten borders
ROUNDS = 20  # maximum rounds of merges
MANY = 40  # charts above which some are merged within wider limits

Array = NDArray[np.float64]
Labels = NDArray[np.int64]


@dataclass(frozen=True)
class Limits:
    """Limits of the area, the outline and the texel density of a chart.

    Attributes:
        largest: share of the surface; small charts fill a texture better.
        raggedest: outline of a merged chart over the square root of its area: a circle has 3.5, a strip 1 x 10 7.0.
        outside: share of its area that may lie below, and above, the bounds of the texel density.
    """

    largest: float
    raggedest: float
    outside: float


NARROW, WIDE = Limits(1 / 20, 6.5, 0.005), Limits(1 / 12, 8.0, 0.02)


@dataclass(frozen=True)
class Charts:
    """Flattened charts of a mesh.

    Attributes:
        labels: chart of every face.
        sources: vertex of the mesh that every new vertex copies; vertices are split along seams.
        faces: the faces in their order, with new vertices.
        flat: position of every new vertex in the plane of its chart, units of the mesh; counter-clockwise with v up.
    """

    labels: Int[np.ndarray, " f"]
    sources: Int[np.ndarray, " w"]
    faces: Int[np.ndarray, "f 3"]
    flat: Float[np.ndarray, "w 2"]


def find_charts(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], smooth: Float[np.ndarray, "v 3"]
) -> Charts:
    """Segment a surface and flatten its charts.

    Args:
        vertices: any units.
        faces: counter-clockwise seen from outside.
        smooth: a smoothed copy of the vertices, whose normals guide the segmentation.
    """
    surface = _Surface(vertices.astype(np.float64), faces.astype(np.int64), smooth.astype(np.float64))
    labels = surface.connected(np.zeros(len(faces), np.int64))
    failed = ~surface.passes(labels, np.ones(len(faces), bool), NARROW)[labels]
    while failed.any():
        labels = surface.connected(surface.split(labels, failed))
        failed = failed & ~surface.passes(labels, failed, NARROW)[labels]
    labels = _merged(surface, labels, NARROW, least=1)
    limits = NARROW
    if labels.max() >= MANY:
        limits, labels = WIDE, _merged(surface, labels, WIDE, least=MANY)
    return surface.flattened(_straightened(surface, labels, limits))


def _merged(surface: "_Surface", labels: Labels, limits: Limits, least: int) -> Labels:
    """Merge neighbors as long as the union passes the test, down to some charts; the most enclosed go first."""
    refused: set[tuple[int, int]] = set()
    for _ in range(ROUNDS):
        pairs: list[tuple[int, int]] = []
        taken: set[int] = set()
        excess = len(np.unique(labels)) - least
        for first, second in surface.neighbors(labels, limits):
            if len(pairs) == excess:
                break
            if (first, second) not in refused and not {first, second} & taken:
                pairs.append((first, second))
                taken |= {first, second}
        if not pairs:
            break
        united = np.arange(labels.max() + 1)
        for first, second in pairs:
            united[second] = first
        merged = united[labels]
        passed = surface.passes(merged, np.isin(labels, list(taken)), limits)
        fresh = labels.max() + 1
        for first, second in pairs:
            if passed[first]:
                # a new label, so that merges that were refused for its parts are tried again
                labels = np.where(merged == first, fresh, labels)
                fresh += 1
            else:
                refused.add((first, second))
    return np.asarray(np.unique(labels, return_inverse=True)[1].ravel())


def _straightened(surface: "_Surface", labels: Labels, limits: Limits) -> Labels:
    """Straighten the borders between all charts that pass the test afterwards."""
    fixed = np.zeros(labels.max() + 1, bool)
    everywhere = np.ones(len(labels), bool)
    while not fixed.all():
        straight = surface.straightened(labels, movable=~fixed[labels])
        parts = surface.connected(straight)
        pieces = np.bincount(straight[np.unique(parts, return_index=True)[1]], minlength=len(fixed))
        passed = np.zeros(len(fixed), bool)
        passed[: straight.max() + 1] = surface.passes(straight, everywhere, limits)
        failed = (pieces != 1) | ~passed  # a chart without faces has no piece
        if not (failed & ~fixed).any():
            return straight
        fixed |= failed
    return labels


class _Surface:
    """A mesh, its faces' neighbors, areas, centers and smoothed normals."""

    def __init__(self, vertices: Array, faces: NDArray[np.int64], smooth: Array) -> None:
        self.vertices, self.faces = vertices, faces
        self.centers = smooth[faces].mean(1)
        areas = np.cross(smooth[faces[:, 1]] - smooth[faces[:, 0]], smooth[faces[:, 2]] - smooth[faces[:, 0]]) / 2
        self.areas = np.linalg.norm(areas, axis=1)
        self.normals = areas / np.maximum(self.areas, np.finfo(float).tiny)[:, None]
        edges = half_edges(faces)
        self.pairs = twin_half_edges(edges)
        self.lengths = np.linalg.norm(np.diff(vertices[edges], axis=1)[:, 0], axis=1)  # of half edges
        across = np.full(3 * len(faces), -1)
        across[self.pairs] = self.pairs[:, ::-1] // 3
        self.across = across.reshape(-1, 3)
        self._latest: Charts | None = None  # of all faces: the final charts have been flattened for their last test

    def connected(self, labels: Labels) -> Labels:
        """Give every connected part of a chart a label of its own."""
        sides = self.pairs // 3
        kept = sides[labels[sides[:, 0]] == labels[sides[:, 1]]].T
        graph = coo_array((np.ones(kept.shape[1]), tuple(kept)), shape=(len(labels), len(labels)))
        return connected_components(graph, directed=False)[1].astype(np.int64)

    def cut(self, labels: Labels, selected: Bool[np.ndarray, " f"]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Split the vertices of selected faces along the borders of charts; return sources and faces."""
        sides = self.pairs // 3
        kept = self.pairs[(labels[sides[:, 0]] == labels[sides[:, 1]]) & selected[sides[:, 0]] & selected[sides[:, 1]]]
        ahead = kept // 3 * 3 + (kept % 3 + 1) % 3
        joined = np.concatenate([np.stack([kept[:, 0], ahead[:, 1]]), np.stack([ahead[:, 0], kept[:, 1]])], 1)
        count = 3 * len(self.faces)
        graph = coo_array((np.ones(joined.shape[1]), tuple(joined)), shape=(count, count))
        corners = connected_components(graph, directed=False)[1].reshape(-1, 3)[selected]
        _, first, faces = np.unique(corners, return_index=True, return_inverse=True)
        return self.faces[selected].ravel()[first], faces.reshape(-1, 3)

    def passes(self, labels: Labels, selected: Bool[np.ndarray, " f"], limits: Limits) -> Bool[np.ndarray, " c"]:
        """Test the charts of selected faces: disks, without overlap, of even density and compact."""
        count = int(labels.max()) + 1
        single = np.bincount(labels) == 1
        small = np.bincount(labels, self.areas) <= limits.largest * self.areas.sum()
        selected = selected & (small | single)[labels]
        if not selected.any():
            return np.zeros(count, bool)
        _, faces = self.cut(labels, selected)
        names = labels[selected]
        owner = np.zeros(faces.max() + 1, np.int64)
        owner[faces] = names[:, None]
        sides = self.pairs // 3
        inner = selected[sides[:, 0]] & (labels[sides[:, 0]] == labels[sides[:, 1]])
        euler = np.bincount(owner, minlength=count) + np.bincount(labels[sides[inner, 0]], minlength=count)
        euler -= 2 * np.bincount(names, minlength=count)  # vertices - edges + faces, with 3 half edges per face
        passed = euler == 1
        if not passed.any():
            return passed
        charts = self.flattened(labels, selected & passed[labels])
        names = charts.labels
        densities = self.densities(charts, selected & passed[labels])
        shares = [
            np.bincount(names, densities[1] * beyond, count)
            / np.maximum(np.bincount(names, densities[1], count), 1e-30)
            for beyond in (densities[0] < DENSITIES[0], densities[0] > DENSITIES[1])
        ]
        flipped = np.bincount(names, flat_areas(charts.flat, charts.faces) <= 0, count) > 0
        even = ~flipped & (shares[0] <= limits.outside) & (shares[1] <= limits.outside)
        return passed & (single | (even & ~overlapping(charts.flat, charts.faces, names, count)))

    def densities(self, charts: Charts, selected: Bool[np.ndarray, " f"]) -> tuple[Array, Array]:
        """Return the linear texel density of selected faces relative to the mean of their chart, and their areas."""
        corners = self.vertices[self.faces[selected]]
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        flat = flat_areas(charts.flat, charts.faces).clip(0)  # negative where a face is mirrored
        return np.sqrt(flat / np.maximum(areas, np.finfo(float).tiny)), areas

    def flattened(self, labels: Labels, selected: Bool[np.ndarray, " f"] | None = None) -> Charts:
        """Flatten the charts of selected faces, which must be disks."""
        selected = np.ones(len(labels), bool) if selected is None else selected
        if self._latest is not None and selected.all() and np.array_equal(labels, self._latest.labels):
            return self._latest
        sources, faces = self.cut(labels, selected)
        names, disk = np.unique(labels[selected], return_inverse=True)
        flat = flatten(self.vertices[sources], faces, disk.ravel(), len(names))
        charts = Charts(labels[selected], sources, faces, flat)
        self._latest = charts if selected.all() else self._latest
        return charts

    def split(self, labels: Labels, selected: Bool[np.ndarray, " f"]) -> Labels:
        """Split the charts of selected faces in two by their normals."""
        names = np.unique(labels[selected])
        if len(names) == 0:
            return labels
        members = [np.flatnonzero(labels == name) for name in names]
        sides = [side for faces in members for side in self._sides(faces)]
        owner = labels
        for _ in range(LLOYD):
            seeds = np.array([self._middle(side) for side in sides])
            proxies = np.stack([self._direction(side) for side in sides])
            owner = _grow(self.across, labels, self.centers, self.normals, seeds, proxies)
            sides = [np.flatnonzero(owner == index) for index in range(len(sides))]
        fresh = labels.max() + 1
        return np.where(owner >= 0, owner + fresh, labels)

    def _sides(self, faces: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Divide faces along the direction in which their normals vary most, or their centers if they are flat."""
        weights = self.areas[faces] / self.areas[faces].sum()
        for values in (self.normals[faces], self.centers[faces]):
            spread = values - weights @ values
            variances, axes = np.linalg.eigh((spread * weights[:, None]).T @ spread)
            along = spread @ axes[:, -1]
            if variances[-1] > 1e-3 and (along > 0).any() and (along < 0).any():
                break
        order = np.argsort(along, kind="stable")
        part = max(1, len(faces) // 3)
        return faces[order[:part]], faces[order[-part:]]

    def _middle(self, faces: NDArray[np.int64]) -> int:
        center = np.average(self.centers[faces], axis=0, weights=self.areas[faces] + 1e-30)
        return int(faces[np.square(self.centers[faces] - center).sum(1).argmin()])

    def _direction(self, faces: NDArray[np.int64]) -> Array:
        total = self.areas[faces] @ self.normals[faces]
        return np.asarray(total / max(np.linalg.norm(total), 1e-30))

    def straightened(self, labels: Labels, movable: Bool[np.ndarray, " f"]) -> Labels:
        """Let movable faces join the chart of a movable neighbor if that shortens the border."""
        straight = labels.copy()
        _straighten(self.across, movable, self.lengths.reshape(-1, 3), straight)
        return straight

    def neighbors(self, labels: Labels, limits: Limits) -> list[tuple[int, int]]:
        """Return pairs of charts that share a border, the most enclosed first, without large and ragged unions."""
        count = int(labels.max()) + 1
        sides = np.sort(labels[self.pairs // 3], 1)
        border = sides[:, 0] != sides[:, 1]
        keys, index = np.unique(sides[border, 0] * count + sides[border, 1], return_inverse=True)
        shared = np.bincount(index.ravel(), self.lengths[self.pairs[border, 0]])
        first, second = keys // count, keys % count
        outlines = np.bincount(labels, self.lengths.reshape(-1, 3).sum(1), count)
        inner = ~border
        outlines -= np.bincount(sides[inner, 0], 2 * self.lengths[self.pairs[inner, 0]], count)
        areas = np.bincount(labels, self.areas, count)
        left_out = areas[first] + areas[second] > limits.largest * areas.sum()
        longest = limits.raggedest * np.sqrt(areas[first] + areas[second])
        left_out |= outlines[first] + outlines[second] - 2 * shared > longest
        enclosed = shared / np.maximum(np.minimum(outlines[first], outlines[second]), 1e-30)
        order = np.argsort(-enclosed, kind="stable")
        return [(int(first[i]), int(second[i])) for i in order if not left_out[i]]


@njit(cache=True, nogil=True)
@no_type_check
def _straighten(across, movable, lengths, labels):
    """Give faces, one after the other, the label of a neighbor whose common border is longer than the rest."""
    for _ in range(SMOOTHING):
        changed = 0
        for face in range(len(labels)):
            if not movable[face]:
                continue
            best, gain = -1, 0.0
            for k in range(3):
                beside = across[face, k]
                if beside < 0 or labels[beside] == labels[face] or not movable[beside]:
                    continue
                change = 0.0
                for j in range(3):
                    other = across[face, j]
                    if other < 0:
                        continue
                    if labels[other] == labels[beside]:
                        change += lengths[face, j]
                    elif labels[other] == labels[face]:
                        change -= lengths[face, j]
                if change > gain + 1e-12:
                    best, gain = labels[beside], change
            if best >= 0:
                labels[face] = best
                changed += 1
        if changed == 0:
            break


@njit(cache=True, nogil=True)
@no_type_check
def _grow(across, labels, centers, normals, seeds, proxies):
    """Grow regions from seeds within their charts, cheapest faces first; return the region of every face or -1."""
    owner = np.full(len(labels), -1)
    heap = [(0.0, seeds[0], 0)]
    for region in range(1, len(seeds)):
        heapq.heappush(heap, (0.0, seeds[region], region))
    while len(heap) > 0:
        cost, face, region = heapq.heappop(heap)
        if owner[face] >= 0:
            continue
        owner[face] = region
        for k in range(3):
            beside = across[face, k]
            if beside < 0 or owner[beside] >= 0 or labels[beside] != labels[face]:
                continue
            length = np.sqrt(np.square(centers[beside] - centers[face]).sum())
            turn = TURN_COST - (normals[beside] * proxies[region]).sum()
            heapq.heappush(heap, (cost + turn * length, beside, region))
    return owner
