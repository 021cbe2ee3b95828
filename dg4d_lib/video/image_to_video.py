"""Driving videos from any image-to-video pipeline of diffusers, called by its own parameter names."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from dg4d_lib.diffusion.components import compute_dtype
from dg4d_lib.diffusion.pipelines import (
    Offload,
    after_step,
    call_parameters,
    call_pipeline,
    load_pipeline,
    pipeline_class_name,
    place_pipeline,
)
from dg4d_lib.errors import BadInput
from dg4d_lib.input_settings import DiffusersVideoSettings
from dg4d_lib.video.canvas import cut_out, white_canvas
from dg4d_lib.video.driving import DrivingVideo

OWN_NAMES = {  # other pipelines' names of the same parameter
    "num_frames": ("frames",),
    "guidance_scale": ("max_guidance_scale",),
    "fps": ("frame_rate",),
}
TEMPORAL_FACTORS = ("vae_scale_factor_temporal", "vae_temporal_compression_ratio")
SPATIAL_FACTORS = ("vae_scale_factor_spatial", "vae_spatial_compression_ratio", "vae_scale_factor")
SIBLINGS = ("ImageToVideoPipeline", "Image2VideoPipeline")  # of a text-to-video class with the same networks


class ImageToVideo:
    """Image-to-video generator: animates the subject on a white background and mattes every frame.

    Attributes:
        pipeline: of diffusers, on its device.
        offload: its way of offloading.
        notes: sentences for the user about changed sizes and about failed matting.
    """

    def __init__(self, settings: DiffusersVideoSettings, model: Path, pipeline: Any, offload: Offload = "none") -> None:
        """Store the settings and a loaded pipeline, and check that it takes a picture.

        Raises:
            BadInput: it is not an image-to-video pipeline, or takes no last picture although a loop is asked for.
        """
        self.settings, self.pipeline, self.offload, self._model = settings, pipeline, offload, model
        self.notes: tuple[str, ...] = ()
        self._names = call_parameters(pipeline)
        check_image_to_video(pipeline, model, settings.loop)

    @classmethod
    def load(cls, model: Path, settings: DiffusersVideoSettings, device: torch.device) -> "ImageToVideo":
        """Load the pipeline of a folder and put it on a device within the memory budget.

        Raises:
            BadInput: the folder holds no image-to-video pipeline.
            BackendUnavailable: diffusers or a package that the pipeline needs is not installed.
        """
        pipeline = load_pipeline(model, compute_dtype(device, settings.precision), image_to_video_class(model))
        check_image_to_video(pipeline, model, settings.loop)
        return cls(settings, model, pipeline, place_pipeline(pipeline, device, settings.memory_gb))

    def generate_all(
        self,
        subject: Float[Tensor, "h w 4"],
        generators: Sequence[torch.Generator],
        progress: Callable[[int, int], None] = lambda done, total: None,
    ) -> list[DrivingVideo]:
        """Generate a video per random generator, one after the other.

        Args:
            subject: straight alpha, in [0, 1].
            generators: of the noise, on the CPU so that all devices get the same noise.
            progress: called with (denoising steps done, total).
        """
        canvas, (rows, columns) = white_canvas(subject, *self._size())
        picture = Image.fromarray((canvas * 255).round().to(torch.uint8).cpu().numpy())
        steps = self.settings.num_inference_steps
        videos = []
        for number, generator in enumerate(generators):
            report = after_step(steps * len(generators), progress, steps * number)
            frames = self._generate(picture, generator, report)[:, rows, columns]
            video, notes = cut_out(frames, subject, self.settings.fps)
            self._note(*notes)
            videos.append(video)
        return videos

    def _generate(
        self, picture: Image.Image, generator: torch.Generator, report: Callable[..., Any]
    ) -> Float[Tensor, "t y x 3"]:
        settings = self.settings
        count = self._frame_count()
        values: dict[str, Any] = {
            "image": picture,
            "prompt": settings.prompt,
            "negative_prompt": settings.negative_prompt,
            "height": picture.height,
            "width": picture.width,
            "num_frames": count,
            "fps": max(1, round(settings.fps * (count - 1) / max(1, settings.frames - 1))),
            "num_inference_steps": settings.num_inference_steps,
            "guidance_scale": settings.guidance_scale,
            "generator": generator,
            "output_type": "np",
            "callback_on_step_end": report,
        }
        if settings.loop:
            values["last_image"] = picture
        made = call_pipeline(self.pipeline, self._model, own_names(values, self._names)).frames[0]
        frames = torch.as_tensor(made).float()
        if not frames.isfinite().all():
            raise BadInput(
                f"the pipeline in {self._model} overflowed in {settings.precision}; use --set "
                "driving.precision=bf16 or fp32"
            )
        if frames.shape[1:3] != (picture.height, picture.width):
            raise BadInput(
                f"{type(self.pipeline).__name__} generated {frames.shape[2]} x {frames.shape[1]} pixels from a picture "
                f"of {picture.width} x {picture.height}; set driving.width and driving.height to a supported size"
            )
        return frames.clamp(0, 1)[kept_frames(len(frames), settings.frames, settings.loop)]

    def _frame_count(self) -> int:
        """Return the number of frames to generate: one more than a multiple of the VAE's temporal factor."""
        wanted = max(self.settings.generated_frames, self.settings.frames + self.settings.loop)
        factor = _first(self.pipeline, TEMPORAL_FACTORS, 1)
        return math.ceil((wanted - 1) / factor) * factor + 1 if factor > 1 else wanted

    def _size(self) -> tuple[int, int]:
        """Return height and width, multiples of the pixels of one patch of the network."""
        unit = _first(self.pipeline, SPATIAL_FACTORS, 8) * _patch(self.pipeline)
        asked = self.settings.height, self.settings.width
        height, width = (max(unit, round(side / unit) * unit) for side in asked)
        if (height, width) != asked:
            self._note(f"The video model takes multiples of {unit} pixels: {width} x {height} were generated.")
        return height, width

    def _note(self, *notes: str) -> None:
        self.notes = (*dict.fromkeys((*self.notes, *notes)),)


