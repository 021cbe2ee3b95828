"""A textured mesh as a value."""

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
