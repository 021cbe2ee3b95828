"""A tiny random text-to-image pipeline, saved in exactly the layout of the real ones."""

import json
from pathlib import Path
from typing import Any

import torch

WORDS = ("a", "red", "dragon", "blue", "newt", "of", "it", "the", "in", "white")


def save_pipeline(folder: Path, seed: int = 0, square: bool = False) -> Path:
    """A StableDiffusionPipeline of some thousand weights that draws 32 to 64 pixels in a moment.

    Args:
        folder: where to.
        seed: of the weights.
        square: whether it draws a red square on white whatever it is asked for; else it draws noise.
    """
    from diffusers import AutoencoderKL, DDIMScheduler, StableDiffusionPipeline, UNet2DConditionModel
    from transformers import CLIPTextConfig, CLIPTextModel

    with torch.random.fork_rng():
        torch.manual_seed(seed)
        vae = AutoencoderKL(
            block_out_channels=(8,) * 4,
            down_block_types=("DownEncoderBlock2D",) * 4,
            up_block_types=("UpDecoderBlock2D",) * 4,
            latent_channels=4,
            norm_num_groups=4,
        )
        unet = UNet2DConditionModel(
            sample_size=16,
            block_out_channels=(8, 16),
            down_block_types=("CrossAttnDownBlock2D", "DownBlock2D"),
            up_block_types=("UpBlock2D", "CrossAttnUpBlock2D"),
            layers_per_block=1,
            norm_num_groups=4,
            attention_head_dim=4,
            cross_attention_dim=16,
        )
        sizes = {"hidden_size": 16, "intermediate_size": 16, "num_attention_heads": 2, "num_hidden_layers": 1}
        encoder = CLIPTextModel(
            CLIPTextConfig(
                vocab_size=128, max_position_embeddings=77, bos_token_id=0, eos_token_id=1, pad_token_id=1, **sizes
            )
        )
    if square:
        _draw_a_square(vae)
    pipeline = StableDiffusionPipeline(
        vae=vae,
        unet=unet,
        text_encoder=encoder,
        tokenizer=_tokenizer(folder / "words"),
        scheduler=DDIMScheduler(
            beta_schedule="scaled_linear", clip_sample=False, set_alpha_to_one=False, steps_offset=1
        ),
        safety_checker=None,
        feature_extractor=None,
        requires_safety_checker=False,
    )
    pipeline.save_pretrained(folder)
    return folder


@torch.no_grad()
def _draw_a_square(vae: Any) -> None:
    """Make a decoder forget its latents: all that is left is how padding darkens the outermost of them."""
    for part in (vae.post_quant_conv, vae.decoder):
        for name, value in part.named_parameters():
            value.fill_(1.0 if "norm" in name and name.endswith("weight") else 0.0)
    vae.post_quant_conv.bias.fill_(1)
    vae.decoder.conv_in.weight.fill_(1 / 36)  # 9 places of 4 channels
    for name, layer in vae.decoder.named_modules():
        if name.endswith("upsamplers.0.conv"):
            layer.weight[:, :, 1, 1] = 1 / 8  # of 8 channels, which are all alike
    vae.decoder.conv_out.weight[:, :, 1, 1] = torch.tensor([-0.4, -3.0, -3.0])[:, None] / 8
    vae.decoder.conv_out.bias.fill_(1)


def _tokenizer(folder: Path) -> object:
    """A CLIPTokenizer that knows a few whole words and every letter."""
    from transformers import CLIPTokenizer

    folder.mkdir(parents=True)
    letters = [chr(code) for code in range(ord("a"), ord("z") + 1)]
    tokens = ["<|startoftext|>", "<|endoftext|>", *letters, *(f"{letter}</w>" for letter in letters)]
    pairs: list[str] = []
    for word in WORDS:
        parts = [*word[:-1], f"{word[-1]}</w>"]
        while len(parts) > 1:
            pairs.append(f"{parts[0]} {parts[1]}")
            parts[:2] = [parts[0] + parts[1]]
            tokens += [parts[0]] if parts[0] not in tokens else []
    (folder / "vocab.json").write_text(json.dumps({token: i for i, token in enumerate(dict.fromkeys(tokens))}))
    (folder / "merges.txt").write_text("\n".join(["#version: 0.2", *dict.fromkeys(pairs)]) + "\n")
    return CLIPTokenizer.from_pretrained(folder, model_max_length=77)