def check_image_to_video(pipeline: Any, model: Path, loop: bool) -> None:
    """Refuse a pipeline that takes no picture or needs more than one and a prompt.

    Raises:
        BadInput: names its class and what to choose.
    """
    name, parameters = type(pipeline).__name__, call_parameters(pipeline)
    required = {key for key, one in parameters.items() if one.default is one.empty and one.kind is not one.VAR_KEYWORD}
    frames = {"num_frames", *OWN_NAMES["num_frames"]} & set(parameters)
    if "image" not in parameters or not frames or required - {"image", "prompt"}:
        raise BadInput(f"{name} in {model} is not an image-to-video pipeline; choose one that is")
    if loop and "last_image" not in parameters:
        raise BadInput(
            f"driving.loop=true needs a first-last-frame model, and {name} in {model} takes no last picture; use "
            "driving.weights=wan2.1-flf2v, or driving.loop=false"
        )
    transformer = pipeline.components.get("transformer")
    if loop and getattr(getattr(transformer, "config", None), "image_dim", None) is None:
        raise BadInput(
            f"driving.loop=true needs a first-last-frame model, and the network of {name} in {model} was not trained "
            "on last pictures; use driving.weights=wan2.1-flf2v, or driving.loop=false"
        )


def image_to_video_class(model: Path) -> str:
    """Return the class for a folder: the image-to-video sibling of a text-to-video class, else empty for its own."""
    name = pipeline_class_name(model)
    if any(name.endswith(ending) for ending in SIBLINGS):
        return ""
    try:
        import diffusers  # noqa: PLC0415 - takes seconds
    except ImportError:
        return ""
    siblings = [name.removesuffix("Pipeline") + ending for ending in SIBLINGS]
    return next((sibling for sibling in siblings if hasattr(diffusers, sibling)), "")


def own_names(values: Mapping[str, Any], known: Mapping[str, Any]) -> dict[str, Any]:
    """Return values by the names that a pipeline has for them; those that it does not take are left out."""
    found = {}
    for name, value in values.items():
        for candidate in (name, *OWN_NAMES.get(name, ())):
            if candidate in known:
                found[candidate] = value
                break
    return found


def kept_frames(made: int, frames: int, loop: bool) -> list[int]:
    """Return the indices of evenly spaced frames; of a loop, without the last frame, which is the first again."""
    count = frames + loop
    last = made - 1
    return [round(index * last / max(1, count - 1)) for index in range(count)][:frames]


def _first(pipeline: Any, names: Sequence[str], default: int) -> int:
    """Return the first of the attributes that a pipeline has."""
    return next((int(value) for name in names if (value := getattr(pipeline, name, None))), default)


def _patch(pipeline: Any) -> int:
    """Return the side of a patch of the network, in latents."""
    config = getattr(pipeline.components.get("transformer"), "config", None)
    patch = getattr(config, "patch_size", 1) or 1
    return int(patch[-1] if isinstance(patch, list | tuple) else patch)
