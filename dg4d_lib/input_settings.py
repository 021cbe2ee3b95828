"""Settings of the inputs: prompt, picture or video, driving video, and generated views of other sides."""

from typing import Annotated, Literal

from pydantic import Field, field_validator

from dg4d_lib.settings import PRECISION, PipelineBudget, Precision, Settings, Share, VideoModelSettings


class TextSettings(Settings):
    """Input image by any text-to-image pipeline of diffusers; only for requests with a prompt."""

    weights: str = Field("", description="Hugging Face hub id, or a folder in diffusers' layout; empty: none")
    size: int = Field(512, ge=32, le=2048, multiple_of=8, description="pixels of the square image")
    num_inference_steps: int = Field(30, ge=1, le=1000, description="denoising steps")
    guidance_scale: float = Field(7.5, ge=0, le=100, description="classifier-free guidance")
    suffix: str = Field(
        ", the whole of it in the middle of the picture, plain white background",
        max_length=1000,
        description="appended to the prompt, so that the subject can be cut out",
    )
    precision: Precision = Field("fp16", description=PRECISION)
    low_memory: bool = Field(False, description="keep only the network in use on the GPU; slower")


MATTING_METHODS = ("auto", "u2netp", "backdrop", "none")  # other names are weights
BOX_FORM = "a box is X,Y,W,H in pixels: left and upper edge, width and height, both at least 1"


class SubjectSettings(Settings):
    """Conversion of any picture or video to cut-outs in one square frame."""

    matting: str = Field(
        "auto",
        min_length=1,
        description="cut-out of the subject. auto: the picture's alpha channel, else `backdrop` where the backdrop is "
        "plain, else `u2netp`; backdrop: by the color of a plain backdrop; u2netp: by U2-Netp; none: the alpha channel "
        "alone; or another network by a name from `dg4d weights list`, or a folder with onnx/model.onnx",
    )
    box: tuple[Annotated[int, Field(ge=0, le=1_000_000)], ...] = Field(
        (),
        max_length=4,
        description="[X, Y, width, height] of the subject in pixels of the upright picture; pixels outside become "
        "transparent; []: the whole picture",
    )
    size: int = Field(512, ge=32, le=2048, description="pixels of the square frame")
    framing: Literal["auto", "center", "keep"] = Field(
        "auto",
        description="center: crop to the subject and center it; keep: use the frame unchanged; "
        "auto: keep a square cut-out that contains the whole subject, else center",
    )
    border: float = Field(
        0.2, ge=0, lt=0.9, description="margin around a centered subject, fraction of the frame (public code)"
    )
    turn_deg: float = Field(
        0.0,
        ge=-60,
        le=60,
        description="yaw of the subject in degrees; positive: its right side in the picture is nearer; 0: unknown, see "
        "ground_turn",
    )
    ground_turn: float = Field(
        0.6,
        ge=0,
        le=1,
        description="factor on the yaw that is estimated from where the subject touches the ground in a video; used if "
        "turn_deg is 0",
    )
    depth_kind: Literal["auto", "inverse", "distance"] = Field(
        "auto",
        description="values of a depth picture (--depth). inverse: relative inverse depth, bright is near; distance: "
        "from the camera, in any unit; auto: distances if they are floating-point numbers, else inverse",
    )
    max_frames: int = Field(32, ge=2, le=512, description="largest number of frames; longer videos are sampled evenly")
    max_decode_gb: float = Field(
        1.0, ge=0.125, le=256, description="GiB of memory for decoding the source, including decoded frames; ours"
    )

    @field_validator("box")
    @classmethod
    def _check_box(cls, box: tuple[int, ...]) -> tuple[int, ...]:
        """Refuse boxes that are incomplete or empty."""
        if box and (len(box) != 4 or min(box[2:]) < 1):
            raise ValueError(BOX_FORM)
        return box


Candidates = Annotated[
    int, Field(ge=1, le=16, description="generated motions, scored and shown; the best is used unless `pick` is set")
]
Pick = Annotated[int, Field(ge=0, le=16, description="number of the only candidate to generate; 0: the best of all")]


Motion = Literal["sway", "bend", "breathe", "bounce", "wave", "turn"]


class WarpSettings(Settings):
    """Driving video by warping the picture in a loop; no weights."""

    kind: Literal["warp"] = "warp"
    candidates: Candidates = 1
    pick: Pick = 0
    motion: Motion = Field("sway", description="kind of the warp, ours; further candidates use the other kinds")
    strength: float = Field(1.0, gt=0, le=3, description="factor on the motion's amplitude")
    frames: int = Field(
        14,
        ge=3,
        le=128,
        description="frames of a generated video (paper: 14); at least 3, because both frames of a two-frame loop "
        "would show the rest pose",
    )
    fps: float = Field(7.0, ge=0.01, le=120, description="frames per second of a generated video (paper: 7)")


