"""OBJ reader: a part per object and material, polygons as fans of triangles, textures of the MTL files beside it."""

from collections.abc import Callable
from dataclasses import dataclass, field

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
    positions: list[tuple[float, ...]] = []
    uvs: list[tuple[float, float]] = []
    materials: dict[str, _Material] = {}
    groups: dict[tuple[str, str], _Group] = {}
    name, material, faces = "model", "", 0
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#", 1)[0].split()
        try:
            match words[:1]:
                case ["v"]:
                    positions.append(tuple(map(float, words[1:7])))
                case ["vt"]:
                    uvs.append((float(words[1]), 1 - float(words[2])))
                case ["o" | "g"]:
                    name = " ".join(words[1:]) or "model"
                case ["usemtl"]:
                    material = " ".join(words[1:])
                case ["mtllib"]:
                    _read_materials(read(" ".join(words[1:])), materials)
                case ["f"]:
                    corners = [_corner(word, len(positions), len(uvs)) for word in words[1:]]
                    group = groups.setdefault((name, material), _Group(name, material))
                    for second, third in zip(corners[1:-1], corners[2:], strict=True):
                        group.corners += [corners[0], second, third]
                    faces += max(0, len(corners) - 2)
        except (ValueError, IndexError) as error:
            raise BadInput(f"line {number} of the OBJ cannot be read ({error}); export the model again") from error
        if faces > max_faces:
            raise BadInput(
                f"the model has more than {max_faces} triangles, the limit asset.max_faces: simplify it, or raise the "
                "limit with --set asset.max_faces=N"
            )
    if not faces:
        raise BadInput("the model has no faces; give a mesh with triangles")
    points = np.array([row[:3] for row in positions], float).reshape(-1, 3)
    colored = np.array([row[3:6] for row in positions]) if all(len(row) == 6 for row in positions) else None
    if not np.isfinite(points).all():
        raise BadInput("the model has vertices that are not finite numbers (NaN or infinity); export it again")
    coordinates = np.array(uvs, float).reshape(-1, 2)
    pictures: dict[str, NDArray[np.uint8]] = {}
    parts = []
    for group in groups.values():
        if group.corners:
            known = materials.get(group.material, _Material())
            texture = _texture(known.texture, read, decode, pictures)
            parts.append(_part(group, points, coordinates, colored, known, texture))
    return Model(tuple(parts))


def referred_files(text: str, limit: int = 64) -> list[str]:
    """Return the MTL files that an OBJ names, or the textures that an MTL names."""
    words = (line.split("#", 1)[0].split() for line in text.splitlines())
    names = [
        row[-1] if row[0] == "map_Kd" else " ".join(row[1:]) for row in words if row[:1] in (["mtllib"], ["map_Kd"])
    ]
    return list(dict.fromkeys(name.replace("\\", "/") for name in names if name))[:limit]


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
