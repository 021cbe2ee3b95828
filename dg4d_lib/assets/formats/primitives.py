"""Triangles, and what moves them, as accessors of a glTF document: in floats, or in fewer bits.

Fewer bits (KHR_mesh_quantization): normals at rest in eight, all else in sixteen. Places are points of a cube around
everything, which a node carries; a place and its displacement are rounded together, so that a moved vertex is never
further from its true place than a vertex at rest: half a step of the cube on each axis. Changes of normals have to lie
in [-1, 1] then; where one does not, it leads to a shorter normal of the right direction, and players make that a unit.
A pose in which many normals have turned too far even for that keeps floats.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dg4d_lib.assets.formats.gltf import INDEX_DATA, VERTEX_DATA, GltfDocument
from dg4d_lib.assets.formats.normals import SmoothNormals

QUANTIZATION = "KHR_mesh_quantization"
MAX_SHORT_INDEX = 65534  # 65535 restarts primitives on some devices and is forbidden
_SHORT, _BYTE, _UNSIGNED_SHORT = 32767, 127, 65535
SHORTEST = 1e-3  # of normals that turned; shorter ones have too few bits left for their direction
LOST = 0.01  # share of normals that may be shorter (noise of thin parts, which turns over); a chest's side may not
_ROOM = 1.0001  # of the cube around the largest displacement, which is rounded twice

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class QuantizationCube:
    """Where whole numbers of 16 bits lie in the world.

    Attributes:
        center: world units.
        half_side: world units; of the number 32767.
    """

    center: NDArray[np.float64]
    half_side: float

    @classmethod
    def around(cls, places: Sequence[Floats], displacements: Iterable[Floats] = ()) -> "QuantizationCube":
        """A cube that holds all places, and is not smaller than any displacement."""
        low = np.min([rows.min(0) for rows in places], axis=0).astype(np.float64)
        high = np.max([rows.max(0) for rows in places], axis=0).astype(np.float64)
        farthest = max((float(np.abs(rows).max()) for rows in displacements), default=0.0)
        side = max(float((high - low).max()) / 2, farthest) * _ROOM
        return cls((low + high) / 2, side or 1.0)

    @property
    def largest_error(self) -> float:
        """Of a vertex along an axis, world units."""
        return self.half_side / _SHORT / 2

    def numbers(self, places: Floats) -> NDArray[np.int32]:
        """The nearest points of the cube; beyond 16 bits where places lie outside."""
        return np.rint((places - self.center) * (_SHORT / self.half_side)).astype(np.int32)

    def placement(self) -> dict[str, list[float]]:
        """How a node carries the cube."""
        return {"translation": self.center.tolist(), "scale": [self.half_side] * 3}


class MeshPrimitive:
    """A mesh at rest, added to a document; poses can be added to it.

    Attributes:
        attributes: of its vertices, as glTF wants them.
        indices: the accessor of its triangles.
    """

    def __init__(
        self,
        document: GltfDocument,
        name: str,
        vertices: Floats,
        faces: NDArray[np.integer[Any]],
        uvs: Floats,
        cube: QuantizationCube | None,
    ) -> None:
        """Add a mesh.

        Args:
            document: it is added to.
            name: its accessors begin with.
            vertices: world units.
            faces: indices into the vertices.
            uvs: texture coordinates in [0, 1].
            cube: where whole numbers lie; None: floats.
        """
        self._document, self._vertices, self._cube = document, vertices, cube
        self._normals_of = SmoothNormals(vertices, faces)
        self._normals: Floats = self._normals_of(vertices)
        rows: tuple[NDArray[Any], ...] = (vertices, self._normals, uvs)
        if cube is not None:
            document.use(QUANTIZATION, required=True)
            normals, places = _shares(self._normals, _BYTE, "i1"), cube.numbers(vertices).astype("<i2")
            rows = (places, normals, _shares(uvs.clip(0, 1), _UNSIGNED_SHORT, "<u2"))
            self._normals = (normals / _BYTE).astype(np.float32)  # what readers see
        names = {"POSITION": "positions", "NORMAL": "normals", "TEXCOORD_0": "texture coordinates"}
        self.attributes = {
            key: self._add(f"{name} {what}", values) for (key, what), values in zip(names.items(), rows, strict=True)
        }
        width = "<u2" if len(vertices) <= MAX_SHORT_INDEX + 1 else "<u4"
        self.indices = document.add_accessor(f"{name} triangles", faces.ravel().astype(width), INDEX_DATA)

    def add_pose(self, name: str, offsets: Floats, *, normals: bool) -> dict[str, int]:
        """A morph target.

        Args:
            name: its accessors begin with.
            offsets: of the vertices, world units.
            normals: turn with the surface; else they stay those at rest.
        """
        moved = self._vertices + offsets
        if self._cube is None:
            target = {"POSITION": self._add(f"{name} positions", offsets)}
        else:
            steps = self._cube.numbers(moved) - self._cube.numbers(self._vertices)
            target = {"POSITION": self._add(f"{name} positions", steps.astype("<i2"))}
        if normals:
            turned = self._normals_of(moved)
            changes: NDArray[Any] = turned - self._normals
            lengths = _longest(turned, self._normals)
            if self._cube is not None and (lengths <= SHORTEST).mean() <= LOST:
                changes = _shares(lengths * turned - self._normals, _SHORT, "<i2")
            target["NORMAL"] = self._add(f"{name} normals", changes)
        return target

    def _add(self, name: str, rows: NDArray[Any]) -> int:
        return self._document.add_accessor(name, rows, VERTEX_DATA, normalized=rows.dtype.kind in "iu")


def _longest(turned: Floats, normals: Floats) -> Floats:
    """How long the turned normals can be, at most 1, so that the changes from the others stay in [-1, 1]."""
    with np.errstate(divide="ignore"):
        reach = (1 + np.sign(turned) * normals) / np.abs(turned)
    return np.min(reach, axis=1, keepdims=True).clip(SHORTEST, 1).astype(np.float32)


def _shares(values: Floats, largest: int, dtype: str) -> NDArray[Any]:
    return np.rint(values.clip(-1, 1) * np.float32(largest)).astype(dtype)
