"""Models of users: triangle meshes in parts, each with its material's base color."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, UInt8

OPAQUE = 128  # alpha of a texel, of 255, from which a masked material is opaque


@dataclass(frozen=True)
class ModelPart:
    """Mesh of one material.

    Attributes:
        name: of the part.
        vertices: at rest, in the coordinates of the model.
        faces: indices into the vertices.
        uvs: texture coordinates, u right and v down, repeated outside [0, 1]; None without texture.
        texture: base color in sRGB, and alpha.
        factor: linear color that multiplies texture and vertex colors.
        colors: linear color per vertex; None for white.
        masked: True if the alpha of the texture cuts holes.
    """

    name: str
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    uvs: Float[np.ndarray, "v 2"] | None = None
    texture: UInt8[np.ndarray, "h w 4"] | None = None
    factor: tuple[float, float, float] = (1.0, 1.0, 1.0)
    colors: Float[np.ndarray, "v 3"] | None = None
    masked: bool = False

    def sample(
        self, faces: Int[np.ndarray, " n"], barycentrics: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
        """Return sRGB colors in [0, 1] of points on triangles, and their alpha, 0 to 255."""
        corners = self.faces[faces]
        linear = np.broadcast_to(np.array(self.factor), (len(faces), 3))
        alpha = np.full(len(faces), 255)
        if self.colors is not None:
            linear = linear * np.einsum("nk,nkc->nc", barycentrics, self.colors[corners])
        if self.texture is not None and self.uvs is not None:
            texels = sample_bilinear(self.texture, np.einsum("nk,nkc->nc", barycentrics, self.uvs[corners]))
            linear = linear * to_linear(texels[:, :3] / 255)
            alpha = texels[:, 3] if self.masked else alpha
        return to_srgb(linear).astype(np.float32), alpha.round().astype(np.int64)


@dataclass(frozen=True)
class Model:
    """A model of the user's own, at rest.

    Attributes:
        parts: meshes; at least one with triangles.
    """

    parts: tuple[ModelPart, ...]

    @property
    def vertices(self) -> Float[np.ndarray, "v 3"]:
        """Vertices of all parts."""
        return np.concatenate([part.vertices for part in self.parts])

    @property
    def faces(self) -> Int[np.ndarray, "f 3"]:
        """Triangles of all parts, as indices into `vertices`."""
        starts = np.cumsum([0, *(len(part.vertices) for part in self.parts)])
        return np.concatenate([part.faces + start for part, start in zip(self.parts, starts, strict=False)])

    def sample(
        self, faces: Int[np.ndarray, " n"], barycentrics: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
        """Return colors and alpha of points on triangles, as `ModelPart.sample`."""
        colors, alpha = np.zeros((len(faces), 3), np.float32), np.zeros(len(faces), np.int64)
        start = 0
        for part in self.parts:
            chosen = (faces >= start) & (faces < start + len(part.faces))
            colors[chosen], alpha[chosen] = part.sample(faces[chosen] - start, barycentrics[chosen])
            start += len(part.faces)
        return colors, alpha

    def placed(self, matrix: Float[np.ndarray, "4 4"]) -> "Model":
        """Return the model with an affine transform of its vertices."""
        return Model(
            tuple(
                replace(part, vertices=(part.vertices @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32))
                for part in self.parts
            )
        )


def sample_bilinear(texture: UInt8[np.ndarray, "h w c"], uvs: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n c"]:
    """Sample a texture that repeats, bilinearly; values as in the texture."""
    height, width = texture.shape[:2]
    x, y = (uvs[:, 0] % 1) * width - 0.5, (uvs[:, 1] % 1) * height - 0.5
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = (x - left)[:, None], (y - top)[:, None]
    total = np.zeros((len(uvs), texture.shape[2]))
    for row, wy in ((top, 1 - fy), (top + 1, fy)):
        for column, wx in ((left, 1 - fx), (left + 1, fx)):
            total += wy * wx * texture[row % height, column % width]
    return total


def to_linear(srgb: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Convert sRGB to linear values (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((np.maximum(srgb, 0) + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Convert linear values, clipped to [0, 1], to sRGB; inverse of `to_linear`."""
    clipped = linear.clip(0, 1)
    return np.where(clipped <= 0.0031308, clipped * 12.92, 1.055 * clipped ** (1 / 2.4) - 0.055)
