"""MTL: base colors of the materials of an OBJ, and the names of their textures; pure Python."""

import math
import re
from dataclasses import dataclass

MOST_WORDS = 32  # of a texture's name
_DRIVE = re.compile(r"^[A-Za-z]:/")


@dataclass
class Material:
    """Base color of a material.

    Attributes:
        color: sRGB.
        textures: names that the file of its texture may have, the most likely first; empty without one.
    """

    color: tuple[float, float, float] = (0.8, 0.8, 0.8)
    textures: tuple[str, ...] = ()


def read_mtl(text: str) -> dict[str, Material]:
    """Return the materials of an MTL by name.

    Raises:
        ValueError: a color is no number.
    """
    current, materials = Material(), {}
    for line in text.splitlines():
        words = line.split("#", 1)[0].split()
        if words[:1] == ["newmtl"]:
            current = materials[" ".join(words[1:])] = Material()
        elif words[:1] == ["Kd"] and len(words) >= 4:
            red, green, blue = map(float, words[1:4])
            if math.isfinite(red + green + blue):
                current.color = (red, green, blue)
        elif words[:1] == ["map_Kd"]:
            current.textures = texture_names(line.split("#", 1)[0].strip().removeprefix("map_Kd").strip())
    return materials


def texture_names(statement: str) -> tuple[str, ...]:
    """Return the names that the file of a texture may have.

    Options may stand before the name, and the name may have spaces; where neither is quoted, only a look at the files
    can tell. Paths of another computer are of no use: the file is looked for beside the model.

    Args:
        statement: what follows `map_Kd`.
    """
    words = statement.replace("\\", "/").replace("\t", " ").split(" ")[-MOST_WORDS:]
    tails = (" ".join(words[start:]).strip('"').removeprefix("./") for start in range(len(words)) if words[start])
    return tuple(tail.rpartition("/")[2] if tail.startswith("/") or _DRIVE.match(tail) else tail for tail in tails)
