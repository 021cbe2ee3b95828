"""OBJ reader: a part per object and material, polygons as triangles, textures of the MTL files beside it."""

import re
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dg4d_lib.assets.formats.mtl import Material, library_names, read_mtl
from dg4d_lib.errors import BadInput, listed
from dg4d_lib.mesh.models.model import Model, ModelPart, single_precision, to_linear, too_many_triangles
from dg4d_lib.mesh.models.polygons import triangulate

Read = Callable[[str], bytes | None]  # content of a file beside the model, by its name; None if it is missing
Decode = Callable[[bytes, str], NDArray[np.uint8]]
_CONTINUED = re.compile(r"\\\r?\n")  # a backslash at the end of a line
FLOAT_COLORS = 2.0  # largest color of a file with floats, which may exceed 1 a little; others have colors of 0 to 255
MOST_NAMED = 5  # materials or files in a note
_NAMING = ("o", "g", "usemtl", "mtllib")  # statements of names, where "#" begins no comment


@dataclass
class _Group:
    """Polygons of one object and material.

    Attributes:
        name: of the object.
        material: its name.
        corners: of one polygon after the other: indices of a position and of texture coordinates, or -1.
        counts: number of corners of every polygon.
    """

    name: str
    material: str
    corners: list[tuple[int, int]] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)


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
        self.absent: list[str] = []  # MTL files that are missing
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
                self.add_library(" ".join(words[1:]))
            case ["f"]:
                self.add_face([_corner(word, len(self.positions), len(self.uvs)) for word in words[1:]])

    def add_library(self, statement: str) -> None:
        """Read the MTL files that a statement names; without them materials are gray, as in players."""
        found = {name: content for name in library_names(statement) if (content := self.read(name)) is not None}
        for content in found.values():
            self.materials |= read_mtl(content.decode("utf-8-sig", "replace"))
        if not found:
            self.absent.append(statement)

    def add_face(self, corners: list[tuple[int, int]]) -> None:
        """Add a polygon; those of less than three corners are left out."""
        if len(corners) < 3:
            return
        key = self.name, self.material
        group = self.groups.setdefault(key, _Group(*key))
        group.corners += corners
        group.counts.append(len(corners))
        self.faces += len(corners) - 2
        if self.faces > self.max_faces:
            raise too_many_triangles(self.max_faces)

    def model(self, decode: Decode) -> Model:
        """Return the parts."""
        points = np.array(self.positions, np.float64).reshape(-1, 3)
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
            known = self.materials.get(group.material, unknown)
            texture = read_texture(known.textures, self.read, decode, pictures)
            parts.append(_part(group, points, coordinates, colored, known, texture))
        return single_precision(parts, self.notes() if colored is None else ())

    def notes(self) -> list[str]:
        """Return a sentence about materials that are missing, and therefore gray."""
        named = {group.material for group in self.groups.values()} - {""}
        missing = sorted(named - set(self.materials))
        if not missing:
            return []
        absent = _listed(list(dict.fromkeys(self.absent)))
        files = f"; MTL files that are missing beside the model: {absent}" if absent else ""
        return [f"no color was found for the materials {_listed(missing)}{files}"]


def _listed(names: list[str]) -> str:
    return listed([repr(name[:80]) for name in names], MOST_NAMED)


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
    """Convert an index that counts from 1, or backwards from -1, to one from 0; negative for 0 and before the first."""
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
    points: NDArray[np.float64],
    uvs: NDArray[np.float64],
    colors: NDArray[np.float64] | None,
    material: Material,
    texture: NDArray[np.uint8] | None,
) -> ModelPart:
    corners = np.array(group.corners)
    pairs, index = np.unique(corners, axis=0, return_inverse=True)
    faces = index.reshape(-1)[triangulate(points, corners[:, 0], np.array(group.counts))]
    textured = bool((pairs[:, 1] >= 0).any())
    factor = (1.0, 1.0, 1.0) if texture is not None else tuple(map(float, to_linear(np.array(material.color))))
    return ModelPart(
        f"{group.name} {group.material}".strip(),
        points[pairs[:, 0]],
        faces,
        uvs[pairs[:, 1]] if textured else None,
        texture if textured else None,
        (factor[0], factor[1], factor[2]),
        None if colors is None else to_linear(colors[pairs[:, 0]]),
    )
