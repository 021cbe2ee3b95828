"""What kind of surface a mesh is: closed or open, turned outwards or not, with or without flaws."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

FLATTEST = 1e-6  # height over longest side, below which a triangle has no area; rounding moves corners by as much


@dataclass(frozen=True)
class MeshFacts:
    """Counts that say what a mesh is good for.

    Attributes:
        triangles: all of them.
        components: pieces that hang together by shared vertices.
        boundary: edges of one triangle: rims of holes.
        crowded: edges of more than two triangles.
        twisted: edges whose two triangles do not agree on which side is outside.
        flat: triangles without area.
        inverted: components whose inside is outside.
    """

    triangles: int
    components: int
    boundary: int
    crowded: int
    twisted: int
    flat: int
    inverted: int

    @property
    def watertight(self) -> bool:
        """Whether every edge belongs to exactly two triangles that agree on the outside: the mesh bounds a solid."""
        return not self.boundary and not self.crowded and not self.twisted

    @property
    def sound(self) -> bool:
        """Whether it is watertight, its outside outside, and no triangle without area."""
        return self.watertight and not self.inverted and not self.flat

    def __str__(self) -> str:
        """One line for people."""
        if self.watertight:
            kind = "watertight"
        elif self.boundary:
            kind = f"open, {_of(self.boundary, 'edge')} on the rims of holes"
        else:
            kind = "closed, but bounds no solid"
        flaws = (
            f"{_of(self.crowded, 'edge')} of more than two triangles" if self.crowded else "",
            f"{_of(self.twisted, 'edge')} between opposite sides" if self.twisted else "",
            f"{_of(self.flat, 'triangle')} without area" if self.flat else "",
        )
        parts = (kind, _of(self.components, "component"), f"{self.inverted} inverted", *filter(None, flaws))
        return ", ".join(parts)


def checked(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> MeshFacts:
    """Look at a mesh.

    Args:
        vertices: any units; vertices at the same place are different ones: weld what is split at seams.
        faces: counter-clockwise seen from outside.
    """
    starts, ends = faces.ravel(), np.roll(faces, -1, 1).ravel()
    there = starts < ends
    pairs = np.stack([np.where(there, starts, ends), np.where(there, ends, starts)], 1)
    _, edge, uses = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
    ways = np.bincount(edge.ravel(), np.where(there, 1, -1), minlength=len(uses))  # 0 where two triangles agree
    volumes = _volumes(vertices, faces, _pieces(len(vertices), faces))
    return MeshFacts(
        triangles=len(faces),
        components=len(volumes),
        boundary=int((uses == 1).sum()),
        crowded=int((uses > 2).sum()),
        twisted=int(((uses == 2) & (ways != 0)).sum()),
        flat=int(_flat(vertices, faces).sum()),
        inverted=int((volumes < 0).sum()),
    )


def welded(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "f 3"]]:
    """The mesh as it was before it was split along the seams of a texture: equal places are one vertex."""
    places, place = np.unique(vertices, axis=0, return_inverse=True)
    return places, place.ravel()[faces]


def outward(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "f 3"]:
    """The faces, those of inverted components turned round; triangles of a component must agree with each other."""
    pieces = _pieces(len(vertices), faces)
    inverted = (_volumes(vertices, faces, pieces) < 0)[pieces]
    return np.where(inverted[:, None], faces[:, ::-1], faces)


def _pieces(count: int, faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, " f"]:
    """The number of the component of every triangle, from 0 on."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]]).T
    graph = coo_array((np.ones(ends.shape[1], bool), tuple(ends)), shape=(count, count))
    labels = connected_components(graph, directed=False)[1][faces[:, 0]]
    return np.unique(labels, return_inverse=True)[1]


def _volumes(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], pieces: Int[np.ndarray, " f"]
) -> Float[np.ndarray, " c"]:
    """The signed volume of every component; an open one is closed by a cone to its own middle."""
    corners = vertices[faces].astype(np.float64)
    sums = np.stack([np.bincount(pieces, corners[..., axis].mean(1)) for axis in range(3)], 1)
    middles = sums / np.bincount(pieces)[:, None]
    a, b, c = np.moveaxis(corners - middles[pieces][:, None], 1, 0)
    return np.bincount(pieces, np.einsum("fi,fi->f", a, np.cross(b, c)) / 6).astype(np.float64)


def _flat(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> np.ndarray:
    corners = vertices[faces].astype(np.float64)
    sides = np.roll(corners, -1, 1) - corners
    doubled = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    longest2 = np.square(sides).sum(-1).max(1)
    return doubled <= FLATTEST * longest2


def _of(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"
