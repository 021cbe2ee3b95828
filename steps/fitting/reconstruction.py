"""Feed-forward reconstruction of a subject: four views by ImageDream, Gaussians by LGM."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.diffusion.components import Placement, compute_dtype, default_device
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.guidance.imagedream import ImageDream
from dg4d_lib.images import over_white
from dg4d_lib.rasterizer.interface import Rasterizer
from dg4d_lib.reconstruction.lgm import load_lgm, reconstruct
from dg4d_lib.settings import LgmStartSettings
from steps.runtime.job import StepReport
from steps.runtime.weights import LocatedWeights, open_weights

NOTE = "start: Gaussians reconstructed by LGM from four views that ImageDream generated from the picture"


@dataclass(frozen=True)
class Reconstruction:
    """Reconstructed Gaussians.

    Attributes:
        gaussians: Gaussians that match the subject from azimuth 0.
        opened: weights of the models.
    """

    gaussians: Gaussians
    opened: tuple[LocatedWeights, ...]

    def add_to(self, report: StepReport) -> StepReport:
        """Add the weights, licenses and note of the reconstruction to a report."""
        weights, licenses = dict(report.weights), dict(report.licenses)
        for opened in self.opened:
            weights.update(opened.digests)
            licenses.update(opened.licenses)
        return replace(report, weights=weights, licenses=licenses, notes=(*report.notes, NOTE))


def reconstruct_subject(
    subject: Float[Tensor, "h w 4"], settings: LgmStartSettings, rasterize: Rasterizer, generator: torch.Generator
) -> Reconstruction:
    """Reconstruct a cut-out at its place in the frame.

    Args:
        subject: square picture with straight alpha, from azimuth and elevation 0.
        settings: weights and sampler.
        rasterize: renders the reconstruction to find its orientation.
        generator: source of ImageDream's initial noise.

    Raises:
        BadInput: the weights are damaged, or of another model.
        BackendUnavailable: weights or libraries are not installed.
    """
    opened = open_weights(settings.views_weights), open_weights(settings.weights)
    device = default_device()
    picture = over_white(subject)
    model = ImageDream.load(opened[0].folder, settings.precision, device)
    condition = model.conditioned_on(picture[None])
    views = model.views(condition, generator, settings.num_inference_steps, settings.guidance_scale).to(picture)
    del model  # frees memory for the next model
    lgm = load_lgm(opened[1].folder, Placement(device, compute_dtype(device, settings.precision)))
    return Reconstruction(reconstruct(lgm, views, picture, rasterize), opened)
