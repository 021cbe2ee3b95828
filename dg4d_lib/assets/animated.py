"""The finished product as a value: one topology, moved."""

from dataclasses import dataclass, field
from typing import Any

from jaxtyping import Float
from torch import Tensor

from dg4d_lib.mesh.textured import TexturedMesh


@dataclass(frozen=True)
class Asset4D:
    """A tracked mesh.

    Attributes:
        mesh: at rest.
        offsets: what to add to the vertices at every frame, world units.
        fps: frames per second.
        extras: JSON that goes into the GLB untouched.
    """

    mesh: TexturedMesh
    offsets: Float[Tensor, "t v 3"]
    fps: float
    extras: dict[str, Any] = field(default_factory=dict)
