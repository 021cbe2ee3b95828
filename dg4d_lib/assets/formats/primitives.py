"""Triangles and morph targets as glTF accessors, in float32 or quantized.

Quantization (KHR_mesh_quantization) uses 8 bits for normals and 16 bits for positions, 14 of them in compressed files.
Positions are integer points of a cube around all poses, and the node's transform scales the cube: plain integers, not
fractions of the largest one, because some readers ignore that flag of an accessor. For the same reason texture
coordinates are float32 unless the file is compressed. Positions of skinned meshes are float32. A position and its
displacement are rounded together, so vertices moved by one morph target are as exact as those of the base: half a step
of the cube on each axis. Errors of principal components, of which several are added, are measured. Morph targets of
normals must lie in [-1, 1]; where a change is larger, the target is a shorter normal of the right direction, which
players normalize. Poses in which many normals have turned too far for that have 16 bits, or float32.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Int
from numpy.typing import NDArray
from torch import Tensor

from dg4d_lib.asset_settings import GltfSettings
from dg4d_lib.assets.formats.gltf import INDEX_DATA, VERTEX_DATA, GltfDocument
from dg4d_lib.assets.formats.meshopt import order_for_compression
from dg4d_lib.assets.formats.normals import SmoothNormals
from dg4d_lib.mesh.textured import TexturedMesh

QUANTIZATION = "KHR_mesh_quantization"
MAX_SHORT_INDEX = 65534  # glTF forbids index 65535, the primitive restart value
STEPS, COMPRESSED_STEPS = 32767, 8191  # of half the side of a cube; fewer steps compress better
_BYTE, _UNSIGNED_SHORT = 127, 65535
_NORMAL_TYPES = (  # integer type of turned normals, its largest value, and the length below which a normal of this type
    ("i1", 127, 0.1),  # has too few bits for its direction
    ("<i2", 32767, 1e-3),
)
LOST = 0.01  # share of normals that may be shorter, which is noise of thin parts; more would be visible
_ROOM = 1.0001  # margin of the cube around the largest displacement, which is rounded twice

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class QuantizationCube:
    """Cube that integer positions are relative to.

    Attributes:
        center: world units.
        half_side: world units, the integer `steps`.
        steps: largest integer.
    """

    center: NDArray[np.float64]
    half_side: float
    steps: int = STEPS

    @classmethod
    def around(
        cls, positions: Sequence[Floats], displacements: Iterable[Floats] = (), steps: int = STEPS
    ) -> "QuantizationCube":
        """Create a cube that contains all positions and is at least as large as any displacement."""
        low = np.min([rows.min(0) for rows in positions], axis=0).astype(np.float64)
        high = np.max([rows.max(0) for rows in positions], axis=0).astype(np.float64)
        farthest = max((float(np.abs(rows).max()) for rows in displacements), default=0.0)
        side = max(float((high - low).max()) / 2, farthest) * _ROOM
        return cls((low + high) / 2, side or 1.0, steps)

    @property
    def step(self) -> float:
        """Distance of neighboring integer points, world units."""
        return self.half_side / self.steps

    @property
    def max_error(self) -> float:
        """Maximum error of a vertex along an axis, world units."""
        return self.step / 2

    def quantize(self, positions: Floats) -> NDArray[np.int32]:
        """Round positions to integer points of the cube; those of positions outside exceed `steps`."""
        return np.rint((positions - self.center) / self.step).astype(np.int32)

    def round(self, positions: Floats) -> Floats:
        """Round positions to a grid as fine as the cube's, of a power of two: float32 with few bits compress well."""
        step = 2.0 ** math.floor(math.log2(self.step))
        return (np.rint(positions / step) * step).astype(np.float32)

    def node_transform(self) -> dict[str, list[float]]:
        """Return the node properties that map integer points to the world."""
        return {"translation": self.center.tolist(), "scale": [self.step] * 3}


def quantization_cube(
    positions: Sequence[Floats], displacements: Iterable[Floats], settings: GltfSettings
) -> QuantizationCube | None:
    """Return the cube around all positions, as in `QuantizationCube.around`; None if the file is not quantized."""
    if not settings.quantized:
        return None
    return QuantizationCube.around(positions, displacements, COMPRESSED_STEPS if settings.meshopt else STEPS)


