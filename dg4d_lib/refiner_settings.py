"""Settings of the texture refinement, in the form of settings.py."""

from typing import Annotated, Literal

from pydantic import Field

from dg4d_lib.settings import NotNegative, Positive, Settings, Share, VideoModelSettings, Zero123PriorSettings


class IdentitySettings(Settings):
    """No texture refinement."""

    kind: Literal["identity"] = "identity"


class TextureSettings(Settings):
    """Texture optimization on refined renders (paper section 3.4)."""

    iterations: int = Field(50, ge=1, le=2000, description="iterations (paper: 50)")
    lr: Positive = Field(0.2, description="learning rate of the color logits (Adam)")
    size: int = Field(512, ge=64, le=1024, multiple_of=64, description="pixels of the renders")
    min_cosine: Share = Field(
        0.5, description="the reference view is ignored where the cosine to the surface normal is smaller"
    )
    azimuth_step_deg: float = Field(
        10.0, ge=-180, le=180, description="azimuth step of the camera from frame to frame, from a random start"
    )
    refresh_every: int = Field(
        1, ge=1, le=2000, description="iterations between new trajectories and new targets (paper: 1)"
    )
    frame_size: int = Field(
        0,
        ge=0,
        le=1024,
        description="tracked mesh: texels per side of per-frame textures, each the shared texture plus a residual; "
        "0: one texture for all frames (ours)",
    )
    frame_weight: NotNegative = Field(
        0.01, description="regularization: squares of the per-frame residuals and of their changes over time"
    )


class VideoToVideoSettings(Settings):
    """Refinement of a video of the mesh by Stable Video Diffusion (paper section 3.4)."""

    kind: Literal["video_to_video"] = "video_to_video"
    texture: TextureSettings = TextureSettings()
    model: VideoModelSettings = VideoModelSettings()
    strength: float = Field(
        0.3, gt=0, le=1, description="fraction of the noise levels, 1 - T (paper: 0.3): 0.3 of 25 starts at sigma 1.273"
    )
    strength_end: Share = Field(
        0.0,
        description="fraction in the last iteration, linear in between; 0: constant (paper; its ablation that anneals "
        "T from 0.7 to 0.95: 0.05)",
    )


class ImageToImageSettings(Settings):
    """Ablation: refinement of single renders by Zero-1-to-3 (Tang et al. 2024, section 3.3)."""

    kind: Literal["image_to_image"] = "image_to_image"
    texture: TextureSettings = TextureSettings()
    prior: Zero123PriorSettings = Zero123PriorSettings()
    num_inference_steps: int = Field(50, ge=2, le=500, description="timesteps of the full DDIM schedule")
    strength_start: float = Field(0.5, gt=0, le=1, description="fraction of the timesteps in the first iteration")
    strength_end: float = Field(
        0.05, gt=0, le=1, description="fraction of the timesteps in the last iteration; linear in between"
    )


RefinerSettings = Annotated[IdentitySettings | VideoToVideoSettings | ImageToImageSettings, Field(discriminator="kind")]
