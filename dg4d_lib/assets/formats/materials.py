"""Pictures and materials of a glTF document.

Textures that change lie side by side in one picture, the atlas: cells in reading order, each with a gutter of its own
border pixels around it, so that mip levels mix nothing foreign. Texture coordinates point into the first cell, and an
animated offset (KHR_texture_transform) moves them to the others; whoever knows no such thing sees the first frame.
"""

import io
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from dg4d_lib.asset_settings import GltfSettings
from dg4d_lib.assets.formats.gltf import GltfDocument
from dg4d_lib.errors import BadInput
from dg4d_lib.images import resize_planes

TEXTURE_TRANSFORM = "KHR_texture_transform"
WEBP = "EXT_texture_webp"
WEBP_MAX = 16383  # pixels of a side
WEBP_METHOD = 2  # of 6; twice as fast as the default 4, files 3 percent larger
FALLBACK_SIZE = 512  # pixels of the picture for readers without WebP (Blender, unless it is told)
FULL_COLOR = 95  # the quality from which jpeg keeps colors as fine as brightness, for a third more bytes
PNG_LEVEL = 4  # of 9; twice as fast as the default 6, files a few percent larger
GUTTER = 8  # pixels around a cell: three mip levels are clean
ROWS = 1024  # of a texture that are converted at once, bounds the memory
LINEAR, LINEAR_MIPMAP_LINEAR, CLAMP_TO_EDGE = 9729, 9987, 33071


@dataclass(frozen=True)
class Atlas:
    """How cells lie in an atlas.

    Attributes:
        frames: cells that are filled.
        columns: cells in a row.
        width: pixels of a cell without its gutter.
        height: pixels of a cell without its gutter.
        gutter: pixels around each cell.
    """

    frames: int
    columns: int
    width: int
    height: int
    gutter: int = GUTTER

    @classmethod
    def of(cls, textures: Float[Tensor, "t h w 3"], largest: int) -> "Atlas":
        """A grid, nearly square; cells are smaller than the textures where the atlas would exceed `largest` pixels.

        Raises:
            BadInput: not even single pixels fit.
        """
        frames, height, width, _ = textures.shape
        columns = math.ceil(math.sqrt(frames))
        room = largest // columns - 2 * GUTTER
        if room < 1:
            raise BadInput(f"{frames} textures do not fit into {largest} pixels; raise pack.gltf.atlas_size")
        return cls(frames, columns, min(width, room), min(height, room))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the whole, pixels."""
        rows = math.ceil(self.frames / self.columns)
        return self.columns * (self.width + 2 * self.gutter), rows * (self.height + 2 * self.gutter)

    def corners(self) -> NDArray[np.int64]:
        """Column and row of the first pixel of every cell."""
        rows, columns = np.divmod(np.arange(self.frames), self.columns)
        pitch = np.array((self.width, self.height)) + 2 * self.gutter
        return np.asarray(np.stack((columns, rows), axis=1) * pitch + self.gutter)

    def offsets(self) -> NDArray[np.float32]:
        """What to add to texture coordinates of the first cell, for every frame."""
        corners = self.corners()
        return ((corners - corners[0]) / self.size).astype("<f4")

    def inside(self, uvs: NDArray[np.float32]) -> NDArray[np.float32]:
        """Texture coordinates of a texture as those of the first cell."""
        return ((uvs * (self.width, self.height) + self.gutter) / self.size).astype("<f4")

    def outside(self, uvs: NDArray[np.float32]) -> NDArray[np.float32]:
        """The inverse of `inside`."""
        return ((uvs * self.size - self.gutter) / (self.width, self.height)).astype("<f4")

    def join(self, textures: Float[Tensor, "t h w 3"]) -> UInt8[np.ndarray, "i j 3"]:
        """The atlas as a picture."""
        page = np.zeros((*self.size[::-1], 3), np.uint8)
        g = self.gutter
        for texture, (x, y) in zip(textures, self.corners(), strict=True):
            cell = np.pad(to_uint8(self._fitted(texture)), ((g, g), (g, g), (0, 0)), "edge")
            page[y - g : y - g + len(cell), x - g : x - g + cell.shape[1]] = cell
        return page

    def split(self, page: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "t i j 3"]:
        """The textures in an atlas."""
        return np.stack([page[y : y + self.height, x : x + self.width] for x, y in self.corners()])

    def _fitted(self, texture: Float[Tensor, "h w 3"]) -> Float[Tensor, "i j 3"]:
        if texture.shape[:2] == (self.height, self.width):
            return texture
        channels = texture.movedim(-1, 0)[None].float()
        small = resize_planes(channels, (self.height, self.width))
        return small[0].movedim(0, -1)


def to_uint8(texture: Float[Tensor, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Colors in [0, 1] as bytes."""
    parts = texture.detach().split(ROWS)
    return torch.cat([part.cpu().clamp(0, 1).mul_(255).round_().to(torch.uint8) for part in parts]).numpy()


