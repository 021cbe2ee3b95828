"""Reference frame selection: the frame whose extracted mesh follows the whole motion best.

Parts that touch in the reference frame share a surface and tear when they separate; hidden or folded parts have no
surface yet. So several frames are tried on a coarse grid and compared by their silhouettes over the whole motion.
"""

from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dg4d_lib.deformation.interface import Displacement
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.kernels.workers import run_parallel
from dg4d_lib.mesh.extraction.density import density_field
from dg4d_lib.mesh.extraction.extract import extract_surface, select_level
from dg4d_lib.mesh.extraction.silhouettes import render_silhouettes, silhouette_iou
from dg4d_lib.mesh.tracking.skinning import skin_vertices
from dg4d_lib.rasterizer.interface import Rasterizer
from dg4d_lib.settings import MeshSettings

CANDIDATES = 10  # candidate frames
COMPARED = 8  # frames at which silhouettes are compared
GRID = 64  # cells per axis of the candidates' density field
SHORTEST = 1e-3  # length of an edge at which it is clamped, relative to its length at rest
GAIN = 0.005  # intersection over union that a candidate must gain over the first frame, else the first is kept


@dataclass(frozen=True)
class Trial:
    """Coarse mesh of one frame, moved with the Gaussians.

    Attributes:
        frame: whose surface it is.
        iou: mean intersection over union of silhouettes with the Gaussians', over frames and views, in [0, 1].
        stretch: root mean square logarithm of the lengths of its edges over those at rest. Gaussians that change places
            between limbs tear it, even where silhouettes agree.
    """

    frame: int
    iou: float
    stretch: float


def relative_to_frame(displacement: Displacement, frame: int) -> Displacement:
    """Return the displacement relative to the cloud at a frame."""
    return Displacement(**{name: value - value[frame] for name, value in vars(displacement).items()})


def select_reference_frame(
    states: Gaussians, displacement: Displacement, rasterize: Rasterizer, settings: MeshSettings
) -> Trial:
    """Select the frame whose skinned surface matches the silhouettes of the Gaussians in all frames best.

    Args:
        states: the cloud at every frame (fields "t n 3").
        displacement: of the canonical cloud at every frame.
        rasterize: the splatting backend.
        settings: mesh settings.

    Raises:
        FitDiverged: the cloud is empty.
    """
    frames = len(states.means)
    compared = evenly_spaced(frames, COMPARED)
    silhouettes = render_silhouettes(states, compared, rasterize)
    trials: dict[int, Trial] = {}

    def try_frame(frame: int) -> None:
        rest = states.at(frame)
        field = density_field(rest, settings.model_copy(update={"grid": min(GRID, settings.grid)}))
        level, _ = select_level(field, rest, rasterize, settings.density_threshold)
        vertices, faces = (torch.from_numpy(array) for array in extract_surface(field, level))
        motion = relative_to_frame(displacement, frame)
        selected = Displacement(**{name: value[compared] for name, value in vars(motion).items()})
        moved = vertices + skin_vertices(vertices, rest, selected)
        iou = float(silhouette_iou(moved, faces, silhouettes).mean())
        trials[frame] = Trial(frame, iou, edge_stretch(vertices, moved, faces))

    candidates = evenly_spaced(frames, CANDIDATES)
    run_parallel([partial(try_frame, frame) for frame in candidates])
    best = max((trials[frame] for frame in candidates), key=lambda trial: trial.iou)
    return best if best.iou > trials[0].iou + GAIN else trials[0]


def edge_stretch(rest: Float[Tensor, "v 3"], moved: Float[Tensor, "t v 3"], faces: Int[Tensor, "f 3"]) -> float:
    """Return the root mean square logarithm of the lengths of edges over those at rest; 0 for rigid motions."""
    first, second = torch.cat([faces, faces.roll(-1, 1)]).T[:2]
    lengths = [(shape[..., first, :] - shape[..., second, :]).norm(dim=-1) for shape in (rest, moved)]
    share = lengths[1] / lengths[0].clamp_min(torch.finfo(rest.dtype).tiny)
    return float(share.clamp_min(SHORTEST).log().square().mean().sqrt())


def evenly_spaced(total: int, count: int) -> list[int]:
    """Return up to `count` distinct indices below `total`, including the first and the last."""
    return sorted({round(i * (total - 1) / max(min(count, total) - 1, 1)) for i in range(min(count, total))})