def reorder_mesh(mesh: TexturedMesh) -> tuple[TexturedMesh, Int[Tensor, " v"]]:
    """Sort vertices and triangles for compression; return the old index of every vertex, too.

    Raises:
        BackendUnavailable: meshoptimizer is missing.
    """
    order, faces = map(torch.from_numpy, order_for_compression(mesh.faces.cpu().numpy(), len(mesh.vertices)))
    return mesh.select(order, faces), order


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
        groups: NDArray[np.integer[Any]],
        *,
        skinned: bool = False,
    ) -> None:
        """Add a mesh in its base pose.

        Args:
            document: document to extend.
            name: prefix of the accessor names.
            vertices: world units.
            faces: indices into the vertices.
            uvs: texture coordinates in [0, 1].
            cube: for quantized positions; None for float32.
            groups: of the vertices that share a normal, as `normal_groups` numbers them.
            skinned: float32 positions also with a cube, because the transform of a node with a skin, which would undo
                the quantization, has no effect.
        """
        self._document, self._vertices, self._cube = document, vertices, cube
        self._normals_of = SmoothNormals(groups, faces)
        self._normals: Floats = self._normals_of(vertices)
        rows: tuple[NDArray[Any], ...] = (vertices, self._normals, uvs)
        if cube is not None:
            document.use_extension(QUANTIZATION, required=True)
            normals = _normalized(self._normals, _BYTE, "i1")
            positions = cube.round(vertices) if skinned else cube.quantize(vertices).astype("<i2")
            rows = (positions, normals, uvs)
            if document.compressed:
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
            normals: True if normals follow the surface; else they keep those of the base.
        """
        target = {"POSITION": self._add_offsets(name, offsets)}
        if normals:
            turned = self._normals_of(self._vertices + offsets)
            changes: NDArray[Any] = turned - self._normals
            if self._cube is not None:
                changes = self._quantize_turned(turned, changes)
            target["NORMAL"] = self._add(f"{name} normals", changes)
        return target

    def component_reach(self, components: Floats) -> Floats:
        """Return the factor, at least 1, by which each component is too large for integer offsets."""
        if self._cube is None:
            return np.ones(len(components), np.float32)
        reach: Floats = (np.abs(components).max((1, 2)) * np.float32(_ROOM / self._cube.half_side)).clip(1)
        return reach

    def add_component(self, name: str, offsets: Floats, changes: Floats | None) -> dict[str, int]:
        """Add a morph target with given changes of normals, if any; return its accessor indices."""
        target = {"POSITION": self._add_offsets(name, offsets)}
        if changes is not None:
            fits = self._cube is not None and np.abs(changes).max(initial=0.0) <= 1
            target["NORMAL"] = self._add(f"{name} normals", _normalized(changes, _BYTE, "i1") if fits else changes)
        return target

    def distances(
        self, components: NDArray[np.floating[Any]], weights: NDArray[np.floating[Any]], offsets: Floats
    ) -> Floats:
        """Return distances from vertices moved by offsets to those moved by components as readers decode them.

        Args:
            components: as given to `add_component`, "k v 3".
            weights: of the components at every frame, "t k".
            offsets: of the vertices at every frame, "t v 3", world units.

        Returns:
            Distances "t v", world units.
        """
        base = self._vertices
        if self._cube is not None:
            base = (self._cube.quantize(base) * self._cube.step + self._cube.center).astype(np.float32)
            components = (self._steps(self._cube, components) * self._cube.step).astype(np.float32)
        missed = (
            base + np.tensordot(row, components, 1) - (self._vertices + pose)
            for row, pose in zip(weights, offsets, strict=True)
        )
        return np.stack([np.linalg.norm(rows, axis=-1) for rows in missed])

    def turn_normals(self, offsets: Floats) -> Floats:
        """Return the changes of the normals when the vertices move by offsets."""
        return self._normals_of(self._vertices + offsets) - self._normals

    def _add_offsets(self, name: str, offsets: Floats) -> int:
        if self._cube is None:
            return self._add(f"{name} positions", offsets)
        return self._add(f"{name} positions", self._steps(self._cube, offsets).astype("<i2"))

    def _steps(self, cube: QuantizationCube, offsets: Floats) -> NDArray[np.int32]:
        """Return offsets as integers, rounded together with the vertices."""
        return cube.quantize(self._vertices + offsets) - cube.quantize(self._vertices)

    def _quantize_turned(self, turned: Floats, changes: Floats) -> NDArray[Any]:
        """Quantize the changes that lead to turned normals, if few normals get too short by that."""
        lengths = _max_lengths(turned, self._normals)
        for dtype, largest, shortest in _NORMAL_TYPES:
            if (lengths <= shortest).mean() <= LOST:
                return _normalized(lengths * turned - self._normals, largest, dtype)
        return changes

    def _add(self, name: str, rows: NDArray[Any]) -> int:
        normalized = rows.dtype.kind in "iu" and not name.endswith("positions")
        return self._document.add_accessor(name, rows, VERTEX_DATA, normalized=normalized)


def _max_lengths(turned: Floats, normals: Floats) -> Floats:
    """Return the maximum lengths, up to 1, of the turned normals at which their changes stay in [-1, 1]."""
    with np.errstate(divide="ignore"):
        reach = (1 + np.sign(turned) * normals) / np.abs(turned)
    return np.min(reach, axis=1, keepdims=True).clip(_NORMAL_TYPES[-1][2], 1).astype(np.float32)


def _normalized(values: Floats, largest: int, dtype: str) -> NDArray[Any]:
    return np.rint(values.clip(-1, 1) * np.float32(largest)).astype(dtype)
