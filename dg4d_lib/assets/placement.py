"""Placement of an asset in meters: its height, and the ground below it.

The fit has coordinates of its own: the camera orbits the origin, and the subject floats around it. The files of a
package are in meters, with the origin on the ground below the center of the animation.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.textured import TexturedMesh

Surface = Asset4D | list[TexturedMesh]  # tracked mesh, or a mesh per frame


@dataclass(frozen=True)
class Placement:
    """Map from the coordinates of the fit to meters: x to `scale` * x + `translation`.

    Attributes:
        scale: meters per unit of the fit, above 0.
        translation: meters.
    """

    scale: float = 1.0
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def inverse(self) -> "Placement":
        """Map from meters to the coordinates of the fit."""
        x, y, z = (-value / self.scale + 0.0 for value in self.translation)
        return Placement(1 / self.scale, (x, y, z))

    def points(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Map points; float64 in between."""
        if self == Placement():
            return points
        return (points.double() * self.scale + torch.tensor(self.translation).double()).to(points)

    def surface(self, surface: Surface) -> Surface:
        """Map a tracked mesh or a mesh per frame."""
        if isinstance(surface, Asset4D):
            mesh = replace(surface.mesh, vertices=self.points(surface.mesh.vertices))
            return replace(surface, mesh=mesh, offsets=surface.offsets * self.scale)
        return [replace(mesh, vertices=self.points(mesh.vertices)) for mesh in surface]

    def gaussians(self, gaussians: Gaussians) -> Gaussians:
        """Map one state of a cloud or a batch of them."""
        growth = torch.tensor(self.scale).double().log().to(gaussians.log_scales)
        means, log_scales = self.points(gaussians.means), gaussians.log_scales + growth
        return replace(gaussians, means=means, log_scales=log_scales)


def ground_placement(surface: Surface, height_m: float, ground: bool) -> Placement:
    """Return the placement that gives an asset its height and puts it on the ground.

    Args:
        surface: mesh of the asset.
        height_m: height of its first frame, meters; 0: one meter per unit of the fit.
        ground: put the lowest point of all frames on y = 0, and the center of their bounding box above the origin.

    Raises:
        BadInput: the asset is flat, so that no scale gives it a height.
    """
    poses = _poses(surface)
    scale = 1.0
    if height_m > 0:
        height = float(poses[0][:, 1].max() - poses[0][:, 1].min())
        if height <= 0:
            raise BadInput("pack.height_m scales the height of the mesh, but this mesh is flat; set pack.height_m=0")
        scale = height_m / height
    if not ground:
        return Placement(scale)
    low = torch.stack([pose.amin(0) for pose in poses]).amin(0).double()
    high = torch.stack([pose.amax(0) for pose in poses]).amax(0).double()
    x, _, z = (-scale * (low + high) / 2).tolist()
    return Placement(scale, (x, -scale * float(low[1]), z))


def _poses(surface: Surface) -> Sequence[Float[Tensor, "_ 3"]]:
    if isinstance(surface, Asset4D):
        return list(surface.mesh.vertices + surface.offsets)
    return [mesh.vertices for mesh in surface]
