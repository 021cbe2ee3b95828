"""Textured meshes as values."""

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class TexturedMesh:
    """Triangles with one texture; vertices are already split at the seams of the texture.

    Attributes:
        vertices: world units.
        faces: indices into `vertices`, counter-clockwise seen from outside.
        uvs: texture coordinates in [0, 1], u to the right, v down (row 0 of the texture is v = 0, as in glTF).
        texture: color in [0, 1].
    """

    vertices: Float[Tensor, "v 3"]
    faces: Int[Tensor, "f 3"]
    uvs: Float[Tensor, "v 2"]
    texture: Float[Tensor, "h w 3"]


@dataclass(frozen=True)
class TrackedMesh:
    """One topology that moves; it has frames and no frame rate.

    Attributes:
        mesh: at rest.
        offsets: what to add to the vertices at every frame, world units.
        textures: the colors of every frame in [0, 1], where they change; None: always the mesh's own.
        rest: the frame at which the moved mesh is the mesh at rest, but for what was corrected afterwards.
    """

    mesh: TexturedMesh
    offsets: Float[Tensor, "t v 3"]
    textures: Float[Tensor, "t h w 3"] | None = None
    rest: float = 0.0