def encode_image(pixels: UInt8[np.ndarray, "h w 3"], kind: str, quality: int) -> bytes:
    """A picture as a file, `png`, `jpeg` or `webp`; equal pictures give equal bytes."""
    options: dict[str, dict[str, Any]] = {
        "png": {"compress_level": PNG_LEVEL},
        "jpeg": {"quality": quality, "subsampling": "4:4:4" if quality >= FULL_COLOR else "4:2:0"},
        "webp": {"quality": quality, "method": WEBP_METHOD},
    }
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, kind, **options[kind])
    return file.getvalue()


def add_texture(document: GltfDocument, name: str, pixels: UInt8[np.ndarray, "h w 3"], settings: GltfSettings) -> int:
    """Add a picture as the settings want it. Returns the number of its texture.

    Raises:
        BadInput: it is too large for its format.
    """
    common = {"name": f"{name} color", "sampler": _sampler(document)}
    if settings.image != "webp":
        return document.add("textures", **common, source=_add_image(document, name, pixels, settings.image, settings))
    if max(pixels.shape) > WEBP_MAX:
        raise BadInput(f"a texture of {max(pixels.shape)} pixels cannot be webp, which ends at {WEBP_MAX}; use jpeg")
    document.use(WEBP)
    source = _add_image(document, name, pixels, "webp", settings)
    fallback = _add_image(document, f"{name} small", _small(pixels), "jpeg", settings)
    return document.add("textures", **common, source=fallback, extensions={WEBP: {"source": source}})


def add_material(
    document: GltfDocument, name: str, texture: int, settings: GltfSettings, atlas: Atlas | None = None
) -> int:
    """Add a surface that wears a texture. Returns the number of the material.

    Args:
        document: it is added to.
        name: of what wears it.
        texture: its color, by number.
        settings: roughness and metallic.
        atlas: the texture is one; its offset can be animated.
    """
    color: dict[str, Any] = {"index": texture}
    extras = None
    if atlas is not None:
        document.use(TEXTURE_TRANSFORM)
        color["extensions"] = {TEXTURE_TRANSFORM: {"offset": [0.0, 0.0]}}
        extras = {"atlas": vars(atlas)}
    surface = {
        "baseColorTexture": color,
        "metallicFactor": settings.metallic,
        "roughnessFactor": settings.roughness,
    }
    return document.add(
        "materials", name=f"{name} surface", pbrMetallicRoughness=surface, doubleSided=True, extras=extras
    )


def _sampler(document: GltfDocument) -> int:
    if document.tree.get("samplers"):
        return 0
    wrap = {"wrapS": CLAMP_TO_EDGE, "wrapT": CLAMP_TO_EDGE}
    return document.add("samplers", name="smooth", magFilter=LINEAR, minFilter=LINEAR_MIPMAP_LINEAR, **wrap)


def _add_image(
    document: GltfDocument, name: str, pixels: UInt8[np.ndarray, "h w 3"], kind: str, settings: GltfSettings
) -> int:
    view = document.add_view(f"{name} color", encode_image(pixels, kind, settings.quality))
    return document.add("images", name=f"{name} color", mimeType=f"image/{kind}", bufferView=view)


def _small(pixels: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "i j 3"]:
    picture = Image.fromarray(pixels)
    picture.thumbnail((FALLBACK_SIZE, FALLBACK_SIZE))
    return np.array(picture)
