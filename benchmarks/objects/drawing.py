"""Renderer of painted objects; light is baked into the paint and moves with it.

A point has the same color in every view and at every time, as in renders of a model's base color, so a motion of
Gaussians with constant colors can reproduce it.
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

SAMPLES = 3  # samples per pixel and side
SKY, SUN = 0.10, 0.62  # fractions of ambient light from above and of directed light


@dataclass(frozen=True)
class Painted:
    """Creature with a color at every vertex."""

    creature: Creature

    @cached_property
    def faces(self) -> Int[Tensor, "f 3"]:
        """Return the triangles, the same at every time."""
        return torch.from_numpy(self.creature.skin.faces.astype(np.int64))

    @cached_property
    def colors(self) -> Float[Tensor, "v 3"]:
        """Return the lit paint in the rest pose, in [0, 1]."""
        rest = self.creature.skin
        normal = normals(rest.points, rest.faces)
        sun = np.clip((normal @ KEY + 0.35) / 1.35, 0, 1)[:, None]
        light = rest.openness[:, None] * (AMBIENT + SKY * (0.5 + 0.5 * normal[:, 1:2]) + SUN * sun)
        paint = self.creature.color(rest.points, self.creature.features) * light
        return torch.from_numpy(paint.clip(0, 1).astype(np.float32))

    def vertices(self, time: float) -> Float[Tensor, "v 3"]:
        """Return the vertices at a time, world units; 0 and 1 are the same."""
        return torch.from_numpy(self.creature.at(time).astype(np.float32))

    def draw(self, time: float, cameras: Sequence[OrbitCamera]) -> Float[Tensor, "b h w 4"]:
        """Render cut-outs from cameras of one size, straight alpha; empty pixels are black."""
        fine = [replace(camera, width=SAMPLES * camera.width, height=SAMPLES * camera.height) for camera in cameras]
        fragments = rasterize_mesh(self.vertices(time), self.faces, fine)
        covered = (fragments.faces >= 0)[..., None].float()
        samples = torch.cat([interpolate(fragments, self.faces, self.colors), covered], -1)
        small = avg_pool2d(samples.permute(0, 3, 1, 2), SAMPLES).permute(0, 2, 3, 1)
        return torch.cat([small[..., :3] / small[..., 3:].clamp(min=1e-6), small[..., 3:]], -1)
