"""Textured meshes, static and tracked over time."""

from dataclasses import dataclass, replace

from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class TexturedMesh:
    """Triangle mesh with one texture; vertices are split along the texture seams.

    Attributes:
        vertices: positions, world units.
        faces: indices into `vertices`, counter-clockwise seen from outside.
        uvs: texture coordinates in [0, 1], u to the right, v down (row 0 of the texture is v = 0, as in glTF).
        texture: colors in [0, 1].
        smoothing_groups: any numbers; vertices at one place share a normal if theirs are equal. None: all of them do.
    """

    vertices: Float[Tensor, "v 3"]
    faces: Int[Tensor, "f 3"]
    uvs: Float[Tensor, "v 2"]
    texture: Float[Tensor, "h w 3"]
    smoothing_groups: Int[Tensor, " v"] | None = None

    def select(self, vertices: Int[Tensor, " w"], faces: Int[Tensor, "f 3"]) -> "TexturedMesh":
        """Return the mesh of some vertices, in the given order, with triangles between them."""
        groups = None if self.smoothing_groups is None else self.smoothing_groups[vertices]
        return replace(
            self, vertices=self.vertices[vertices], faces=faces, uvs=self.uvs[vertices], smoothing_groups=groups
        )


@dataclass(frozen=True)
class TrackedMesh:
    """Mesh of fixed topology whose vertices move over the frames; the frame rate is not part of it.

    Attributes:
        mesh: the mesh at rest, that of the reference frame.
        offsets: added to the vertices at every frame, world units.
        textures: colors of every frame in [0, 1]; None if all frames have the texture of `mesh`.
        reference_frame: frame that the mesh was extracted from; its offsets are 0 up to later corrections.
    """

    mesh: TexturedMesh
    offsets: Float[Tensor, "t v 3"]
    textures: Float[Tensor, "t h w 3"] | None = None
    reference_frame: float = 0.0
