"""A subject reconstructed without optimization: ImageDream makes four views of it, LGM Gaussians out of them."""

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
from steps.runtime.weights import Opened, open_weights

NOTE = "start: Gaussians reconstructed by LGM from four views that ImageDream made of the picture"


@dataclass(frozen=True)
class Reconstruction:
    """Gaussians, and what the record says about them.

    Attributes:
        gaussians: like the subject from azimuth 0.
        opened: the weights that made them.
    """

    gaussians: Gaussians
    opened: tuple[Opened, ...]

    def added_to(self, facts: StepReport) -> StepReport:
        """The facts of a step that also used this."""
        weights, licenses = dict(facts.weights), dict(facts.licenses)
        for opened in self.opened:
            weights.update(opened.digests)
            licenses.update(opened.licenses)
        return replace(facts, weights=weights, licenses=licenses, notes=(*facts.notes, NOTE))


def reconstruct_subject(
    subject: Float[Tensor, "h w 4"], settings: LgmStartSettings, rasterize: Rasterizer, generator: torch.Generator
) -> Reconstruction:
    """Reconstruct a cut-out, in the frame it has.

    Args:
        subject: straight alpha, square, seen from azimuth and elevation 0; the result lies where it does.
        settings: weights and sampler.
        rasterize: draws there, to find out how the reconstruction is turned.
        generator: the source of ImageDream's first noise.

    Raises:
        BadInput: weights that are damaged, or of something else.
        BackendUnavailable: weights or packages that are not here.
    """
    opened = open_weights(settings.views_weights), open_weights(settings.weights)
    device = default_device()
    picture = over_white(subject)
    model = ImageDream.load(opened[0].folder, settings.precision, device)
    condition = model.conditioned_on(picture[None])
    views = model.views(condition, generator, settings.num_inference_steps, settings.guidance_scale).to(picture)
    del model  # before the next one takes its memory
    lgm = load_lgm(opened[1].folder, Placement(device, compute_dtype(device, settings.precision)))
    return Reconstruction(reconstruct(lgm, views, picture, rasterize), opened)
