"""Images, textures and materials of a glTF document.

Textures per frame are stored side by side in one image, the atlas: cells in reading order, each with a gutter that
repeats its border pixels, so that mip levels do not mix cells. Texture coordinates point into the first cell, and an
animated offset (KHR_texture_transform) moves them to the others; readers without it show the first frame.
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
from dg4d_lib.images import resize_planes, to_bytes

TEXTURE_TRANSFORM = "KHR_texture_transform"
WEBP = "EXT_texture_webp"
WEBP_MAX = 16383  # maximum side of a WebP, pixels
WEBP_METHOD = 2  # of 6; twice as fast as the default 4, files 3 % larger
FALLBACK_SIZE = 512  # side of the image for readers without WebP (Blender by default), pixels
FULL_COLOR = 85  # quality from which JPEG uses 4:4:4 chroma, for two fifths more bytes: else islands bleed at seams
PNG_LEVEL = 4  # of 9; twice as fast as the default 6, files a few percent larger
GUTTER = 8  # pixels around a cell, enough for three mip levels
ROWS = 1024  # rows of a texture converted at once; bounds memory
LINEAR, LINEAR_MIPMAP_LINEAR, CLAMP_TO_EDGE = 9729, 9987, 33071


@dataclass(frozen=True)
class Atlas:
    """Layout of an atlas.

    Attributes:
        frames: number of cells in use.
        columns: cells per row.
        width: of a cell without its gutter, pixels.
        height: of a cell without its gutter, pixels.
        gutter: pixels around each cell.
    """

    frames: int
    columns: int
    width: int
    height: int
    gutter: int = GUTTER

    @classmethod
    def of(cls, textures: Float[Tensor, "t h w 3"], largest: int) -> "Atlas":
        """Choose a nearly square grid; cells shrink if the atlas would exceed `largest` pixels a side.

        Raises:
            BadInput: there is less than one pixel per cell.
        """
        frames, height, width, _ = textures.shape
        columns = math.ceil(math.sqrt(frames))
        room = largest // columns - 2 * GUTTER
        if room < 1:
            raise BadInput(
                f"{frames} textures do not fit into an atlas of {largest} x {largest} pixels; "
                "raise pack.gltf.atlas_size"
            )
        return cls(frames, columns, min(width, room), min(height, room))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the atlas, pixels."""
        rows = math.ceil(self.frames / self.columns)
        return self.columns * (self.width + 2 * self.gutter), rows * (self.height + 2 * self.gutter)

    def corners(self) -> NDArray[np.int64]:
        """Return column and row of the first pixel of every cell."""
        rows, columns = np.divmod(np.arange(self.frames), self.columns)
        pitch = np.array((self.width, self.height)) + 2 * self.gutter
        return np.asarray(np.stack((columns, rows), axis=1) * pitch + self.gutter)

    def offsets(self) -> NDArray[np.float32]:
        """Return the offset of every frame's texture coordinates from those of the first cell."""
        corners = self.corners()
        return ((corners - corners[0]) / self.size).astype("<f4")

    def to_atlas_uvs(self, uvs: NDArray[np.float32]) -> NDArray[np.float32]:
        """Map texture coordinates of a single texture to the first cell."""
        return ((uvs * (self.width, self.height) + self.gutter) / self.size).astype("<f4")

    def from_atlas_uvs(self, uvs: NDArray[np.float32]) -> NDArray[np.float32]:
        """Map texture coordinates of the first cell to a single texture; inverse of `to_atlas_uvs`."""
        return ((uvs * self.size - self.gutter) / (self.width, self.height)).astype("<f4")

    def pack(self, textures: Float[Tensor, "t h w 3"]) -> UInt8[np.ndarray, "i j 3"]:
        """Assemble the textures into the atlas image."""
        page = np.zeros((*self.size[::-1], 3), np.uint8)
        g = self.gutter
        for texture, (x, y) in zip(textures, self.corners(), strict=True):
            cell = np.pad(to_uint8(self._fitted(texture)), ((g, g), (g, g), (0, 0)), "edge")
            page[y - g : y - g + len(cell), x - g : x - g + cell.shape[1]] = cell
        return page

    def unpack(self, page: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "t i j 3"]:
        """Extract the textures from an atlas image."""
        return np.stack([page[y : y + self.height, x : x + self.width] for x, y in self.corners()])

    def _fitted(self, texture: Float[Tensor, "h w 3"]) -> Float[Tensor, "i j 3"]:
        if texture.shape[:2] == (self.height, self.width):
            return texture
        channels = texture.movedim(-1, 0)[None].float()
        small = resize_planes(channels, (self.height, self.width))
        return small[0].movedim(0, -1)


def to_uint8(texture: Float[Tensor, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Convert colors in [0, 1] to uint8."""
    parts = texture.split(ROWS)
    return torch.cat([to_bytes(part) for part in parts]).numpy()


def encode_image(pixels: UInt8[np.ndarray, "h w 3"], kind: str, quality: int) -> bytes:
    """Encode an image as `png`, `jpeg` or `webp`; equal images give equal bytes."""
    options: dict[str, dict[str, Any]] = {
        "png": {"compress_level": PNG_LEVEL},
        "jpeg": {"quality": quality, "subsampling": "4:4:4" if quality >= FULL_COLOR else "4:2:0"},
        "webp": {"quality": quality, "method": WEBP_METHOD},
    }
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, kind, **options[kind])
    return file.getvalue()


def add_texture(document: GltfDocument, name: str, pixels: UInt8[np.ndarray, "h w 3"], settings: GltfSettings) -> int:
    """Add a texture in the format of the settings; return its index.

    Raises:
        BadInput: the image is too large for its format.
    """
    common = {"name": f"{name} color", "sampler": _sampler(document)}
    if settings.image != "webp":
        return document.add("textures", **common, source=_add_image(document, name, pixels, settings.image, settings))
    if max(pixels.shape) > WEBP_MAX:
        raise BadInput(
            f"a texture of {max(pixels.shape)} pixels cannot be webp, at most {WEBP_MAX} pixels are allowed; "
            "set pack.gltf.image=jpeg"
        )
    document.use_extension(WEBP)
    source = _add_image(document, name, pixels, "webp", settings)
    fallback = _add_image(document, f"{name} small", _thumbnail(pixels), "jpeg", settings)
    return document.add("textures", **common, source=fallback, extensions={WEBP: {"source": source}})


def add_material(
    document: GltfDocument, name: str, texture: int, settings: GltfSettings, atlas: Atlas | None = None
) -> int:
    """Add a material with a base color texture; return its index.

    Args:
        document: document to extend.
        name: name of the mesh that uses it.
        texture: index of the base color texture.
        settings: roughness and metallic.
        atlas: layout if the texture is an atlas, whose offset can be animated.
    """
    color: dict[str, Any] = {"index": texture}
    extras = None
    if atlas is not None:
        document.use_extension(TEXTURE_TRANSFORM)
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


def _thumbnail(pixels: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "i j 3"]:
    picture = Image.fromarray(pixels)
    picture.thumbnail((FALLBACK_SIZE, FALLBACK_SIZE))
    return np.array(picture)
