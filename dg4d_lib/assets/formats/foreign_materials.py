"""Base colors of the materials of GLBs of other programs, with textures and vertex colors."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dg4d_lib.assets.formats.gltf import GlbReader, json_object, read_accessor
from dg4d_lib.assets.formats.model_pictures import decode_picture
from dg4d_lib.errors import BadInput
from dg4d_lib.mesh.models.model import REPEATED, Wrap, Wraps

SPECULAR = "KHR_materials_pbrSpecularGlossiness"  # materials of older exporters
STRENGTH = "KHR_materials_emissive_strength"
CUTOFF = 0.5  # default alpha cutoff of masked materials


@dataclass(frozen=True)
class BaseColor:
    """Base color of a primitive.

    Attributes:
        uvs: texture coordinates per vertex, u right and v down; None without texture.
        texture: sRGB and alpha; None without texture.
        factor: linear color that multiplies texture and vertex colors.
        colors: linear color per vertex; None for white.
        masked: True if the alpha of the texture cuts holes.
        wrap: wrap modes of the texture.
    """

    uvs: NDArray[np.float64] | None
    texture: NDArray[np.uint8] | None
    factor: tuple[float, float, float]
    colors: NDArray[np.float64] | None
    masked: bool
    wrap: Wraps


class BaseColors:
    """Materials of a GLB, whose pictures are decoded once."""

    def __init__(self, reader: GlbReader) -> None:
        self.reader = reader
        self.pictures: dict[int, NDArray[np.uint8]] = {}

    def read(self, primitive: dict[str, Any]) -> BaseColor:
        """Return the base color of a primitive, or its emissive color if the base color is black."""
        attributes, material = primitive["attributes"], _material(self.reader.tree, primitive)
        shading, emitted = _base_color(material), _emissive_factor(material)
        glows = any(emitted) and not any(shading.get("baseColorFactor", (1, 1, 1))[:3])
        info = material.get("emissiveTexture") if glows else shading.get("baseColorTexture")
        factor = emitted if glows else [float(value) for value in shading.get("baseColorFactor", (1, 1, 1, 1))]
        texture, uvs, wrap = self._texture(info, attributes)
        colors = None
        if "COLOR_0" in attributes and not glows:
            colors = _finite(read_accessor(self.reader, attributes["COLOR_0"])[:, :3])
        masked = material.get("alphaMode", "OPAQUE") != "OPAQUE" and not glows
        return BaseColor(uvs, texture, (factor[0], factor[1], factor[2]), colors, masked, wrap)

    def _texture(
        self, info: Any, attributes: dict[str, int]
    ) -> tuple[NDArray[np.uint8] | None, NDArray[np.float64] | None, Wraps]:
        """Return a texture, its coordinates and wrap modes; the first two None without one."""
        if not isinstance(info, dict):
            return None, None, REPEATED
        tree = self.reader.tree
        texture = tree["textures"][info["index"]]
        extensions = json_object(texture.get("extensions"))
        source = next(
            (v["source"] for v in (json_object(extensions.get("EXT_texture_webp")), texture) if "source" in v), None
        )
        transform = json_object(json_object(info.get("extensions")).get("KHR_texture_transform"))
        name = f"TEXCOORD_{transform.get('texCoord', info.get('texCoord', 0))}"
        if source is None or name not in attributes:
            return None, None, REPEATED
        if source not in self.pictures:
            self.pictures[source] = self._picture(source)
        uvs = _finite(read_accessor(self.reader, attributes[name]))
        turn = float(transform.get("rotation", 0))
        c, s = math.cos(turn), math.sin(turn)
        uvs = (uvs * transform.get("scale", (1, 1))) @ np.array([[c, -s], [s, c]]) + transform.get("offset", (0, 0))
        number, samplers = texture.get("sampler"), tree.get("samplers", ())
        sampler = samplers[number] if isinstance(number, int) and 0 <= number < len(samplers) else {}  # as players do
        return self.pictures[source], uvs, (_wrap(sampler.get("wrapS")), _wrap(sampler.get("wrapT")))

    def _picture(self, index: int) -> NDArray[np.uint8]:
        image = self.reader.tree["images"][index]
        if "bufferView" not in image:
            raise BadInput(
                f"the texture {str(image.get('uri', index))[:80]!r} of the model is missing; put it beside the model, "
                "or export the model as GLB with its textures"
            )
        return decode_picture(self.reader.view(image["bufferView"]), str(image.get("name", index)))


def is_transparent(tree: dict[str, Any], primitive: dict[str, Any]) -> bool:
    """Return whether the material of a primitive hides all of it: alpha below the cutoff, or 0 where it is blended."""
    material = _material(tree, primitive)
    factor = _base_color(material).get("baseColorFactor", (1, 1, 1, 1))
    match material.get("alphaMode", "OPAQUE"):
        case "MASK":
            return float(factor[3]) < float(material.get("alphaCutoff", CUTOFF))
        case "BLEND":
            return float(factor[3]) <= 0
        case _:
            return False


def _material(tree: dict[str, Any], primitive: dict[str, Any]) -> dict[str, Any]:
    material: dict[str, Any] = tree["materials"][primitive["material"]] if "material" in primitive else {}
    return material


def _base_color(material: dict[str, Any]) -> dict[str, Any]:
    """Return the shading of a material by metal and roughness, or what equals its base color in an older one."""
    specular = json_object(json_object(material.get("extensions")).get(SPECULAR))
    if "pbrMetallicRoughness" in material or not specular:
        return json_object(material.get("pbrMetallicRoughness"))
    renamed = {"diffuseFactor": "baseColorFactor", "diffuseTexture": "baseColorTexture"}
    return {renamed[key]: value for key, value in specular.items() if key in renamed}


def _emissive_factor(material: dict[str, Any]) -> list[float]:
    """Return the emissive factor of a material, linear, at most 1."""
    strength = json_object(json_object(material.get("extensions")).get(STRENGTH)).get("emissiveStrength", 1)
    return [min(1.0, float(value) * float(strength)) for value in material.get("emissiveFactor", (0, 0, 0))]


def _finite(values: NDArray[Any]) -> NDArray[np.float64]:
    """Convert to float64; replace NaN and infinity by 0, because interpolation would spread them."""
    return np.nan_to_num(values.astype(np.float64), posinf=0.0, neginf=0.0)


def _wrap(number: Any) -> Wrap:
    """Return a wrap mode; textures with unknown ones repeat, as in players."""
    return Wrap(number) if number in list(Wrap) else Wrap.REPEAT
