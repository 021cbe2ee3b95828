"""Tiny random models, saved in exactly the layout of the real ones. Every test of the suite may import this."""

import json
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file

CLIP_WIDTH, TOKEN = 24, 32  # of the tiny CLIP embedding, of the tiny cross-attention
SD_SCHEDULER = {
    "_class_name": "DDIMScheduler",
    "beta_start": 0.00085,
    "beta_end": 0.012,
    "beta_schedule": "scaled_linear",
    "num_train_timesteps": 1000,
    "prediction_type": "epsilon",
    "clip_sample": False,
    "set_alpha_to_one": False,
    "steps_offset": 1,
}


def tiny_vae(**changes: Any) -> Any:
    """An AutoencoderKL that shrinks eight times, as Stable Diffusion's."""
    from diffusers import AutoencoderKL

    settings: dict[str, Any] = {
        "block_out_channels": (4, 4, 8, 8),
        "down_block_types": ("DownEncoderBlock2D",) * 4,
        "up_block_types": ("UpDecoderBlock2D",) * 4,
        "layers_per_block": 1,
        "latent_channels": 4,
        "norm_num_groups": 2,
        "sample_size": 256,
        "scaling_factor": 0.18215,
    }
    return AutoencoderKL(**{**settings, **changes})


def tiny_unet(**changes: Any) -> Any:
    """A UNet2DConditionModel from 8 to 4 channels with cross-attention, as Zero-1-to-3's."""
    from diffusers import UNet2DConditionModel

    settings: dict[str, Any] = {
        "sample_size": 32,
        "in_channels": 8,
        "out_channels": 4,
        "block_out_channels": (8, 16),
        "down_block_types": ("DownBlock2D", "CrossAttnDownBlock2D"),
        "up_block_types": ("CrossAttnUpBlock2D", "UpBlock2D"),
        "layers_per_block": 1,
        "norm_num_groups": 4,
        "attention_head_dim": 4,
        "cross_attention_dim": TOKEN,
    }
    return UNet2DConditionModel(**{**settings, **changes})


def tiny_image_encoder(**changes: Any) -> Any:
    """A CLIPVisionModelWithProjection for pictures of 224 pixels."""
    from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

    settings: dict[str, Any] = {
        "image_size": 224,
        "patch_size": 56,
        "hidden_size": 32,
        "intermediate_size": 64,
        "num_hidden_layers": 2,
        "num_attention_heads": 4,
        "projection_dim": CLIP_WIDTH,
    }
    return CLIPVisionModelWithProjection(CLIPVisionConfig(**{**settings, **changes}))


def write_scheduler(folder: Path, **changes: Any) -> None:
    """scheduler_config.json of Stable Diffusion 1."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scheduler_config.json").write_text(json.dumps({**SD_SCHEDULER, **changes}))


def write_zero123(model: Path, variant: str | None = None, seed: int = 0) -> Path:
    """A tiny Zero-1-to-3 in the layout of `ashawkey/zero123-xl-diffusers`.

    Args:
        model: the folder to make.
        variant: "fp16" for files in half precision under the variant's names.
        seed: of the random weights.
    """
    dtype = torch.float16 if variant == "fp16" else torch.float32
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        parts = {"vae": tiny_vae(), "unet": tiny_unet(), "image_encoder": tiny_image_encoder()}
        layer = torch.nn.Linear(CLIP_WIDTH + 4, TOKEN)
    for name, part in parts.items():
        (part.half() if variant == "fp16" else part).save_pretrained(model / name, variant=variant)
    projection = model / "clip_camera_projection"
    projection.mkdir()
    tensors = {f"proj.{name}": value.detach().to(dtype) for name, value in layer.named_parameters()}
    save_file(tensors, projection / f"diffusion_pytorch_model{f'.{variant}' if variant else ''}.safetensors")
    about = {"_class_name": "CLIPCameraProjection", "additional_embeddings": 4, "embedding_dim": CLIP_WIDTH}
    (projection / "config.json").write_text(json.dumps(about))
    write_scheduler(model / "scheduler")
    (model / "feature_extractor").mkdir()
    (model / "feature_extractor" / "preprocessor_config.json").write_text(json.dumps({"crop_size": 224}))
    index = {
        "clip_camera_projection": ["zero123", "CLIPCameraProjection"],
        "feature_extractor": ["transformers", "CLIPImageProcessor"],
        "image_encoder": ["transformers", "CLIPVisionModelWithProjection"],
        "scheduler": ["diffusers", "DDIMScheduler"],
        "unet": ["diffusers", "UNet2DConditionModel"],
        "vae": ["diffusers", "AutoencoderKL"],
    }
    (model / "model_index.json").write_text(json.dumps({"_class_name": ["zero123", "Zero123Pipeline"], **index}))
    return model
