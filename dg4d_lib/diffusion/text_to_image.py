"""A picture out of words, by any text-to-image pipeline of diffusers that the user names."""

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
from dg4d_lib.settings import TextSettings


def draw_picture(
    model: Path,
    text: str,
    settings: TextSettings,
    generator: torch.Generator,
    device: torch.device,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Float[Tensor, "h w 3"]:
    """Draw one picture.

    Args:
        model: folder of a pipeline in diffusers' layout, with its model_index.json; nothing of it is executed.
        text: what to draw; `settings.suffix` is added.
        settings: how.
        generator: of the noise, on the processor: then devices agree.
        device: where the networks work; on a processor they are fp32 whatever the settings say.
        progress: told how many denoising steps are done.

    Returns:
        sRGB in [0, 1], on the processor.

    Raises:
        BadInput: the folder holds no such pipeline, or what came out is no picture.
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
    made = pipeline(text + settings.suffix, **{name: value for name, value in options.items() if name in known})
    if any(getattr(made, "nsfw_content_detected", None) or ()):
        raise BadInput(f"the pipeline in {model} blanked its picture as unsafe; choose other words or another seed")
    picture = torch.from_numpy(made.images[0]).float()
    if not picture.isfinite().all():
        raise BadInput(
            f"the pipeline in {model} overflowed in {settings.precision}; choose --set text.precision=fp32 or bf16"
        )
    return picture.clamp(0, 1)


def _load(model: Path, dtype: torch.dtype) -> Any:
    """The pipeline that model_index.json names.

    Raises:
        BadInput: there is none, it cannot be read, or it makes no pictures out of words.
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
        raise BackendUnavailable(f"the pipeline in {model} needs a package that is not here: {error}") from error
    except Exception as error:  # each class and format of file has errors of its own
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise BadInput(f"the pipeline in {model} cannot be read: {reason}") from error
    asked = inspect.signature(pipeline.__call__).parameters
    other = [name for name, kind in asked.items() if kind.default is kind.empty and name not in ("prompt", "kwargs")]
    if "prompt" not in asked or "image" in asked or other:
        raise BadInput(f"{type(pipeline).__name__} in {model} does not make pictures out of words alone")
    return pipeline


def _after_step(total: int, progress: Callable[[int, int], None]) -> Callable[..., dict[str, Any]]:
    """What diffusers calls after every step with the pipeline, the step's number, its time and tensors."""

    def told(_pipeline: Any, number: int, _time: Any, tensors: dict[str, Any]) -> dict[str, Any]:
        progress(min(number + 1, total), total)
        return tensors

    return told
