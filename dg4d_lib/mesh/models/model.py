"""Models of users: triangle meshes in parts, each with its material's base color."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from jaxtyping import Float, Int, UInt8

from dg4d_lib.errors import BadInput
from dg4d_lib.mesh.extraction.topology import group_vertices

OPAQUE = 128  # alpha of a texel, of 255, from which a masked material is opaque
TRANSPARENT = "the materials of the model are transparent everywhere; give it an opaque one"
EQUAL_NORMALS = 1e-3  # side of the cells in which unit normals count as equal
FAR = 100  # distance from the origin, in sizes of a model, from which float32 rounds it by more than 1e-5 of its size


class Wrap(IntEnum):
    """Wrap mode of a texture along one axis, by its number in glTF."""

    REPEAT = 10497
    MIRROR = 33648
    CLAMP = 33071

    @property
    def period(self) -> int:
        """Length after which the texture repeats, in texture coordinates; 0 if it does not."""
        return {Wrap.REPEAT: 1, Wrap.MIRROR: 2, Wrap.CLAMP: 0}[self]

    def texels(self, numbers: Int[np.ndarray, "*n"], size: int) -> Int[np.ndarray, "*n"]:
        """Return the texels in [0, size) that are seen at any number of texels from the border."""
        if self is Wrap.CLAMP:
            return numbers.clip(0, size - 1)
        inside = numbers % (self.period * size)
        return np.minimum(inside, 2 * size - 1 - inside)  # the second one is smaller only in a mirror image


Wraps = tuple[Wrap, Wrap]  # along u and along v
REPEATED: Wraps = (Wrap.REPEAT, Wrap.REPEAT)


@dataclass(frozen=True)
class ModelPart:
    """Mesh of one material.

    Attributes:
        name: of the part.
        vertices: at rest, in the coordinates of the model.
        faces: indices into the vertices.
        uvs: texture coordinates, u right and v down; None without texture.
        texture: base color in sRGB, and alpha.
        factor: linear color that multiplies texture and vertex colors.
        colors: linear color per vertex; None for white.
        masked: True if the alpha of the texture cuts holes.
        wrap: wrap modes of the texture outside [0, 1].
        normals: unit normals at rest, which distinguish hard and smooth edges; None if all are smooth.
    """

    name: str
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    uvs: Float[np.ndarray, "v 2"] | None = None
    texture: UInt8[np.ndarray, "h w 4"] | None = None
    factor: tuple[float, float, float] = (1.0, 1.0, 1.0)
    colors: Float[np.ndarray, "v 3"] | None = None
    masked: bool = False
    wrap: Wraps = REPEATED
    normals: Float[np.ndarray, "v 3"] | None = None

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
            uvs = np.einsum("nk,nkc->nc", barycentrics, self.uvs[corners])
            texels = sample_bilinear(self.texture, uvs, self.wrap)
            linear = linear * to_linear(texels[:, :3] / 255)
            alpha = texels[:, 3] if self.masked else alpha
        return to_srgb(linear).astype(np.float32), alpha.round().astype(np.int64)


@dataclass(frozen=True)
class Model:
    """A model of the user's own, at rest.

    Attributes:
        parts: meshes; at least one with triangles.
        notes: sentences about content that is not used or was changed.
    """

    parts: tuple[ModelPart, ...]
    notes: tuple[str, ...] = ()

    @property
    def vertices(self) -> Float[np.ndarray, "v 3"]:
        """Vertices of all parts."""
        return np.concatenate([part.vertices for part in self.parts])

    @property
    def smoothing_groups(self) -> Int[np.ndarray, " v"] | None:
        """Smoothing groups of all vertices, as in `TexturedMesh`; None without normals."""
        if all(part.normals is None for part in self.parts):
            return None
        rows = [np.zeros((len(part.vertices), 3)) if part.normals is None else part.normals for part in self.parts]
        return group_vertices(np.concatenate(rows), EQUAL_NORMALS)[1]

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
            selected = (faces >= start) & (faces < start + len(part.faces))
            colors[selected], alpha[selected] = part.sample(faces[selected] - start, barycentrics[selected])
            start += len(part.faces)
        return colors, alpha

    def placed(self, matrix: Float[np.ndarray, "4 4"]) -> "Model":
        """Return the model with an affine transform of its vertices."""
        return replace(
            self,
            parts=tuple(
                replace(
                    part,
                    vertices=(part.vertices @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32),
                    normals=None if part.normals is None else transform_normals(matrix[None], part.normals),
                )
                for part in self.parts
            ),
        )


def transform_normals(
    matrices: Float[np.ndarray, "#v 4 4"], normals: Float[np.ndarray, "v 3"]
) -> Float[np.ndarray, "v 3"]:
    """Return unit normals of a surface after affine transforms of its vertices; 0 where there is none.

    Args:
        matrices: one for all vertices, or one per vertex.
        normals: of any length.
    """
    x, y, z = np.moveaxis(matrices[:, :3, :3], 2, 0)
    with np.errstate(all="ignore"):
        cofactors = np.stack([np.cross(y, z), np.cross(z, x), np.cross(x, y)], -1)
        cofactors *= np.sign(np.sum(x * cofactors[..., 0], -1))[:, None, None]  # inverse transpose, up to its length
        moved = np.sum(cofactors * normals[:, None].astype(np.float64), -1)
        return np.nan_to_num(moved / np.linalg.norm(moved, axis=1, keepdims=True), posinf=0.0, neginf=0.0)


def single_precision(parts: Sequence[ModelPart], notes: Sequence[str] = ()) -> Model:
    """Return the model of parts, with vertices in float32; one that is far from the origin is moved there first.

    Args:
        parts: as in the file, in float64.
        notes: sentences about the file; one about the move is added.

    Raises:
        BadInput: vertices are not finite numbers, in float32.
    """
    center = far_center(np.concatenate([part.vertices for part in parts]))
    with np.errstate(over="ignore"):
        placed = [replace(part, vertices=(part.vertices - center).astype(np.float32)) for part in parts]
    if not all(np.isfinite(part.vertices).all() for part in placed):
        raise BadInput("the model has vertices that are not finite numbers (NaN or infinity); export it again")
    return Model(tuple(placed), (*notes, *([moved_note(center)] if center.any() else [])))


def far_center(vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, " 3"]:
    """Return the center of a model that is far from the origin; 0 for others."""
    with np.errstate(all="ignore"):  # numbers that are not finite are refused elsewhere
        low, high = vertices.min(0).astype(np.float64), vertices.max(0).astype(np.float64)
        size, distance = np.abs(high - low).max(), max(np.abs(low).max(), np.abs(high).max())
    is_far = np.isfinite(distance) and distance > FAR * size
    return low / 2 + high / 2 if is_far else np.zeros(3)


def too_many_triangles(most: int) -> BadInput:
    """Return the error about a model with more triangles than `asset.max_faces`, whose rest was not read."""
    return BadInput(
        f"the model has more than {most} triangles, the limit asset.max_faces: simplify it, or raise the limit with "
        "--set asset.max_faces=N"
    )


def moved_note(center: Float[np.ndarray, " 3"]) -> str:
    """Return a note about a model that was moved from a far center to the origin."""
    place = ", ".join(f"{value:.6g}" for value in center)
    return f"the model is far from the origin; it was moved by minus ({place}), to keep its shape in single precision"


def sample_bilinear(
    texture: UInt8[np.ndarray, "h w c"], uvs: Float[np.ndarray, "n 2"], wrap: Wraps = REPEATED
) -> Float[np.ndarray, "n c"]:
    """Sample a texture bilinearly; values as in the texture."""
    height, width = texture.shape[:2]
    u, v = (_folded(uvs[:, axis], mode) for axis, mode in enumerate(wrap))
    x, y = u * width - 0.5, v * height - 0.5
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = (x - left)[:, None], (y - top)[:, None]
    total = np.zeros((len(uvs), texture.shape[2]))
    for row, wy in ((top, 1 - fy), (top + 1, fy)):
        for column, wx in ((left, 1 - fx), (left + 1, fx)):
            total += wy * wx * texture[wrap[1].texels(row, height), wrap[0].texels(column, width)]
    return total


def _folded(coordinates: Float[np.ndarray, " n"], mode: Wrap) -> Float[np.ndarray, " n"]:
    """Return texture coordinates of the same texels in the first period."""
    return coordinates % mode.period if mode.period else coordinates.clip(0, 1)


def to_linear(srgb: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Convert sRGB to linear values (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((np.maximum(srgb, 0) + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Convert linear values, clipped to [0, 1], to sRGB; inverse of `to_linear`."""
    clipped = linear.clip(0, 1)
    return np.where(clipped <= 0.0031308, clipped * 12.92, 1.055 * clipped ** (1 / 2.4) - 0.055)
