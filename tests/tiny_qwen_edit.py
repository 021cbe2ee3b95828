"""A tiny random Qwen-Image-Edit, a LoRA for it, and a Qwen-Image, saved in the layout of the real ones."""

import json
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file

SPECIAL = ("<|endoftext|>", "<|im_start|>", "<|im_end|>", "<|vision_start|>", "<|vision_end|>", "<|image_pad|>")
WIDTH = 32  # of the tiny transformer
PICTURE = 56  # pixels of the picture that the text encoder sees


def save_tiny_qwen_edit(folder: Path) -> Path:
    """A QwenImageEditPlusPipeline of a few ten thousand weights."""
    from diffusers import (
        AutoencoderKLQwenImage,
        FlowMatchEulerDiscreteScheduler,
        QwenImageEditPlusPipeline,
        QwenImageTransformer2DModel,
    )
    from transformers import Qwen2_5_VLConfig, Qwen2_5_VLForConditionalGeneration
    from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil

    tokenizer = _tokenizer()
    number = {token: tokenizer.convert_tokens_to_ids(token) for token in SPECIAL}
    small = {"hidden_size": 16, "intermediate_size": 16}
    rope = {"rope_type": "default", "mrope_section": [1, 1, 2], "rope_theta": 1e4}
    words = {
        **small,
        "num_hidden_layers": 1,
        "num_attention_heads": 2,
        "num_key_value_heads": 2,
        "rope_parameters": rope,
    }
    ends = {"bos_token_id": number["<|endoftext|>"], "eos_token_id": number["<|im_end|>"]}
    eyes = {**small, "depth": 1, "num_heads": 2, "out_hidden_size": 16, "fullatt_block_indexes": [0]}
    config = Qwen2_5_VLConfig(
        text_config={**words, **ends, "vocab_size": len(tokenizer)},
        vision_config=eyes,
        vision_start_token_id=number["<|vision_start|>"],
        vision_end_token_id=number["<|vision_end|>"],
        image_token_id=number["<|image_pad|>"],
        video_token_id=number["<|endoftext|>"],
    )
    with torch.random.fork_rng():
        torch.manual_seed(0)
        encoder = Qwen2_5_VLForConditionalGeneration(config)
        vae = AutoencoderKLQwenImage(
            base_dim=4,
            z_dim=4,
            dim_mult=[1, 2, 4],
            num_res_blocks=1,
            temperal_downsample=[False, True],
            latents_mean=[0.0] * 4,
            latents_std=[1.0] * 4,
        )
        transformer = QwenImageTransformer2DModel(
            in_channels=16,
            out_channels=4,
            num_layers=1,
            attention_head_dim=16,
            num_attention_heads=2,
            joint_attention_dim=16,
            axes_dims_rope=(8, 4, 4),
        )
    pipeline = QwenImageEditPlusPipeline(
        scheduler=FlowMatchEulerDiscreteScheduler(use_dynamic_shifting=True, shift_terminal=0.02),
        vae=vae,
        text_encoder=encoder,
        tokenizer=tokenizer,
        processor=None,
        transformer=transformer,
    )
    pipeline.save_pretrained(folder)
    pixels = PICTURE * PICTURE
    Qwen2VLImageProcessorPil(min_pixels=pixels, max_pixels=pixels).save_pretrained(folder / "processor")
    tokenizer.save_pretrained(folder / "processor")
    index = json.loads((folder / "model_index.json").read_text())
    (folder / "model_index.json").write_text(json.dumps({**index, "processor": ["transformers", "Qwen2VLProcessor"]}))
    return folder


def save_tiny_qwen_image(folder: Path) -> Path:
    """A QwenImagePipeline, for text alone, of the same networks."""
    from diffusers import QwenImageEditPlusPipeline, QwenImagePipeline

    edit = QwenImageEditPlusPipeline.from_pretrained(save_tiny_qwen_edit(folder / "edit"), processor=None)
    parts = {name: part for name, part in edit.components.items() if name != "processor"}
    QwenImagePipeline(**parts).save_pretrained(folder / "image")
    return folder / "image"


def save_tiny_lora(folder: Path, prefix: str = "transformer.", scale: float = 1.0) -> Path:
    """A LoRA of rank 2 for the attention of the tiny transformer, in a folder as the hub's."""
    generator = torch.Generator().manual_seed(1)
    tensors = {}
    for layer in ("to_q", "to_v"):
        name = f"{prefix}transformer_blocks.0.attn.{layer}"
        tensors[f"{name}.lora_A.weight"] = scale * torch.randn(2, WIDTH, generator=generator)
        tensors[f"{name}.lora_B.weight"] = torch.randn(WIDTH, 2, generator=generator)
    folder.mkdir(parents=True)
    save_file(tensors, folder / "qwen-image-edit-2511-multiple-angles-lora.safetensors")
    return folder


def shrink_inputs(patch: Any) -> None:
    """Let the pipeline encode its input at few pixels instead of a megapixel."""
    from diffusers.pipelines.qwenimage import pipeline_qwenimage_edit_plus as module

    patch.setattr(module, "VAE_IMAGE_SIZE", 32 * 32)
    patch.setattr(module, "CONDITION_IMAGE_SIZE", PICTURE * PICTURE)


def _tokenizer() -> Any:
    """A Qwen2Tokenizer of single letters."""
    from transformers import Qwen2Tokenizer

    letters = [chr(code) for code in range(33, 127)]
    vocabulary = {token: i for i, token in enumerate([*letters, "\u0120", "\u010a", *SPECIAL])}
    return Qwen2Tokenizer(vocab=vocabulary, merges=[], extra_special_tokens=list(SPECIAL[1:]))
