"""Reference frame selection: the frame whose extracted mesh follows the whole motion best.

Parts that touch in the reference frame share a surface and tear when they separate; hidden or folded parts have no
surface yet. So several frames are tried on a coarse grid and compared by their silhouettes over the whole motion.
"""

from functools import partial

import torch

from dg4d_lib.deformation.interface import Displacement
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.kernels.workers import run_parallel
from dg4d_lib.mesh.extraction.density import density_field
from dg4d_lib.mesh.extraction.extract import extract_surface, select_level
from dg4d_lib.mesh.extraction.silhouettes import render_silhouettes, silhouette_iou
from dg4d_lib.mesh.tracking.skinning import skin_vertices
from dg4d_lib.rasterizer.interface import Rasterizer
from dg4d_lib.settings import MeshSettings

CANDIDATES = 12  # candidate frames
COMPARED = 8  # frames at which silhouettes are compared
GRID = 64  # cells per axis of the candidates' density field
GAIN = 0.005  # intersection over union that a candidate must gain over the first frame, else the first is kept


def relative_to_frame(displacement: Displacement, frame: int) -> Displacement:
    """Return the displacement relative to the cloud at a frame."""
    return Displacement(**{name: value - value[frame] for name, value in vars(displacement).items()})


def select_reference_frame(
    states: Gaussians, displacement: Displacement, rasterize: Rasterizer, settings: MeshSettings
) -> tuple[int, float]:
    """Select the frame whose skinned surface matches the silhouettes of the Gaussians in all frames best.

    Args:
        states: the cloud at every frame (fields "t n 3").
        displacement: of the canonical cloud at every frame.
        rasterize: the splatting backend.
        settings: mesh settings.

    Returns:
        The frame, and the mean intersection over union over frames and views, in [0, 1].

    Raises:
        FitDiverged: the cloud is empty.
    """
    frames = len(states.means)
    compared = evenly_spaced(frames, COMPARED)
    silhouettes = render_silhouettes(states, compared, rasterize)
    scores: dict[int, float] = {}

    def try_frame(frame: int) -> None:
        rest = states.at(frame)
        field = density_field(rest, settings.model_copy(update={"grid": min(GRID, settings.grid)}))
        level, _ = select_level(field, rest, rasterize, settings.density_threshold)
        vertices, faces = (torch.from_numpy(array) for array in extract_surface(field, level))
        motion = relative_to_frame(displacement, frame)
        selected = Displacement(**{name: value[compared] for name, value in vars(motion).items()})
        moved = vertices + skin_vertices(vertices, rest, selected)
        scores[frame] = float(silhouette_iou(moved, faces, silhouettes).mean())

    candidates = evenly_spaced(frames, CANDIDATES)
    run_parallel([partial(try_frame, frame) for frame in candidates])
    best = max(candidates, key=lambda frame: scores[frame])
    reference_frame = best if scores[best] > scores[0] + GAIN else 0
    return reference_frame, scores[reference_frame]


def evenly_spaced(total: int, count: int) -> list[int]:
    """Return up to `count` distinct indices below `total`, including the first and the last."""
    return sorted({round(i * (total - 1) / max(min(count, total) - 1, 1)) for i in range(min(count, total))})
