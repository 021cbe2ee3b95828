"""Score distillation sampling (SDS) for all priors (Poole et al. 2023; paper section 3.1).

alphabar is Stable Diffusion's schedule, z are clean latents (or pixels, for analytic denoisers), e is the noise:
x_t = sqrt(alphabar) z + sqrt(1 - alphabar) e;  grad = (1 - alphabar) (noise_pred - e);  d loss / d z = grad / images.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.diffusion.batching import MicroBatches
from dg4d_lib.diffusion.noise_schedule import NUM_TRAIN_TIMESTEPS, add_noise, alphas_cumprod
from dg4d_lib.errors import BadInput, listed

T_MAX_END = 0.02  # fraction of the schedule at the end of the annealing (paper)
T_MAX_LIMIT = 0.98  # fraction of the schedule above which T_max is clipped (DreamFusion)
MIN_TIMESTEP = 20  # of 1000 (DreamFusion: 0.02)
MAX_LISTED = 8  # frames in a message

PredictNoise = Callable[[Float[Tensor, "b c h w"], int], Float[Tensor, "b c h w"]]


@dataclass(frozen=True)
class TimestepSchedule:
    """Annealed timestep, one per iteration for the whole batch.

    Attributes:
        t_max_start: T_max at the start, fraction of the schedule; 0.98 in the paper, 0.5 in the dynamic stage.
        t_max_end: T_max at the end; 0.02 in the paper. The public code anneals from 1 to 0 in both stages.
        t_max_limit: T_max is clipped to this; 0.5 in the dynamic stage of the public code's first release.
        uniform: draw the timestep uniformly from 0.02 to T_max instead of using T_max itself.
    """

    t_max_start: float
    t_max_end: float = T_MAX_END
    t_max_limit: float = T_MAX_LIMIT
    uniform: bool = False

    def timestep(self, progress: float, generator: torch.Generator) -> int:
        """Return the timestep at a progress in [0, 1]; only uniform draws use the generator."""
        highest = annealed_timestep(progress, self.t_max_start, self.t_max_end, self.t_max_limit)
        if not self.uniform:
            return highest
        return int(torch.randint(MIN_TIMESTEP, highest + 1, (), generator=generator))


def annealed_timestep(
    progress: float, t_max_start: float, t_max_end: float = T_MAX_END, t_max_limit: float = T_MAX_LIMIT
) -> int:
    """Interpolate linearly from `t_max_start` to `t_max_end` of the schedule, clipped to 20 and `t_max_limit`.

    Args:
        progress: of the optimization, in [0, 1].
        t_max_start: fraction of the schedule at progress 0.
        t_max_end: fraction of the schedule at progress 1.
        t_max_limit: upper clip, fraction of the schedule.
    """
    fraction = t_max_start + (t_max_end - t_max_start) * progress
    highest = round(NUM_TRAIN_TIMESTEPS * t_max_limit)
    return min(max(round(NUM_TRAIN_TIMESTEPS * fraction), MIN_TIMESTEP), highest)


def sds_weight(timestep: int) -> float:
    """Return w(t) = 1 - alphabar(t): 0.0187 at 20, 0.326 at 250, 0.724 at 500, 0.994 at 980."""
    return 1.0 - float(alphas_cumprod()[timestep])


def distillation_loss(
    latents: Float[Tensor, "b c h w"], predict_noise: PredictNoise, timestep: int, noise: Float[Tensor, "b c h w"]
) -> Float[Tensor, ""]:
    """Return the distillation loss, divided by the number of images.

    Args:
        latents: z, with gradient.
        predict_noise: (x_t, t) -> noise_pred; called without gradient.
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
    """Return `distillation_loss` of encoded images; the result does not depend on the size of micro-batches.

    The gradient of an image depends on no other image, so each micro-batch is encoded, scored and differentiated at
    once. Memory holds the encoder's activations of one micro-batch only, and no forward pass is repeated (gradient
    checkpointing would repeat a third of the work). The backward pass returns the stored gradient. The loss is NaN if
    no predicted noise is finite, so that the fit stops: `distillation_loss` alone would be 0.

    Args:
        images: renders in [0, 1]; loss and gradient are on their device.
        encode: images to latents, differentiable.
        predict_noise: (x_t, t, slice of the images) -> noise_pred.
        timestep: t, one for the batch.
        noise: e.
        batches: micro-batches of images.
    """

    def differentiate(piece: slice) -> tuple[Tensor, Tensor, Tensor]:
        predictions = []

        def predict(noisy: Float[Tensor, "p c u v"], timestep: int) -> Float[Tensor, "p c u v"]:
            predictions.append(predict_noise(noisy, timestep, piece))
            return predictions[0]

        pixels = images[piece].detach().requires_grad_()
        with torch.enable_grad():
            latents = encode(pixels)
            noises = noise[piece].to(latents.device)
            mean = distillation_loss(latents, predict, timestep, noises)
            loss = mean * len(pixels)  # divided at the end, so that half precision loses no digits
        usable = predictions[0].isfinite().any().to(images.device)
        return loss.detach().to(images.device), torch.autograd.grad(loss, pixels)[0], usable

    losses, gradients, usable = zip(*batches.run(differentiate, len(images)), strict=True)
    loss = torch.where(torch.stack(usable).any(), torch.stack(losses).sum(), torch.nan)
    return _Differentiated.apply(images, loss / len(images), torch.cat(gradients) / len(images))


def require_finite_conditioning(*parts: Float[Tensor, "t *_"]) -> None:
    """Refuse the encoding of frames if the networks overflowed in it: the loss of such frames would be zero.

    Args:
        parts: embeddings and latents, one per frame.

    Raises:
        BadInput: names the frames.
    """
    finite = torch.stack([part.flatten(1).isfinite().all(1) for part in parts]).all(0)
    if broken := [str(frame) for frame, whole in enumerate(finite.tolist()) if not whole]:
        raise BadInput(
            f"the encoding of {len(broken)} of {len(finite)} frames is not finite (frame "
            f"{listed(broken, MAX_LISTED)}): the networks overflow in this precision, or their weights are damaged; "
            "set the precision of the model (prior.precision, refiner.prior.precision or static.start.precision) to "
            "bf16 or fp32"
        )


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
