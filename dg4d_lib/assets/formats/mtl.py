"""MTL: base colors of the materials of an OBJ, and the names of their textures; pure Python."""

import math
import re
from dataclasses import dataclass

MOST_WORDS = 32  # largest number of words in a texture's name
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
        ValueError: a color is not a number.
    """
    current, materials = Material(), {}
    for line in text.splitlines():
        keyword, *rest = line.strip().split(None, 1) or [""]
        words = " ".join(rest).split()
        match keyword.lower():
            case "newmtl":
                current = materials[" ".join(words)] = Material()
            case "kd" if len(words) >= 3:
                red, green, blue = map(float, words[:3])
                if math.isfinite(red + green + blue):
                    current.color = (red, green, blue)
            case "map_kd":
                current.textures = texture_names(" ".join(rest))
    return materials


def library_names(statement: str) -> tuple[str, ...]:
    """Return the names that the MTL files of an OBJ may have: every word, and all as one name with spaces.

    Args:
        statement: text after `mtllib`.
    """
    return tuple(dict.fromkeys((*statement.split(), statement)))


def texture_names(statement: str) -> tuple[str, ...]:
    """Return the names that the file of a texture may have.

    Options may stand before the name, and the name may have spaces; where neither is quoted, only a look at the files
    can tell. Paths of another computer are of no use: the file is looked for beside the model.

    Args:
        statement: text after `map_Kd`.
    """
    words = statement.replace("\\", "/").replace("\t", " ").split(" ")[-MOST_WORDS:]
    tails = (" ".join(words[start:]).strip('"').removeprefix("./") for start in range(len(words)) if words[start])
    return tuple(tail.rpartition("/")[2] if tail.startswith("/") or _DRIVE.match(tail) else tail for tail in tails)
