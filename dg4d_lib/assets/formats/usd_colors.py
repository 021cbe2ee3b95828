"""Base colors of USD materials: UsdPreviewSurface with UsdUVTexture, UsdTransform2d and UsdPrimvarReader."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pxr import Ar, UsdShade

from dg4d_lib.errors import BadInput
from dg4d_lib.mesh.models.model import REPEATED, Wrap, Wraps

WHITE = (1.0, 1.0, 1.0)
CHANNELS = {"r": 0, "g": 1, "b": 2, "a": 3}  # of a picture, by the output of the texture
WRAPS = {"mirror": Wrap.MIRROR, "clamp": Wrap.CLAMP, "black": Wrap.CLAMP}  # all others repeat
MOST_TRANSFORMS = 8  # largest number of chained transforms of texture coordinates
Decode = Callable[[bytes, str], NDArray[np.uint8]]


@dataclass(frozen=True)
class UsdColor:
    """Base color of a material.

    Attributes:
        factor: linear color that multiplies the texture.
        texture: sRGB and alpha; None without texture.
        primvar: name of the texture coordinates; empty where the material names none.
        matrix: of homogeneous texture coordinates, v up, from the primvar to the texture.
        wrap: wrap modes of the texture.
        masked: True if the alpha of the texture cuts holes.
        is_hidden: True if the opacity of the material hides all of it.
    """

    factor: tuple[float, float, float] = WHITE
    texture: NDArray[np.uint8] | None = None
    primvar: str = ""
    matrix: NDArray[np.float64] | None = None
    wrap: Wraps = REPEATED
    masked: bool = False
    is_hidden: bool = False

    def place(self, uvs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return texture coordinates, u right and v down, of those of the primvar."""
        placed = uvs if self.matrix is None else uvs @ self.matrix[:2, :2].T + self.matrix[:2, 2]
        return np.stack([placed[:, 0], 1 - placed[:, 1]], 1)


class UsdMaterials:
    """Materials of a package, each read once.

    Attributes:
        notes: sentences about materials whose color was not read.
    """

    def __init__(self, package: str, decode: Decode) -> None:
        self.package, self.decode = package, decode
        self.decoded: dict[str, NDArray[np.uint8]] = {}
        self.colors: dict[str, UsdColor | None] = {}
        self.notes: list[str] = []

    def read(self, prim: Any) -> UsdColor | None:
        """Return the base color of a prim's material; None if it has no material, or one without a readable color."""
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        if not material:
            return None
        path = str(material.GetPath())
        if path not in self.colors:
            shader = material.ComputeSurfaceSource()[0]
            self.colors[path] = self._color(shader) if shader else None
        return self.colors[path]

    def note_gray(self, prim: Any) -> None:
        """Note that the material of a prim was not read, if it has one."""
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        if material:
            self.notes.append(
                f"the material {material.GetPrim().GetName()[:80]!r} is gray: only base colors of a UsdPreviewSurface "
                "are read; export it as one"
            )

    def _color(self, shader: UsdShade.Shader) -> UsdColor | None:
        source, opacity = _source(shader, "diffuseColor"), _source(shader, "opacity")
        if source is None:
            return None
        painted, cut = _shader_of(source), None if opacity is None else _shader_of(opacity)
        picture = None if painted is None else self._picture(painted)
        value = source.Get() if painted is None else _value(painted, "scale", WHITE)  # both linear
        if value is None or (painted is not None and picture is None):
            return None
        color = UsdColor((float(value[0]), float(value[1]), float(value[2])))
        if opacity is not None and cut is None:
            level = opacity.Get()
            is_hidden = level is not None and (level <= 0 or level < _value(shader, "opacityThreshold", 0.0))
            color = replace(color, is_hidden=is_hidden)
        holes = None if cut is None else self._picture(cut)
        if holes is not None and opacity is not None:
            channel = CHANNELS.get(opacity.GetBaseName(), CHANNELS["r"])
            if holes is not picture or channel != CHANNELS["a"]:
                picture = _with_alpha(picture, holes[..., channel])
        texture = painted or cut
        if picture is None or texture is None:
            return color
        primvar, matrix = _coordinates(texture)
        along_u, along_v = (WRAPS.get(str(_value(texture, name, "")), Wrap.REPEAT) for name in ("wrapS", "wrapT"))
        return replace(
            color,
            texture=picture,
            primvar=primvar,
            matrix=matrix,
            wrap=(along_u, along_v),
            masked=holes is not None,
        )

    def _picture(self, texture: UsdShade.Shader) -> NDArray[np.uint8] | None:
        """Return the picture of a texture; None if it names none."""
        picture = _value(texture, "file", None)
        if picture is None:
            return None
        path = picture.resolvedPath
        if path not in self.decoded:
            inside = path.startswith(f"{self.package}[")
            asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(path)) if inside else None
            if asset is None:
                raise BadInput(f"the texture {picture.path[:80]!r} of the model is missing; pack it into the USDZ")
            self.decoded[path] = self.decode(bytes(asset.GetBuffer()), picture.path)
        return self.decoded[path]


def _with_alpha(picture: NDArray[np.uint8] | None, alpha: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a picture, white if there is none, with other alpha, resampled to its size."""
    if picture is None:
        return np.concatenate([np.full((*alpha.shape, 3), 255, np.uint8), alpha[..., None]], -1)
    height, width = picture.shape[:2]
    resized = np.array(Image.fromarray(alpha).resize((width, height), Image.Resampling.BILINEAR))
    return np.concatenate([picture[..., :3], resized[..., None]], -1)


def _coordinates(texture: UsdShade.Shader) -> tuple[str, NDArray[np.float64]]:
    """Return the primvar that a texture is placed by, and the transform from there."""
    matrix, reader = np.eye(3), _upstream(texture, "st")
    for _ in range(MOST_TRANSFORMS):
        if reader is None or reader.GetShaderId() != "UsdTransform2d":
            break
        turn = math.radians(_value(reader, "rotation", 0.0))
        (width, height), (right, up) = _value(reader, "scale", (1, 1)), _value(reader, "translation", (0, 0))
        c, s = math.cos(turn), math.sin(turn)
        matrix = matrix @ np.array([[c * width, -s * height, right], [s * width, c * height, up], [0, 0, 1]])
        reader = _upstream(reader, "in")
    return str(_value(reader, "varname", "")) if reader is not None else "", matrix


def _source(shader: UsdShade.Shader, name: str) -> Any:
    """Return the attribute that an input gets its value from: itself, an input of a material, or an output."""
    found = shader.GetInput(name)
    attributes = found.GetValueProducingAttributes() if found else ()
    return attributes[0] if attributes else None


def _value(shader: UsdShade.Shader, name: str, default: Any) -> Any:
    """Return the value of an input that is not computed by another shader."""
    source = _source(shader, name)
    value = None if source is None else source.Get()
    return default if value is None else value


def _upstream(shader: UsdShade.Shader, name: str) -> UsdShade.Shader | None:
    """Return the shader that computes an input; None if it is a value."""
    source = _source(shader, name)
    return None if source is None else _shader_of(source)


def _shader_of(source: Any) -> UsdShade.Shader | None:
    """Return the shader whose output an attribute is; None if it holds a value."""
    is_output = UsdShade.Utils.GetType(source.GetName()) == UsdShade.AttributeType.Output
    return UsdShade.Shader(source.GetPrim()) if is_output else None
