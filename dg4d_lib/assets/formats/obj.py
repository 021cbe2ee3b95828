"""OBJ reader: a part per object and material, polygons as fans of triangles, textures of the MTL files beside it."""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dg4d_lib.errors import BadInput
from dg4d_lib.mesh.models.model import Model, ModelPart, to_linear

Read = Callable[[str], bytes | None]  # content of a file beside the model, by its name; None if it is missing
Decode = Callable[[bytes, str], NDArray[np.uint8]]


@dataclass
class _Material:
    """Base color of a material."""

    color: tuple[float, float, float] = (0.8, 0.8, 0.8)
    texture: str = ""


@dataclass
class _Group:
    """Corners of the triangles of one object and material: indices of positions and texture coordinates, or -1."""

    name: str
    material: str
    corners: list[tuple[int, int]] = field(default_factory=list)


def read_obj(text: str, read: Read, decode: Decode, max_faces: int) -> Model:
    """Read an OBJ.

    Args:
        text: content.
        read: reads files beside it.
        decode: decodes pictures; given the content and the name.
        max_faces: largest number of triangles.

    Raises:
        BadInput: numbers cannot be read or do not fit, there are no or too many triangles, or a texture is missing.
    """
    content = _Content(read, max_faces)
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#", 1)[0].split()
        try:
            content.add(words)
        except (ValueError, IndexError) as error:
            raise BadInput(f"line {number} of the OBJ cannot be read ({error}); export the model again") from error
    if not content.faces:
        raise BadInput("the model has no faces; give a mesh with triangles")
    return content.model(decode)


class _Content:
    """Statements of an OBJ read so far."""

    def __init__(self, read: Read, max_faces: int) -> None:
        self.read, self.max_faces = read, max_faces
        self.positions: list[tuple[float, ...]] = []
        self.uvs: list[tuple[float, float]] = []
        self.materials: dict[str, _Material] = {}
        self.groups: dict[tuple[str, str], _Group] = {}
        self.name, self.material, self.faces = "model", "", 0

    def add(self, words: list[str]) -> None:
        """Read the words of a line."""
        match words[:1]:
            case ["v"]:
                self.positions.append(tuple(map(float, words[1:7])))
            case ["vt"]:
                self.uvs.append((float(words[1]), 1 - float(words[2])))
            case ["o" | "g"]:
                self.name = " ".join(words[1:]) or "model"
            case ["usemtl"]:
                self.material = " ".join(words[1:])
            case ["mtllib"]:
                _read_materials(self.read(" ".join(words[1:])), self.materials)
            case ["f"]:
                self.add_face([_corner(word, len(self.positions), len(self.uvs)) for word in words[1:]])

    def add_face(self, corners: list[tuple[int, int]]) -> None:
        """Add a polygon as a fan of triangles."""
        key = self.name, self.material
        group = self.groups.setdefault(key, _Group(*key))
        for second, third in pairwise(corners[1:]):
            group.corners += [corners[0], second, third]
        self.faces += max(0, len(corners) - 2)
        if self.faces > self.max_faces:
            raise BadInput(
                f"the model has more than {self.max_faces} triangles, the limit asset.max_faces: simplify it, or raise "
                "the limit with --set asset.max_faces=N"
            )

    def model(self, decode: Decode) -> Model:
        """Return the parts."""
        points = np.array([row[:3] for row in self.positions], float).reshape(-1, 3)
        colored = None
        if all(len(row) == 6 for row in self.positions):
            colored = np.array([row[3:6] for row in self.positions])
        if not np.isfinite(points).all():
            raise BadInput("the model has vertices that are not finite numbers (NaN or infinity); export it again")
        coordinates = np.array(self.uvs, float).reshape(-1, 2)
        pictures: dict[str, NDArray[np.uint8]] = {}
        parts = []
        for group in self.groups.values():
            if group.corners:
                known = self.materials.get(group.material, _Material())
                texture = _texture(known.texture, self.read, decode, pictures)
                parts.append(_part(group, points, coordinates, colored, known, texture))
        return Model(tuple(parts))


def _corner(word: str, positions: int, uvs: int) -> tuple[int, int]:
    """Return the indices of one corner, written as v, v/vt, v//vn or v/vt/vn, from 1 or backwards from -1."""
    fields = word.split("/")
    place = _index(fields[0], positions)
    uv = _index(fields[1], uvs) if len(fields) > 1 and fields[1] else -1
    return place, uv


def _index(text: str, count: int) -> int:
    value = int(text)
    index = value - 1 if value > 0 else count + value
    if value == 0 or not 0 <= index < count:
        raise ValueError(f"the index {value} is out of range: {count} are defined so far")
    return index


def _read_materials(content: bytes | None, materials: dict[str, _Material]) -> None:
    """Add the materials of an MTL; a missing one leaves its materials gray, as players do."""
    current = _Material()
    for line in (content or b"").decode("utf-8", "replace").splitlines():
        words = line.split("#", 1)[0].split()
        if words[:1] == ["newmtl"]:
            current = materials[" ".join(words[1:])] = _Material()
        elif words[:1] == ["Kd"] and len(words) >= 4:
            red, green, blue = map(float, words[1:4])
            current.color = (red, green, blue)
        elif words[:1] == ["map_Kd"] and len(words) > 1:
            current.texture = words[-1].replace("\\", "/")


def _texture(name: str, read: Read, decode: Decode, pictures: dict[str, NDArray[np.uint8]]) -> NDArray[np.uint8] | None:
    if not name:
        return None
    if name not in pictures:
        content = read(name)
        if content is None:
            raise BadInput(f"the texture {name[:80]!r} of the model is missing; put it beside the model")
        pictures[name] = decode(content, name)
    return pictures[name]


def _part(
    group: _Group,
    points: NDArray[np.float64],
    uvs: NDArray[np.float64],
    colors: NDArray[np.float64] | None,
    material: _Material,
    texture: NDArray[np.uint8] | None,
) -> ModelPart:
    pairs, faces = np.unique(np.array(group.corners), axis=0, return_inverse=True)
    textured = bool((pairs[:, 1] >= 0).all()) and len(uvs) > 0
    factor = (1.0, 1.0, 1.0) if texture is not None else tuple(map(float, to_linear(np.array(material.color))))
    return ModelPart(
        f"{group.name} {group.material}".strip(),
        points[pairs[:, 0]].astype(np.float32),
        faces.reshape(-1, 3),
        uvs[pairs[:, 1]] if textured else None,
        texture if textured else None,
        (factor[0], factor[1], factor[2]),
        None if colors is None else to_linear(colors[pairs[:, 0]]),
    )
