"""OBJ reader: a part per object and material, polygons as fans of triangles, textures of the MTL files beside it."""

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dg4d_lib.assets.formats.mtl import Material, library_names, read_mtl
from dg4d_lib.errors import BadInput
from dg4d_lib.mesh.models.model import Model, ModelPart, to_linear

Read = Callable[[str], bytes | None]  # content of a file beside the model, by its name; None if it is missing
Decode = Callable[[bytes, str], NDArray[np.uint8]]
_CONTINUED = re.compile(r"\\\r?\n")  # a backslash at the end of a line
FLOAT_COLORS = 2.0  # largest color of a file with floats, which may exceed 1 a little; others have colors of 0 to 255
_NAMING = ("o", "g", "usemtl", "mtllib")  # statements of names, where "#" begins no comment


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
    for number, line in enumerate(_CONTINUED.sub(" ", text).splitlines(), 1):
        try:
            content.add(_words(line))
        except (ValueError, IndexError) as error:
            raise BadInput(f"line {number} of the OBJ cannot be read ({error}); export the model again") from error
    if not content.faces:
        raise BadInput("the model has no faces; give a mesh with triangles")
    return content.model(decode)


def _words(line: str) -> list[str]:
    """Return the words of a line without its comment."""
    words = line.split()
    return words if words and words[0] in _NAMING else line.split("#", 1)[0].split()


class _Content:
    """Statements of an OBJ read so far."""

    def __init__(self, read: Read, max_faces: int) -> None:
        self.read, self.max_faces = read, max_faces
        self.positions: list[tuple[float, ...]] = []
        self.colors: list[tuple[float, ...]] = []  # of the positions; empty where a line has none
        self.uvs: list[tuple[float, float]] = []
        self.materials: dict[str, Material] = {}
        self.groups: dict[tuple[str, str], _Group] = {}
        self.name, self.material, self.faces = "model", "", 0

    def add(self, words: list[str]) -> None:
        """Read the words of a line."""
        match words[:1]:
            case ["v"]:
                x, y, z = map(float, words[1:4])
                self.positions.append((x, y, z))
                self.colors.append(tuple(map(float, words[4:7])))
            case ["vt"]:
                self.uvs.append((float(words[1]), 1 - float(words[2])))
            case ["o" | "g"]:
                self.name = " ".join(words[1:]) or "model"
            case ["usemtl"]:
                self.material = " ".join(words[1:])
            case ["mtllib"]:
                for name in library_names(" ".join(words[1:])):
                    content = self.read(name)  # without it materials are gray, as in players
                    self.materials |= read_mtl((content or b"").decode("utf-8", "replace"))
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
        with np.errstate(over="ignore"):
            points = np.array(self.positions, np.float64).astype(np.float32).reshape(-1, 3)
        if not np.isfinite(points).all():
            raise BadInput("the model has vertices that are not finite numbers (NaN or infinity); export it again")
        colored = np.array(self.colors, float) if all(len(row) == 3 for row in self.colors) else None
        if colored is not None and not np.isfinite(colored).all():
            colored = None
        if colored is not None and colored.max() > FLOAT_COLORS:
            colored = colored / 255
        coordinates = np.array([*self.uvs, (0.0, 1.0)])  # the last one, at index -1, is 0 0 of the file, as in players
        unknown = Material() if colored is None else Material((1.0, 1.0, 1.0))
        pictures: dict[str, NDArray[np.uint8]] = {}
        parts = []
        for group in self.groups.values():
            if group.corners:
                known = self.materials.get(group.material, unknown)
                texture = read_texture(known.textures, self.read, decode, pictures)
                parts.append(_part(group, points, coordinates, colored, known, texture))
        return Model(tuple(parts))


def _corner(word: str, positions: int, uvs: int) -> tuple[int, int]:
    """Return the indices of one corner, written as v, v/vt, v//vn or v/vt/vn, from 1 or backwards from -1.

    Texture coordinates that are not there are left out, as players do.
    """
    fields = word.split("/")
    place, uv = _index(fields[0], positions), _index(fields[1], uvs) if len(fields) > 1 and fields[1] else -1
    if not 0 <= place < positions:
        raise ValueError(f"the index {fields[0]} is out of range: {positions} are defined so far")
    return place, uv if 0 <= uv < uvs else -1


def _index(text: str, count: int) -> int:
    """Return the index from 0 of one from 1, or backwards from -1; 0 and what lies before the first are negative."""
    value = int(text)
    return value - 1 if value >= 0 else count + value


def read_texture(
    names: tuple[str, ...], read: Read, decode: Decode, pictures: dict[str, NDArray[np.uint8]]
) -> NDArray[np.uint8] | None:
    """Return the picture of the first of the names that is there, None without names."""
    for name in names:
        if name not in pictures:
            content = read(name)
            if content is None:
                continue
            pictures[name] = decode(content, name)
        return pictures[name]
    if names:
        raise BadInput(f"the texture {names[-1][:80]!r} of the model is missing; put it beside the model")
    return None


def _part(
    group: _Group,
    points: NDArray[np.float32],
    uvs: NDArray[np.float64],
    colors: NDArray[np.float64] | None,
    material: Material,
    texture: NDArray[np.uint8] | None,
) -> ModelPart:
    pairs, faces = np.unique(np.array(group.corners), axis=0, return_inverse=True)
    textured = bool((pairs[:, 1] >= 0).any())
    factor = (1.0, 1.0, 1.0) if texture is not None else tuple(map(float, to_linear(np.array(material.color))))
    return ModelPart(
        f"{group.name} {group.material}".strip(),
        points[pairs[:, 0]],
        faces.reshape(-1, 3),
        uvs[pairs[:, 1]] if textured else None,
        texture if textured else None,
        (factor[0], factor[1], factor[2]),
        None if colors is None else to_linear(colors[pairs[:, 0]]),
    )
