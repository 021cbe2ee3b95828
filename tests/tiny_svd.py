"""A Stable Video Diffusion of a few thousand random weights, saved in the layout of the real one."""

from pathlib import Path

import torch
from diffusers import (
    AutoencoderKLTemporalDecoder,
    EulerDiscreteScheduler,
    StableVideoDiffusionPipeline,
    UNetSpatioTemporalConditionModel,
)
from transformers import CLIPImageProcessor, CLIPVisionConfig, CLIPVisionModelWithProjection

SCHEDULE = {  # the scheduler_config.json of the real weights
    "beta_start": 0.00085,
    "beta_end": 0.012,
    "beta_schedule": "scaled_linear",
    "interpolation_type": "linear",
    "num_train_timesteps": 1000,
    "prediction_type": "v_prediction",
    "sigma_max": 700.0,
    "sigma_min": 0.002,
    "steps_offset": 1,
    "timestep_spacing": "leading",
    "timestep_type": "continuous",
    "use_karras_sigmas": True,
}


def tiny_svd() -> StableVideoDiffusionPipeline:
    """Equal at every call; pictures of 2 times the latents' size."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        unet = UNetSpatioTemporalConditionModel(
            sample_size=None,
            in_channels=8,
            out_channels=4,
            num_frames=4,
            block_out_channels=(32, 64),
            layers_per_block=1,
            down_block_types=("CrossAttnDownBlockSpatioTemporal", "DownBlockSpatioTemporal"),
            up_block_types=("UpBlockSpatioTemporal", "CrossAttnUpBlockSpatioTemporal"),
            cross_attention_dim=32,
            num_attention_heads=2,
            addition_time_embed_dim=8,
            projection_class_embeddings_input_dim=24,
        )
        vae = AutoencoderKLTemporalDecoder(
            block_out_channels=(32, 32),
            down_block_types=("DownEncoderBlock2D", "DownEncoderBlock2D"),
            layers_per_block=1,
            latent_channels=4,
        )
        eye = CLIPVisionConfig(
            hidden_size=32,
            projection_dim=32,
            num_hidden_layers=2,
            num_attention_heads=4,
            image_size=224,
            intermediate_size=37,
            patch_size=32,
        )
        image_encoder = CLIPVisionModelWithProjection(eye)
        return StableVideoDiffusionPipeline(
            unet=unet.eval(),
            vae=vae.eval(),
            image_encoder=image_encoder.eval(),
            scheduler=EulerDiscreteScheduler(**SCHEDULE),
            feature_extractor=CLIPImageProcessor(),
        )


def save_tiny_svd(folder: Path) -> Path:
    """The folder, filled as `StableVideoDiffusionPipeline.save_pretrained` fills it."""
    tiny_svd().save_pretrained(folder)
    return folder
