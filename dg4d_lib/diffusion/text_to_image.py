"""Text-to-image generation with any pipeline of diffusers."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.diffusion.components import compute_dtype
from dg4d_lib.diffusion.flop_counter import attach_flop_counter
from dg4d_lib.diffusion.pipelines import (
    after_step,
    call_parameters,
    call_pipeline,
    guidance_arguments,
    load_pipeline,
    networks_of,
)
from dg4d_lib.errors import BadInput
from dg4d_lib.input_settings import TextSettings


def draw_picture(
    model: Path,
    text: str,
    settings: TextSettings,
    generator: torch.Generator,
    device: torch.device,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Float[Tensor, "h w 3"]:
    """Generate one image.

    Args:
        model: folder of a pipeline in diffusers' layout, with model_index.json; no code of it is executed.
        text: prompt; `settings.suffix` is appended.
        settings: of the pipeline.
        generator: of the noise; on the CPU, so that all devices get the same noise.
        device: of the networks; on the CPU they use fp32.
        progress: called with (denoising steps done, total).

    Returns:
        sRGB in [0, 1], on the CPU.

    Raises:
        BadInput: the folder holds no such pipeline, or it refused a setting or returned no valid image.
        BackendUnavailable: diffusers or transformers is not installed.
    """
    pipeline = _load(model, compute_dtype(device, settings.precision))
    for network in networks_of(pipeline).values():
        attach_flop_counter(network)
    if settings.low_memory and device.type != "cpu":
        pipeline.enable_model_cpu_offload(device=device)
    else:
        pipeline.to(device)
    arguments = {
        "prompt": text + settings.suffix,
        "num_inference_steps": settings.num_inference_steps,
        **guidance_arguments(pipeline, settings.guidance_scale),
        "height": settings.size,
        "width": settings.size,
        "generator": generator,
        "output_type": "np",
        "callback_on_step_end": after_step(settings.num_inference_steps, progress),
    }
    result = call_pipeline(pipeline, model, arguments)
    if any(getattr(result, "nsfw_content_detected", None) or ()):
        raise BadInput(f"the safety checker of {model} blanked the image; change the prompt or the seed")
    image = torch.from_numpy(result.images[0]).float()
    if not image.isfinite().all():
        raise BadInput(
            f"the pipeline in {model} overflowed in {settings.precision}; use --set text.precision=fp32 or bf16"
        )
    return image.clamp(0, 1)


def _load(model: Path, dtype: torch.dtype) -> Any:
    """Load the pipeline of model_index.json.

    Raises:
        BadInput: there is none, it cannot be read, or it is not a text-to-image pipeline.
    """
    pipeline = load_pipeline(model, dtype)
    parameters = call_parameters(pipeline)
    required = [name for name, parameter in parameters.items() if parameter.default is parameter.empty]
    other = [name for name in required if name not in ("prompt", "kwargs")]
    if "prompt" not in parameters or "image" in parameters or other:
        raise BadInput(f"{type(pipeline).__name__} in {model} is not a text-to-image pipeline; choose one that is")
    return pipeline
