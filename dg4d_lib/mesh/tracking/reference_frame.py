"""The moment from which one mesh can follow the whole motion best.

Parts that touch at the moment of extraction share a surface and tear when they part; what is hidden or folded then has
no surface to unfold. So a few moments are tried on a coarse grid, and the outlines over the whole motion decide.
"""

import torch

from dg4d_lib.deformation.interface import Displacement
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.extraction.density import density_field
from dg4d_lib.mesh.extraction.extract import best_level, surface
from dg4d_lib.mesh.extraction.outlines import agreement, outlines_of
from dg4d_lib.mesh.tracking.skinning import skin_vertices
from dg4d_lib.rasterizer.interface import Rasterizer
from dg4d_lib.settings import MeshSettings

CANDIDATES = 12  # moments that are tried
MOMENTS = 8  # at which outlines are compared
GRID = 64  # cells of the trial's density field
GAIN = 0.005  # of intersection over union: less is no reason to leave the first frame


def relative_to_frame(displacement: Displacement, frame: int) -> Displacement:
    """The same motion, told from where the cloud is at this frame."""
    return Displacement(**{name: value - value[frame] for name, value in vars(displacement).items()})


def select_reference_frame(
    states: Gaussians, displacement: Displacement, rasterize: Rasterizer, settings: MeshSettings
) -> tuple[int, float]:
    """The frame whose surface, carried along, agrees best with the outlines of the Gaussians at all times.

    Args:
        states: the cloud at every frame (fields "t n 3").
        displacement: of the canonical cloud at every frame.
        rasterize: the splatting backend.
        settings: of the mesh.

    Returns:
        The frame, and its mean intersection over union over moments and views, in [0, 1].

    Raises:
        FitDiverged: the cloud is empty.
    """
    frames = len(states.means)
    moments = evenly_spaced(frames, MOMENTS)
    outlines = outlines_of(states, moments, rasterize)
    scores = {}
    for frame in evenly_spaced(frames, CANDIDATES):
        rest = states.at(frame)
        field = density_field(rest, settings.model_copy(update={"grid": min(GRID, settings.grid)}))
        level, _ = best_level(field, rest, rasterize, settings.density_threshold)
        vertices, faces = (torch.from_numpy(array) for array in surface(field, level))
        motion = relative_to_frame(displacement, frame)
        some = Displacement(**{name: value[moments] for name, value in vars(motion).items()})
        moved = vertices + skin_vertices(vertices, rest, some)
        scores[frame] = float(agreement(moved, faces, outlines).mean())
    best = max(scores, key=lambda frame: scores[frame])
    chosen = best if scores[best] > scores[0] + GAIN else 0
    return chosen, scores[chosen]


def evenly_spaced(total: int, count: int) -> list[int]:
    """Up to `count` different numbers below `total`, the first and the last included."""
    return sorted({round(i * (total - 1) / max(min(count, total) - 1, 1)) for i in range(min(count, total))})