class SvdSettings(Settings):
    """Driving video by Stable Video Diffusion; candidate k uses the seed plus k - 1."""

    kind: Literal["svd"] = "svd"
    candidates: Candidates = 1
    pick: Pick = 0
    model: VideoModelSettings = VideoModelSettings()
    frames: int = Field(14, ge=2, le=64, description="frames of the video; svd was trained on 14, svd-xt on 25")
    fps: float = Field(7.0, ge=0.01, le=120, description="frames per second of playback (paper: 7)")
    height: int = Field(512, ge=64, le=2048, multiple_of=64, description="pixels (public code: 512; trained on 576)")
    width: int = Field(512, ge=64, le=2048, multiple_of=64, description="pixels (public code: 512; trained on 1024)")


class DiffusersVideoSettings(Settings):
    """Driving video by any image-to-video pipeline of diffusers; candidate k uses the seed plus k - 1."""

    kind: Literal["diffusers"] = "diffusers"
    candidates: Candidates = 1
    pick: Pick = 0
    weights: str = Field(
        "wan2.2-ti2v-5b",
        min_length=1,
        description="a name from `dg4d weights list`, a Hugging Face hub id, or a folder in diffusers' layout",
    )
    prompt: str = Field(
        "the subject moves naturally in place, the whole of it stays in the picture, static camera, plain white "
        "background",
        max_length=2000,
        description="prompt, for pipelines that take one",
    )
    negative_prompt: str = Field(
        "camera movement, zoom, cut, shadow, text, blurry, deformed",
        max_length=2000,
        description="negative prompt, for pipelines that take one",
    )
    loop: bool = Field(
        False,
        description="the input is also the last picture, so that the motion loops; only for first-last-frame models",
    )
    frames: int = Field(14, ge=2, le=128, description="frames of the driving video")
    generated_frames: int = Field(
        0,
        ge=0,
        le=512,
        description="frames that the pipeline generates, rounded up to a number that it can; `frames` of them, evenly "
        "spaced, are kept; 0: as many as are kept",
    )
    fps: float = Field(7.0, ge=0.01, le=120, description="frames per second of playback")
    height: int = Field(
        512, ge=32, le=2048, multiple_of=8, description="pixels, rounded to a size that the model takes"
    )
    width: int = Field(512, ge=32, le=2048, multiple_of=8, description="pixels, rounded to a size that the model takes")
    num_inference_steps: int = Field(30, ge=1, le=200, description="denoising steps")
    guidance_scale: float = Field(5.0, ge=0, le=30, description="classifier-free guidance (Wan: 5)")
    precision: Precision = Field("bf16", description=PRECISION)
    memory_gb: PipelineBudget = 24.0


DrivingSettings = Annotated[WarpSettings | SvdSettings | DiffusersVideoSettings, Field(discriminator="kind")]


class NoViewsSettings(Settings):
    """Other sides are not generated."""

    kind: Literal["none"] = "none"


class ImageEditViewsSettings(Settings):
    """Other sides generated by an image-editing pipeline with a LoRA for camera angles (Qwen-Image-Edit)."""

    kind: Literal["image_edit"] = "image_edit"
    weights: str = Field(
        "qwen-image-edit-2511",
        min_length=1,
        description="a name from `dg4d weights list`, a Hugging Face hub id, or a folder in diffusers' layout",
    )
    lora_weights: str = Field(
        "qwen-multiple-angles",
        description="LoRA for camera angles: a name from `dg4d weights list`, or a folder; empty: none",
    )
    lora_scale: float = Field(0.9, ge=0, le=2, description="strength of the LoRA (its card: 0.8 to 1)")
    azimuths_deg: tuple[Literal[0, 45, 90, 135, 180, 225, 270, 315], ...] = Field(
        (0, 45, 90, 135, 180, 225, 270, 315),
        min_length=1,
        description="azimuths of the generated views; azimuth 0 at elevation 0 is the input and is skipped",
    )
    elevations_deg: tuple[Literal[-30, 0, 30, 60], ...] = Field(
        (0, 30), min_length=1, description="elevations of the generated views"
    )
    suffix: str = Field(", plain white background", max_length=1000, description="appended to the camera prompt")
    size: int = Field(
        1024, ge=64, le=2048, multiple_of=32, description="pixels of a generated picture (the model's: 1024)"
    )
    num_inference_steps: int = Field(40, ge=2, le=200, description="denoising steps (the model's: 40)")
    guidance_scale: float = Field(4.0, ge=0, le=30, description="classifier-free guidance (the model's: 4)")
    precision: Precision = Field("bf16", description=PRECISION)
    memory_gb: PipelineBudget = 24.0
    min_weight: Share = Field(
        0.2, description="views whose weight (agreement with the others, 0 to 1) is lower are dropped; ours"
    )


ViewsSettings = Annotated[NoViewsSettings | ImageEditViewsSettings, Field(discriminator="kind")]
