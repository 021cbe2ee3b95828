"""Triangles and morph targets as glTF accessors, in float32 or quantized.

Quantization (KHR_mesh_quantization) uses 8 bits for normals at rest and 16 bits for the rest. Positions are integer
points of a cube around all poses, and the node's transform scales the cube. A position and its displacement are rounded
together, so moved vertices are as exact as vertices at rest: half a step of the cube on each axis. Morph targets of
normals must lie in [-1, 1]; where a change is larger, the target is a shorter normal of the right direction, which
players normalize. Poses in which many normals have turned too far for that keep float32.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dg4d_lib.assets.formats.gltf import INDEX_DATA, VERTEX_DATA, GltfDocument
from dg4d_lib.assets.formats.normals import SmoothNormals

QUANTIZATION = "KHR_mesh_quantization"
MAX_SHORT_INDEX = 65534  # glTF forbids index 65535, the primitive restart value
_SHORT, _BYTE, _UNSIGNED_SHORT = 32767, 127, 65535
SHORTEST = 1e-3  # minimum length of a turned normal; shorter ones have too few bits for their direction
LOST = 0.01  # share of normals that may be shorter, which is noise of thin parts; more would be visible
_ROOM = 1.0001  # margin of the cube around the largest displacement, which is rounded twice

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class QuantizationCube:
    """Cube that 16-bit integer positions are relative to.

    Attributes:
        center: world units.
        half_side: world units, the integer 32767.
    """

    center: NDArray[np.float64]
    half_side: float

    @classmethod
    def around(cls, positions: Sequence[Floats], displacements: Iterable[Floats] = ()) -> "QuantizationCube":
        """Create a cube that contains all positions and is at least as large as any displacement."""
        low = np.min([rows.min(0) for rows in positions], axis=0).astype(np.float64)
        high = np.max([rows.max(0) for rows in positions], axis=0).astype(np.float64)
        farthest = max((float(np.abs(rows).max()) for rows in displacements), default=0.0)
        side = max(float((high - low).max()) / 2, farthest) * _ROOM
        return cls((low + high) / 2, side or 1.0)

    @property
    def max_error(self) -> float:
        """Maximum error of a vertex along an axis, world units."""
        return self.half_side / _SHORT / 2

    def quantize(self, positions: Floats) -> NDArray[np.int32]:
        """Round positions to integer points of the cube; positions outside exceed 16 bits."""
        return np.rint((positions - self.center) * (_SHORT / self.half_side)).astype(np.int32)

    def node_transform(self) -> dict[str, list[float]]:
        """Return the node properties that map integer points to the world."""
        return {"translation": self.center.tolist(), "scale": [self.half_side] * 3}


class MeshPrimitive:
    """Accessors of a mesh in a document, to which poses can be added as morph targets.

    Attributes:
        attributes: accessor indices of the vertex attributes, as in a glTF primitive.
        indices: accessor index of the triangles.
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
        """Add a mesh at rest.

        Args:
            document: document to extend.
            name: prefix of the accessor names.
            vertices: world units.
            faces: indices into the vertices.
            uvs: texture coordinates in [0, 1].
            cube: for quantized positions; None for float32.
        """
        self._document, self._vertices, self._cube = document, vertices, cube
        self._normals_of = SmoothNormals(vertices, faces)
        self._normals: Floats = self._normals_of(vertices)
        rows: tuple[NDArray[Any], ...] = (vertices, self._normals, uvs)
        if cube is not None:
            document.use_extension(QUANTIZATION, required=True)
            normals, positions = _normalized(self._normals, _BYTE, "i1"), cube.quantize(vertices).astype("<i2")
            rows = (positions, normals, _normalized(uvs.clip(0, 1), _UNSIGNED_SHORT, "<u2"))
            self._normals = (normals / _BYTE).astype(np.float32)  # as readers decode them
        names = {"POSITION": "positions", "NORMAL": "normals", "TEXCOORD_0": "texture coordinates"}
        self.attributes = {
            key: self._add(f"{name} {noun}", values) for (key, noun), values in zip(names.items(), rows, strict=True)
        }
        width = "<u2" if len(vertices) <= MAX_SHORT_INDEX + 1 else "<u4"
        self.indices = document.add_accessor(f"{name} triangles", faces.ravel().astype(width), INDEX_DATA)

    def add_pose(self, name: str, offsets: Floats, *, normals: bool) -> dict[str, int]:
        """Add a morph target; return its accessor indices.

        Args:
            name: prefix of the accessor names.
            offsets: of the vertices, world units.
            normals: True if normals follow the surface; else they keep their values at rest.
        """
        moved = self._vertices + offsets
        if self._cube is None:
            target = {"POSITION": self._add(f"{name} positions", offsets)}
        else:
            steps = self._cube.quantize(moved) - self._cube.quantize(self._vertices)
            target = {"POSITION": self._add(f"{name} positions", steps.astype("<i2"))}
        if normals:
            turned = self._normals_of(moved)
            changes: NDArray[Any] = turned - self._normals
            lengths = _max_lengths(turned, self._normals)
            if self._cube is not None and (lengths <= SHORTEST).mean() <= LOST:
                changes = _normalized(lengths * turned - self._normals, _SHORT, "<i2")
            target["NORMAL"] = self._add(f"{name} normals", changes)
        return target

    def _add(self, name: str, rows: NDArray[Any]) -> int:
        return self._document.add_accessor(name, rows, VERTEX_DATA, normalized=rows.dtype.kind in "iu")


def _max_lengths(turned: Floats, normals: Floats) -> Floats:
    """Return the maximum lengths, up to 1, of the turned normals at which their changes stay in [-1, 1]."""
    with np.errstate(divide="ignore"):
        reach = (1 + np.sign(turned) * normals) / np.abs(turned)
    return np.min(reach, axis=1, keepdims=True).clip(SHORTEST, 1).astype(np.float32)


def _normalized(values: Floats, largest: int, dtype: str) -> NDArray[Any]:
    return np.rint(values.clip(-1, 1) * np.float32(largest)).astype(dtype)
