"""Score distillation: one code path for every prior (Poole et al. 2023; paper section 3.1).

alphabar is Stable Diffusion's schedule; z are clean latents (or pixels, for analytic denoisers), e the noise:
x_t = sqrt(alphabar) z + sqrt(1 - alphabar) e;  grad = (1 - alphabar) (e_predicted - e);  d loss / d z = grad / images.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.diffusion.batching import MicroBatches
from dg4d_lib.diffusion.noise_schedule import NUM_TRAIN_TIMESTEPS, add_noise, alphas_cumprod

T_MAX_END = 0.02  # share of the schedule at which the paper's annealing ends
MIN_TIMESTEP, MAX_TIMESTEP = 20, 980  # timesteps

PredictNoise = Callable[[Float[Tensor, "b c h w"], int], Float[Tensor, "b c h w"]]


@dataclass(frozen=True)
class TimestepSchedule:
    """Schedule of the timestep of an iteration, one for its whole batch.

    Attributes:
        start: T_max at the beginning, share of the schedule; the paper's is 0.98, and 0.5 in the dynamic stage.
        end: where it is going; the paper's is 0.02. The public code's schedule is from 1 to 0 in both stages.
        uniform: draw the timestep evenly from 0.02 to T_max, rather than take T_max itself.
    """

    t_max_start: float
    t_max_end: float = T_MAX_END
    uniform: bool = False

    def timestep(self, progress: float, generator: torch.Generator) -> int:
        """Return the timestep at a progress in [0, 1]; only uniform draws use the generator."""
        highest = annealed_timestep(progress, self.t_max_start, self.t_max_end)
        if not self.uniform:
            return highest
        return int(torch.randint(MIN_TIMESTEP, highest + 1, (), generator=generator))


def annealed_timestep(progress: float, t_max_start: float, t_max_end: float = T_MAX_END) -> int:
    """Linear from `t_max_start` to `t_max_end` of the schedule, and never outside of 20 to 980.

    Args:
        progress: share of the optimization that is done, in [0, 1].
        t_max_start: share of the schedule at progress 0.
        t_max_end: and at progress 1.
    """
    share = t_max_start + (t_max_end - t_max_start) * progress
    return min(max(round(NUM_TRAIN_TIMESTEPS * share), MIN_TIMESTEP), MAX_TIMESTEP)


def sds_weight(timestep: int) -> float:
    """Return w(t) = 1 - alphabar(t): 0.0187 at 20, 0.326 at 250, 0.724 at 500, 0.994 at 980."""
    return 1.0 - float(alphas_cumprod()[timestep])


def score_distillation(
    latents: Float[Tensor, "b c h w"], predict_noise: PredictNoise, timestep: int, generator: torch.Generator
) -> Float[Tensor, ""]:
    """Return `distillation_loss` with noise from a generator."""
    noise = torch.randn(latents.shape, dtype=latents.dtype, generator=generator).to(latents.device)
    return distillation_loss(latents, predict_noise, timestep, noise)


def distillation_loss(
    latents: Float[Tensor, "b c h w"], predict_noise: PredictNoise, timestep: int, noise: Float[Tensor, "b c h w"]
) -> Float[Tensor, ""]:
    """Return the distillation loss, divided by the number of images.

    Args:
        latents: z, with gradient.
        predict_noise: (x_t, t) -> predicted noise; called without gradient.
        timestep: t, one for the batch.
        noise: e.
    """
    with torch.no_grad():
        noisy = add_noise(latents, noise, timestep)
        gradient = torch.nan_to_num(sds_weight(timestep) * (predict_noise(noisy, timestep) - noise))
        target = latents - gradient
    return 0.5 * (latents - target).square().sum() / len(latents)


def distill_in_pieces(
    images: Float[Tensor, "b h w 3"],
    encode: Callable[[Float[Tensor, "p h w 3"]], Float[Tensor, "p c u v"]],
    predict_noise: Callable[[Float[Tensor, "p c u v"], int, slice], Float[Tensor, "p c u v"]],
    timestep: int,
    noise: Float[Tensor, "b c u v"],
    batches: MicroBatches,
) -> Float[Tensor, ""]:
    """Return `distillation_loss` of encoded images, computed in micro-batches of any size with the same result.

    The gradient of an image depends on no other image. So each piece is encoded, judged and differentiated at once:
    only one piece's activations of the encoder are held at a time, and no forward pass is done twice (checkpoints, or
    a second pass through the encoder after the loss, would repeat a third of the work). Backward only hands on the
    gradient that is already there.

    Args:
        images: renders in [0, 1]; where they lie, the loss and the gradient lie.
        encode: pictures to latents, with gradient.
        predict_noise: (x_t, t, slice of the images) -> predicted noise.
        timestep: t, one for the batch.
        noise: e.
        batches: how many images go through at once.
    """

    def judge(piece: slice) -> tuple[Tensor, Tensor]:
        pixels = images[piece].detach().requires_grad_()
        with torch.enable_grad():
            latents = encode(pixels)
            noises = noise[piece].to(latents.device)
            mean = distillation_loss(latents, lambda noisy, t: predict_noise(noisy, t, piece), timestep, noises)
            loss = mean * len(pixels)  # divided by their number at the end, where half precision cannot lose digits
        return loss.detach().to(images.device), torch.autograd.grad(loss, pixels)[0]

    losses, gradients = zip(*batches.run(judge, len(images)), strict=True)
    return _Differentiated.apply(images, torch.stack(losses).sum() / len(images), torch.cat(gradients) / len(images))


class _Differentiated(torch.autograd.Function):
    """Scalar with a precomputed gradient with respect to images."""

    @staticmethod
    def forward(context: Any, images: Tensor, loss: Tensor, gradient: Tensor) -> Tensor:
        context.save_for_backward(gradient)
        return loss.clone()

    @staticmethod
    def backward(context: Any, *upstream: Tensor) -> tuple[Tensor, None, None]:
        (gradient,) = context.saved_tensors
        return upstream[0] * gradient, None, None
