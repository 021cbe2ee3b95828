"""Colors of the far side of a symmetric subject, taken from its near side across the mirror plane."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample

from dg4d_lib.cameras.orbit import RADIUS
from dg4d_lib.shape_prior.frustum import BINS, FAR, NEAR, SIZE, TAN_HALF_FOV, grid_places

LEAST_MATTER = 0.03  # probability below which a cell's color does not matter
SHOWN, COVERED = 0.6, 0.1  # transmittance from the input camera: above the first a mirror image is fully visible
SURE, UNSURE = 0.9, 0.6  # largest eigenvalue of the mirror moment: above the first the plane is trusted fully


@dataclass(frozen=True)
class MirrorPlane:
    """Mirror plane of a subject.

    Attributes:
        normal: unit vector, world axes.
        point: a point of the plane, world units.
        trust: how far to rely on it, in [0, 1].
    """

    normal: Float[Tensor, " 3"]
    point: Float[Tensor, " 3"]
    trust: float

    def places(self, places: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Return the mirror images of places, world units."""
        return places - 2 * ((places - self.point) @ self.normal)[:, None] * self.normal

    def directions(self, directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Return the mirror images of directions."""
        return directions - 2 * (directions @ self.normal)[:, None] * self.normal


def mirror_plane(moment: Float[Tensor, "3 3"], point: Float[Tensor, " 3"], symmetric: float) -> MirrorPlane:
    """Return the plane that a prediction of the network means.

    Args:
        moment: expected outer product of the unit normal with itself.
        point: nearest point to the origin.
        symmetric: probability that the subject has a mirror plane.
    """
    values, vectors = torch.linalg.eigh(moment.double())
    normal = vectors[:, -1].float()
    sure = min(1.0, max(0.0, (float(values[-1]) - UNSURE) / (SURE - UNSURE)))
    return MirrorPlane(normal, normal * (normal @ point), sure * symmetric)


def mirrored_colors(
    hidden: Float[Tensor, "128 128 64 3"],
    front: Float[Tensor, "128 128 3"],
    probability: Float[Tensor, "128 128 64"],
    transmittance: Float[Tensor, "128 128 64"],
    mask: Bool[Tensor, "128 128"],
    plane: MirrorPlane,
) -> Float[Tensor, "128 128 64 3"]:
    """Return hidden colors, replaced by the picture's where it shows the mirror image of a cell.

    Args:
        hidden: predicted colors.
        front: colors of the picture.
        probability: of matter, per cell.
        transmittance: from the input camera to every cell.
        mask: pixels of the subject.
        plane: mirror plane.
    """
    cells = ((probability > LEAST_MATTER) & mask[..., None]).nonzero()
    row, column, depth = cells.T
    distance = NEAR + (depth + 0.5) * (FAR - NEAR) / BINS
    x = (2 * (column + 0.5) / SIZE - 1) * TAN_HALF_FOV * distance
    y = (1 - 2 * (row + 0.5) / SIZE) * TAN_HALF_FOV * distance
    places = plane.places(torch.stack([x, y, RADIUS - distance], -1))
    at = grid_places(places[:, 0], -places[:, 1], RADIUS - places[:, 2])
    volumes = torch.stack([transmittance, probability])[None]
    left, matter = grid_sample(volumes, at[None, None, None], align_corners=False)[0, :, 0, 0]
    planes = torch.cat([front * mask[..., None], mask[..., None].float()], -1).permute(2, 0, 1)[None]
    *color, inside = grid_sample(planes, at[None, None, :, 1:], align_corners=False)[0, :, 0]
    shown = (
        ((left - COVERED) / (SHOWN - COVERED)).clamp(0, 1) * inside * (matter / probability[tuple(cells.T)]).clamp(0, 1)
    )
    share = (plane.trust * shown)[:, None]
    seen = torch.stack(color, -1) / inside.clamp(min=1e-3)[:, None]
    mixed = hidden.clone()
    mixed[tuple(cells.T)] = (1 - share) * hidden[tuple(cells.T)] + share * seen.clamp(0, 1)
    return mixed
