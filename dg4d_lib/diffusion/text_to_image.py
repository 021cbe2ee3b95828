"""Text-to-image generation with any pipeline of diffusers."""

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dg4d_lib.diffusion.components import HALF, compute_dtype, missing_packages
from dg4d_lib.diffusion.flop_counter import attach_flop_counter
from dg4d_lib.errors import BackendUnavailable, BadInput
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
        BadInput: the folder holds no such pipeline, or the pipeline returned no valid image.
        BackendUnavailable: diffusers or transformers is not installed.
    """
    pipeline = _load(model, compute_dtype(device, settings.precision))
    for part in pipeline.components.values():
        if isinstance(part, nn.Module):
            attach_flop_counter(part)
    if settings.low_memory and device.type != "cpu":
        pipeline.enable_model_cpu_offload(device=device)
    else:
        pipeline.to(device)
    pipeline.set_progress_bar_config(disable=True)
    options = {
        "num_inference_steps": settings.num_inference_steps,
        "guidance_scale": settings.guidance_scale,
        "height": settings.size,
        "width": settings.size,
        "generator": generator,
        "output_type": "np",
        "callback_on_step_end": _after_step(settings.num_inference_steps, progress),
    }
    known = inspect.signature(pipeline.__call__).parameters
    result = pipeline(text + settings.suffix, **{name: value for name, value in options.items() if name in known})
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
        BadInput: there is none, it cannot be read, or it is no text-to-image pipeline.
    """
    try:
        from diffusers import DiffusionPipeline  # noqa: PLC0415 - takes seconds
    except ImportError as error:
        raise missing_packages(error) from error
    if not (model / "model_index.json").is_file():
        raise BadInput(f"{model} has no model_index.json; give a text-to-image pipeline in the layout of diffusers")
    half = any(model.glob(f"*/*.{HALF}*"))
    try:
        pipeline = DiffusionPipeline.from_pretrained(
            model, dtype=dtype, variant=HALF if half else None, local_files_only=True
        )
    except ImportError as error:
        raise BackendUnavailable(f"the pipeline in {model} needs a package that is not installed: {error}") from error
    except Exception as error:  # every class and file format raises its own types
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise BadInput(f"the pipeline in {model} cannot be read: {reason}") from error
    parameters = inspect.signature(pipeline.__call__).parameters
    required = [name for name, parameter in parameters.items() if parameter.default is parameter.empty]
    other = [name for name in required if name not in ("prompt", "kwargs")]
    if "prompt" not in parameters or "image" in parameters or other:
        raise BadInput(f"{type(pipeline).__name__} in {model} is no text-to-image pipeline; choose one that is")
    return pipeline


def _after_step(total: int, progress: Callable[[int, int], None]) -> Callable[..., dict[str, Any]]:
    """Return a `callback_on_step_end` of diffusers that reports progress."""

    def report(_pipeline: Any, number: int, _time: Any, tensors: dict[str, Any]) -> dict[str, Any]:
        progress(min(number + 1, total), total)
        return tensors

    return report
