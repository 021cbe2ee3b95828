"""A tiny random ImageDream and a tiny random LGM, saved in exactly the layout of the real ones."""

import json
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file
from tiny_weights import tiny_vae, write_scheduler

from dg4d_lib.guidance.imagedream_unet import MultiViewUnet, MultiViewUnetConfig
from dg4d_lib.reconstruction.lgm import WEIGHTS_FILE, Lgm
from dg4d_lib.reconstruction.lgm_unet import UnetConfig

UNET_CONFIG: dict[str, Any] = {  # the keys of the published unet/config.json, and the two sizes it takes for granted
    "_class_name": "MultiViewUNetModel",
    "_diffusers_version": "0.25.0",
    "attention_resolutions": [2],
    "camera_dim": 16,
    "channel_mult": [1, 2],
    "context_dim": 32,
    "image_size": 32,
    "in_channels": 4,
    "ip_dim": 4,
    "model_channels": 32,
    "num_head_channels": 32,
    "num_res_blocks": 1,
    "out_channels": 4,
    "transformer_depth": 1,
    "use_checkpoint": False,
    "image_dim": 48,
    "image_heads": 1,
}
LETTERS = "abcdefghijklmnopqrstuvwxyz"
ENDS = {"bos_token": "<|startoftext|>", "eos_token": "<|endoftext|>"}
TOKENS = [*LETTERS, *(f"{letter}</w>" for letter in LETTERS), *ENDS.values()]


def tiny_unet() -> MultiViewUnet:
    return MultiViewUnet(MultiViewUnetConfig.of(UNET_CONFIG))


def write_imagedream(model: Path, seed: int = 0) -> Path:
    """A tiny ImageDream in the layout of `ashawkey/imagedream-ipmv-diffusers`."""
    from transformers import CLIPTextConfig, CLIPTextModel, CLIPVisionConfig, CLIPVisionModel

    sizes = {"intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 4}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        unet = tiny_unet()
        tiny_vae().save_pretrained(model / "vae")
        words = {"vocab_size": len(TOKENS), "bos_token_id": len(TOKENS) - 2, "eos_token_id": len(TOKENS) - 1}
        text = CLIPTextConfig(hidden_size=32, max_position_embeddings=77, **words, **sizes)
        CLIPTextModel(text).save_pretrained(model / "text_encoder")
        eye = CLIPVisionConfig(hidden_size=48, image_size=224, patch_size=56, **sizes)
        CLIPVisionModel(eye).save_pretrained(model / "image_encoder")
    _name_as_published(model / "text_encoder", "text_model.")
    _name_as_published(model / "image_encoder", "vision_model.")
    (model / "unet").mkdir()
    (model / "unet" / "config.json").write_text(json.dumps(UNET_CONFIG))
    save_file(unet.state_dict(), model / "unet" / "diffusion_pytorch_model.safetensors")
    write_scheduler(model / "scheduler")
    (model / "tokenizer").mkdir()
    (model / "tokenizer" / "vocab.json").write_text(json.dumps({token: i for i, token in enumerate(TOKENS)}))
    (model / "tokenizer" / "merges.txt").write_text("#version: 0.2\n")
    about = {**ENDS, "unk_token": ENDS["eos_token"], "pad_token": ENDS["eos_token"], "model_max_length": 77}
    (model / "tokenizer" / "tokenizer_config.json").write_text(json.dumps(about))
    return model


def _name_as_published(part: Path, prefix: str) -> None:
    """Put the prefix before the names of the tensors, as transformers did in 2023."""
    file = part / "model.safetensors"
    save_file({f"{prefix}{name}": tensor for name, tensor in load_file(file).items()}, file, {"format": "pt"})


def write_lgm(folder: Path, seed: int = 0) -> Path:
    """A tiny LGM of 4 x 16 x 16 Gaussians, in a folder like `ashawkey/LGM`."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = Lgm(UnetConfig((32, 32, 32, 32, 64), (False, False, False, False, True), (64,), (True,)))
    folder.mkdir(parents=True, exist_ok=True)
    save_file(model.half().state_dict(), folder / WEIGHTS_FILE)
    return folder
