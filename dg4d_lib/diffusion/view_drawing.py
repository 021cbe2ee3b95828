"""Views of other sides drawn by an image-editing pipeline of diffusers with a LoRA for camera angles."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from dg4d_lib.diffusion.components import compute_dtype, missing_packages
from dg4d_lib.diffusion.lora import merge_lora
from dg4d_lib.diffusion.pipelines import (
    Offload,
    after_step,
    call_parameters,
    call_pipeline,
    guidance_arguments,
    load_pipeline,
    place_pipeline,
)
from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.input_settings import ImageEditViewsSettings

AZIMUTH_WORDS = {
    0: "front view",
    45: "front-right quarter view",
    90: "right side view",
    135: "back-right quarter view",
    180: "back view",
    225: "back-left quarter view",
    270: "left side view",
    315: "front-left quarter view",
}  # vocabulary of the LoRA
ELEVATION_WORDS = {-30: "low-angle shot", 0: "eye-level shot", 30: "elevated shot", 60: "high-angle shot"}
TRIGGER, DISTANCE_WORDS = "<sks>", "medium shot"


class DrawnDirection(NamedTuple):
    """Direction of a drawn view, degrees."""

    azimuth_deg: int
    elevation_deg: int

    def prompt(self, suffix: str) -> str:
        """Return the words of the LoRA for this camera."""
        words = f"{AZIMUTH_WORDS[self.azimuth_deg]} {ELEVATION_WORDS[self.elevation_deg]} {DISTANCE_WORDS}"
        return f"{TRIGGER} {words}{suffix}"


def directions_of(settings: ImageEditViewsSettings) -> list[DrawnDirection]:
    """Return the directions to draw: all but that of the input."""
    every = [DrawnDirection(azimuth, up) for up in settings.elevations_deg for azimuth in settings.azimuths_deg]
    return [one for one in dict.fromkeys(every) if one != DrawnDirection(0, 0)]


class ViewDrawer:
    """Image-editing pipeline that draws a subject from other directions.

    Attributes:
        pipeline: of diffusers, on its device.
        offload: its way of offloading.
    """

    def __init__(self, settings: ImageEditViewsSettings, model: Path, pipeline: Any, offload: Offload) -> None:
        """Store a loaded pipeline."""
        self.settings, self.pipeline, self.offload, self._model = settings, pipeline, offload, model

    @classmethod
    def load(
        cls, model: Path, lora: Path | None, settings: ImageEditViewsSettings, device: torch.device
    ) -> "ViewDrawer":
        """Load a pipeline, merge the LoRA into its transformer, and put it on a device within the memory budget.

        Raises:
            BadInput: the folder holds no image-editing pipeline, or the LoRA belongs to another network.
            BackendUnavailable: diffusers or transformers is not installed.
        """
        pipeline = load_pipeline(model, compute_dtype(device, settings.precision), **_processor(model))
        if not {"image", "prompt"} <= set(call_parameters(pipeline)) or "num_frames" in call_parameters(pipeline):
            raise BadInput(f"{type(pipeline).__name__} in {model} is not an image-editing pipeline; choose one that is")
        if lora is not None:
            merge_lora(pipeline.transformer, lora, settings.lora_scale)
        return cls(settings, model, pipeline, place_pipeline(pipeline, device, settings.memory_gb))

    def draw(
        self,
        picture: Float[Tensor, "h w 3"],
        directions: Sequence[DrawnDirection],
        seed: int,
        progress: Callable[[int, int], None] = lambda done, total: None,
    ) -> list[Float[Tensor, "s s 3"]]:
        """Draw the subject of a picture from other directions, with the same noise for all of them.

        Args:
            picture: over white, in [0, 1].
            directions: to draw.
            seed: of the noise.
            progress: called with (denoising steps done, total).
        """
        settings = self.settings
        given = Image.fromarray((picture * 255).round().to(torch.uint8).cpu().numpy())
        drawn = []
        for number, direction in enumerate(directions):
            total = settings.num_inference_steps * len(directions)
            values = {
                "image": given,
                "prompt": direction.prompt(settings.suffix),
                "height": settings.size,
                "width": settings.size,
                "num_inference_steps": settings.num_inference_steps,
                **guidance_arguments(self.pipeline, settings.guidance_scale),
                "generator": torch.Generator().manual_seed(seed),
                "output_type": "np",
                "callback_on_step_end": after_step(total, progress, number * settings.num_inference_steps),
            }
            made = torch.as_tensor(call_pipeline(self.pipeline, self._model, values).images[0]).float()
            if not made.isfinite().all():
                raise BadInput(
                    f"the pipeline in {self._model} overflowed in {settings.precision}; use --set "
                    "views.precision=bf16 or fp32"
                )
            drawn.append(made.clamp(0, 1))
        return drawn


def _processor(model: Path) -> dict[str, Any]:
    """Return the processor of Qwen2-VL for pictures alone; that of videos would need torchvision.

    Raises:
        BackendUnavailable: transformers is not installed.
        BadInput: the folder has a processor that cannot be read.
    """
    folder = model / "processor"
    if not folder.is_dir():
        return {}
    try:
        from transformers import Qwen2Tokenizer, Qwen2VLProcessor  # noqa: PLC0415 - takes seconds
        from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import (  # noqa: PLC0415
            Qwen2VLImageProcessorPil,
        )
    except ImportError as error:
        raise missing_packages(error) from error

    class PictureProcessor(Qwen2VLProcessor):  # type: ignore[misc]  # transformers is not followed
        """Processor without videos."""

        def check_argument_for_proper_class(self, argument_name: str, argument: Any) -> Any:
            """Accept that there is no processor of videos."""
            return None if argument is None else super().check_argument_for_proper_class(argument_name, argument)

    try:
        pictures = Qwen2VLImageProcessorPil.from_pretrained(folder, local_files_only=True)
        words = Qwen2Tokenizer.from_pretrained(folder, local_files_only=True)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BadInput(f"{folder} cannot be read: {type(error).__name__}: {error}".splitlines()[0]) from error
    except ImportError as error:
        raise BackendUnavailable(f"the processor in {folder} needs a package that is missing: {error}") from error
    return {"processor": PictureProcessor(pictures, words)}
