"""Tiny random Wan image-to-video pipelines, saved in the layout of the real ones."""

import json
from pathlib import Path
from typing import Any

import torch

WORDS = ("a", "the", "subject", "moves", "white", "background")


def save_tiny_wan(folder: Path, last_image: bool = False) -> Path:
    """A Wan pipeline of a few thousand weights.

    Args:
        folder: where to.
        last_image: True for the layout of Wan2.1-FLF2V, which also takes a last picture; else that of Wan2.2-TI2V-5B,
            whose model_index.json names the text-to-video class.
    """
    from diffusers import (
        AutoencoderKLWan,
        FlowMatchEulerDiscreteScheduler,
        UniPCMultistepScheduler,
        WanImageToVideoPipeline,
        WanTransformer3DModel,
    )
    from transformers import UMT5Config, UMT5EncoderModel

    shared: dict[str, Any] = {
        "base_dim": 4,
        "z_dim": 4,
        "num_res_blocks": 1,
        "temperal_downsample": [False, True, True],
    }
    shared |= {"latents_mean": [0.0] * 4, "latents_std": [1.0] * 4}
    network: dict[str, Any] = {"num_attention_heads": 2, "attention_head_dim": 12, "text_dim": 16, "freq_dim": 16}
    network |= {"ffn_dim": 32, "num_layers": 1, "cross_attn_norm": True, "qk_norm": "rms_norm_across_heads"}
    extra: dict[str, Any] = {"image_encoder": None, "image_processor": None, "expand_timesteps": True}
    with torch.random.fork_rng():
        torch.manual_seed(0)
        words = UMT5Config(vocab_size=16, d_model=16, d_kv=8, d_ff=16, num_layers=1, num_heads=2)
        encoder = UMT5EncoderModel(words)
        if last_image:
            vae = AutoencoderKLWan(dim_mult=[1, 1, 1, 1], **shared)
            network |= {"in_channels": 12, "image_dim": 32, "added_kv_proj_dim": 24, "pos_embed_seq_len": 2 * 5}
            extra = {**_eyes(), "expand_timesteps": False}
        else:
            residual = {"is_residual": True, "patch_size": 2, "in_channels": 12, "out_channels": 12}
            vae = AutoencoderKLWan(
                dim_mult=[1, 1, 1, 1], decoder_base_dim=4, scale_factor_spatial=16, **residual, **shared
            )
            network |= {"in_channels": 4}
        transformer = WanTransformer3DModel(patch_size=(1, 2, 2), out_channels=4, rope_max_seq_len=32, **network)
    flow = {"use_flow_sigmas": True, "prediction_type": "flow_prediction", "flow_shift": 5.0}
    pipeline = WanImageToVideoPipeline(
        tokenizer=_tokenizer(),
        text_encoder=encoder,
        vae=vae,
        transformer=transformer,
        scheduler=FlowMatchEulerDiscreteScheduler(shift=3.0) if last_image else UniPCMultistepScheduler(**flow),
        **extra,
    )
    pipeline.save_pretrained(folder)
    if not last_image:
        _name_as_published(folder)
    return folder


def _name_as_published(folder: Path) -> None:
    """Name the text-to-video class, which has no image encoder."""
    index = json.loads((folder / "model_index.json").read_text())
    index = {key: value for key, value in index.items() if not key.startswith("image_")} | {
        "_class_name": "WanPipeline"
    }
    (folder / "model_index.json").write_text(json.dumps(index))


def _eyes() -> dict[str, Any]:
    from transformers import CLIPImageProcessor, CLIPVisionConfig, CLIPVisionModel

    sizes = {"hidden_size": 32, "intermediate_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2}
    eye = CLIPVisionConfig(image_size=32, patch_size=16, **sizes)
    size = {"size": {"shortest_edge": 32}, "crop_size": 32}
    return {"image_encoder": CLIPVisionModel(eye), "image_processor": CLIPImageProcessor(**size)}


def _tokenizer() -> Any:
    """A tokenizer of a few whole words, as a T5TokenizerFast."""
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast

    names = ("<pad>", "</s>", "<unk>", *WORDS)
    tokenizer = Tokenizer(models.WordLevel({name: i for i, name in enumerate(names)}, unk_token="<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    ends = {"pad_token": "<pad>", "eos_token": "</s>", "unk_token": "<unk>"}
    return PreTrainedTokenizerFast(tokenizer_object=tokenizer, **ends)
