"""Pictures of painted things from many sides at once; their light is part of the paint and moves with them.

What is seen of a point is the same from everywhere and at every time, as in renders of a model's base color: a motion
of Gaussians that keep their colors can reach it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.mesh_rasterizer.zbuffer import interpolate, rasterize_mesh
from examples.drawing import AMBIENT, KEY, Creature
from examples.shapes import normals

SAMPLES = 3  # a side of a pixel
SKY, SUN = 0.10, 0.62  # shares of the light from above, and from where the sun stands


@dataclass(frozen=True)
class Painted:
    """A creature with a color at every vertex."""

    creature: Creature

    @cached_property
    def faces(self) -> Int[Tensor, "f 3"]:
        """The triangles, the same at every time."""
        return torch.from_numpy(self.creature.skin.faces.astype(np.int64))

    @cached_property
    def colors(self) -> Float[Tensor, "v 3"]:
        """Paint under the light at rest, in [0, 1]."""
        rest = self.creature.skin
        normal = normals(rest.points, rest.faces)
        sun = np.clip((normal @ KEY + 0.35) / 1.35, 0, 1)[:, None]
        light = rest.openness[:, None] * (AMBIENT + SKY * (0.5 + 0.5 * normal[:, 1:2]) + SUN * sun)
        paint = self.creature.color(rest.points, self.creature.features) * light
        return torch.from_numpy(paint.clip(0, 1).astype(np.float32))

    def vertices(self, moment: float) -> Float[Tensor, "v 3"]:
        """Where they are, world units; 0 and 1 are the same moment."""
        return torch.from_numpy(self.creature.at(moment).astype(np.float32))

    def draw(self, moment: float, cameras: Sequence[OrbitCamera]) -> Float[Tensor, "b h w 4"]:
        """Cut-outs from cameras of one size, straight alpha; nothing is black where nothing is."""
        fine = [replace(camera, width=SAMPLES * camera.width, height=SAMPLES * camera.height) for camera in cameras]
        fragments = rasterize_mesh(self.vertices(moment), self.faces, fine)
        covered = (fragments.faces >= 0)[..., None].float()
        samples = torch.cat([interpolate(fragments, self.faces, self.colors), covered], -1)
        small = avg_pool2d(samples.permute(0, 3, 1, 2), SAMPLES).permute(0, 2, 3, 1)
        return torch.cat([small[..., :3] / small[..., 3:].clamp(min=1e-6), small[..., 3:]], -1)
