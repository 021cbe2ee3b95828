"""ImageDream's multi-view U-Net: joint denoising of several views of one object (Wang and Shi 2023).

Three changes to the U-Net of Stable Diffusion 2.1: self-attention over the pixels of all views of a set, a camera
embedding added to the timestep embedding, and cross-attention to image tokens (IP-Adapter). Modules have the names of
the published weights (`input_blocks.1.1.transformer_blocks.0.attn2.to_k_ip.weight`), so files load unchanged.
"""

import math
from dataclasses import dataclass, fields
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

GROUPS = 32  # of group normalization
LONGEST_PERIOD = 10000.0  # of the sinusoidal timestep embedding
RESAMPLER_LAYERS = 4
RESAMPLER_HEAD = 64  # channels of a head
EXPANSION = 4  # hidden / input channels of feed-forward layers and of the timestep embedding


@dataclass(frozen=True)
class MultiViewUnetConfig:
    """Configuration with the keys of `unet/config.json`; the defaults are those of the published model.

    Attributes:
        in_channels: of the latents.
        out_channels: of the predicted noise.
        model_channels: of the first level.
        channel_mult: channels of every level, as multiples of `model_channels`.
        num_res_blocks: per level of the encoder; the decoder has one more.
        attention_resolutions: downsampling factors of the levels with attention.
        num_head_channels: channels of an attention head.
        transformer_depth: transformer blocks per layer.
        context_dim: channels of a token.
        camera_dim: length of a camera vector.
        ip_dim: number of image tokens.
        ip_weight: of the attention to image tokens, relative to text tokens.
        image_dim: channels of the image features (not in the published file: CLIP ViT-H/14).
        image_heads: attention heads of the image resampler (not in the published file).
    """

    in_channels: int = 4
    out_channels: int = 4
    model_channels: int = 320
    channel_mult: tuple[int, ...] = (1, 2, 4, 4)
    num_res_blocks: int = 2
    attention_resolutions: tuple[int, ...] = (4, 2, 1)
    num_head_channels: int = 64
    transformer_depth: int = 1
    context_dim: int = 1024
    camera_dim: int = 16
    ip_dim: int = 16
    ip_weight: float = 1.0
    image_dim: int = 1280
    image_heads: int = 12

    @staticmethod
    def of(config: dict[str, Any]) -> "MultiViewUnetConfig":
        """Read a `config.json`; unknown keys are ignored."""
        names = [field.name for field in fields(MultiViewUnetConfig) if field.name in config]
        sizes: dict[str, Any] = {
            name: tuple(config[name]) if isinstance(config[name], list) else config[name] for name in names
        }
        return MultiViewUnetConfig(**sizes)


class MultiViewUnet(nn.Module):
    """U-Net that predicts the noise of sets of views.

    Args:
        shape: the sizes.
    """

    def __init__(self, shape: MultiViewUnetConfig) -> None:
        super().__init__()
        self.shape = shape
        width, embedding = shape.model_channels, EXPANSION * shape.model_channels
        self.image_embed = _Resampler(shape)
        self.time_embed = _embedder(width, embedding)
        self.camera_embed = _embedder(shape.camera_dim, embedding)

        self.input_blocks = nn.ModuleList([_Layers([nn.Conv2d(shape.in_channels, width, 3, padding=1)])])
        channels, kept = width, [width]
        for level, multiple in enumerate(shape.channel_mult):
            for _ in range(shape.num_res_blocks):
                self.input_blocks.append(_Layers(self._block(channels, multiple * width, level)))
                channels = multiple * width
                kept.append(channels)
            if level < len(shape.channel_mult) - 1:
                self.input_blocks.append(_Layers([_Downsample(channels)]))
                kept.append(channels)
        self.middle_block = _Layers(
            [
                _Residual(channels, channels, embedding),
                _Transformer(channels, shape),
                _Residual(channels, channels, embedding),
            ]
        )
        self.output_blocks = nn.ModuleList()
        for level, multiple in reversed(list(enumerate(shape.channel_mult))):
            for i in range(shape.num_res_blocks + 1):
                layers = self._block(channels + kept.pop(), multiple * width, level)
                channels = multiple * width
                if level and i == shape.num_res_blocks:
                    layers.append(_Upsample(channels))
                self.output_blocks.append(_Layers(layers))
        self.out = nn.Sequential(
            nn.GroupNorm(GROUPS, channels), nn.SiLU(), nn.Conv2d(width, shape.out_channels, 3, padding=1)
        )

    def _block(self, inputs: int, outputs: int, level: int) -> list[nn.Module]:
        """Create the layers of one block of a level."""
        layers: list[nn.Module] = [_Residual(inputs, outputs, EXPANSION * self.shape.model_channels)]
        if 2**level in self.shape.attention_resolutions:
            layers.append(_Transformer(outputs, self.shape))
        return layers

    def forward(
        self,
        latents: Float[Tensor, "s v c h w"],
        timestep: int,
        cameras: Float[Tensor, "s v k"],
        text: Float[Tensor, "s l d"],
        image: Float[Tensor, "s m e"],
    ) -> Float[Tensor, "s v o h w"]:
        """Predict the noise of latents.

        Args:
            latents: noisy latents of s sets of v views; the views of a set attend to each other.
            timestep: 0 to 999.
            cameras: camera vectors of every view.
            text: text tokens of every set.
            image: image features of every set.
        """
        sets, views = latents.shape[:2]
        time = self.time_embed(_timestep_embedding(timestep, self.shape.model_channels).to(latents))
        embedding = time + self.camera_embed(cameras.flatten(0, 1))
        tokens = torch.cat([text, self.image_embed(image)], 1).repeat_interleave(views, 0)
        x, skips = latents.flatten(0, 1), []
        for block in self.input_blocks:
            x = block(x, embedding, tokens, views)
            skips.append(x)
        x = self.middle_block(x, embedding, tokens, views)
        for block in self.output_blocks:
            x = block(torch.cat([x, skips.pop()], 1), embedding, tokens, views)
        return self.out(x).unflatten(0, (sets, views))


class _Layers(nn.ModuleList):
    """Sequence of layers; each gets the inputs of its type."""

    def forward(self, x: Tensor, embedding: Tensor, tokens: Tensor, views: int) -> Tensor:
        for layer in self:
            if isinstance(layer, _Residual):
                x = layer(x, embedding)
            elif isinstance(layer, _Transformer):
                x = layer(x, tokens, views)
            else:
                x = layer(x)
        return x


class _Residual(nn.Module):
    """Residual block of two convolutions, with the embedding added between them."""

    def __init__(self, inputs: int, outputs: int, embedding: int) -> None:
        super().__init__()
        self.in_layers = nn.Sequential(
            nn.GroupNorm(GROUPS, inputs), nn.SiLU(), nn.Conv2d(inputs, outputs, 3, padding=1)
        )
        self.emb_layers = nn.Sequential(nn.SiLU(), nn.Linear(embedding, outputs))
        self.out_layers = nn.Sequential(
            nn.GroupNorm(GROUPS, outputs), nn.SiLU(), nn.Identity(), nn.Conv2d(outputs, outputs, 3, padding=1)
        )
        self.skip_connection = nn.Identity() if inputs == outputs else nn.Conv2d(inputs, outputs, 1)

    def forward(self, x: Tensor, embedding: Tensor) -> Tensor:
        residue = self.in_layers(x) + self.emb_layers(embedding)[..., None, None]
        return self.skip_connection(x) + self.out_layers(residue)


class _Transformer(nn.Module):
    """Residual transformer over the pixels of a set."""

    def __init__(self, channels: int, shape: MultiViewUnetConfig) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(GROUPS, channels, eps=1e-6)
        self.proj_in = nn.Linear(channels, channels)
        self.transformer_blocks = nn.ModuleList(
            _TransformerBlock(channels, shape) for _ in range(shape.transformer_depth)
        )
        self.proj_out = nn.Linear(channels, channels)

    def forward(self, x: Tensor, tokens: Tensor, views: int) -> Tensor:
        pixels = self.proj_in(self.norm(x).flatten(2).mT)
        for block in self.transformer_blocks:
            pixels = block(pixels, tokens, views)
        return x + self.proj_out(pixels).mT.reshape(x.shape)


class _TransformerBlock(nn.Module):
    """Self-attention over all views of a set, cross-attention to tokens, and a feed-forward layer."""

    def __init__(self, channels: int, shape: MultiViewUnetConfig) -> None:
        super().__init__()
        head = shape.num_head_channels
        self.attn1 = _Attention(channels, channels, head)
        self.attn2 = _Attention(channels, shape.context_dim, head, shape.ip_dim, shape.ip_weight)
        self.ff = _FeedForward(channels)
        self.norm1, self.norm2, self.norm3 = (nn.LayerNorm(channels) for _ in range(3))

    def forward(self, pixels: Tensor, tokens: Tensor, views: int) -> Tensor:
        set_pixels = self.norm1(pixels).unflatten(0, (-1, views)).flatten(1, 2)
        pixels = pixels + self.attn1(set_pixels, set_pixels).unflatten(1, (views, -1)).flatten(0, 1)
        pixels = pixels + self.attn2(self.norm2(pixels), tokens)
        return pixels + self.ff(self.norm3(pixels))


class _Attention(nn.Module):
    """Softmax attention; the last `image_tokens` tokens have separate keys, values and softmax (IP-Adapter)."""

    def __init__(
        self, channels: int, context: int, head: int, image_tokens: int = 0, image_weight: float = 1.0
    ) -> None:
        super().__init__()
        self.heads, self.image_tokens, self.image_weight = channels // head, image_tokens, image_weight
        self.to_q = nn.Linear(channels, channels, bias=False)
        self.to_k, self.to_v = (nn.Linear(context, channels, bias=False) for _ in range(2))
        if image_tokens:
            self.to_k_ip, self.to_v_ip = (nn.Linear(context, channels, bias=False) for _ in range(2))
        self.to_out = nn.Sequential(nn.Linear(channels, channels))

    def forward(self, x: Tensor, tokens: Tensor) -> Tensor:
        text = tokens[:, : tokens.shape[1] - self.image_tokens]
        queries = self.to_q(x)
        output = attend(queries, self.to_k(text), self.to_v(text), self.heads)
        if self.image_tokens:
            image = tokens[:, -self.image_tokens :]
            image_output = attend(queries, self.to_k_ip(image), self.to_v_ip(image), self.heads)
            output = output + self.image_weight * image_output
        return self.to_out(output)


class _FeedForward(nn.Module):
    """Feed-forward layer with GEGLU."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        inner = EXPANSION * channels
        self.net = nn.Sequential(_Geglu(channels, inner), nn.Identity(), nn.Linear(inner, channels))

    def forward(self, x: Tensor) -> Tensor:
        return self.net(x)


class _Geglu(nn.Module):
    """GEGLU: linear layer whose second half gates the first."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.proj = nn.Linear(inputs, 2 * outputs)

    def forward(self, x: Tensor) -> Tensor:
        values, gates = self.proj(x).chunk(2, -1)
        return values * functional.gelu(gates)


class _Resampler(nn.Module):
    """Perceiver resampler: image features to a few tokens."""

    def __init__(self, shape: MultiViewUnetConfig) -> None:
        super().__init__()
        width = shape.context_dim
        self.latents = nn.Parameter(torch.randn(1, shape.ip_dim, width) / width**0.5)
        self.proj_in = nn.Linear(shape.image_dim, width)
        self.proj_out = nn.Linear(width, width)
        self.norm_out = nn.LayerNorm(width)
        self.layers = nn.ModuleList(
            _ResamplerLayer([_PerceiverAttention(width, shape.image_heads), _mlp(width)])
            for _ in range(RESAMPLER_LAYERS)
        )

    def forward(self, features: Float[Tensor, "s m e"]) -> Float[Tensor, "s n d"]:
        features, tokens = self.proj_in(features), self.latents.expand(len(features), -1, -1)
        for layer in self.layers:
            tokens = layer(features, tokens)
        return self.norm_out(self.proj_out(tokens))


class _ResamplerLayer(nn.ModuleList):
    """Attention and MLP of the resampler, both residual."""

    def forward(self, features: Tensor, tokens: Tensor) -> Tensor:
        attention, mlp = self
        tokens = tokens + attention(features, tokens)
        return tokens + mlp(tokens)


class _PerceiverAttention(nn.Module):
    """Attention of tokens to features and tokens."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads, inner = heads, heads * RESAMPLER_HEAD
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.to_q = nn.Linear(width, inner, bias=False)
        self.to_kv = nn.Linear(width, 2 * inner, bias=False)
        self.to_out = nn.Linear(inner, width, bias=False)

    def forward(self, features: Tensor, tokens: Tensor) -> Tensor:
        features, tokens = self.norm1(features), self.norm2(tokens)
        keys, values = self.to_kv(torch.cat([features, tokens], 1)).chunk(2, -1)
        return self.to_out(attend(self.to_q(tokens), keys, values, self.heads))


class _Downsample(nn.Module):
    """Downsampling by 2."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.op = nn.Conv2d(channels, channels, 3, stride=2, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return self.op(x)


class _Upsample(nn.Module):
    """Upsampling by 2."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return self.conv(functional.interpolate(x, scale_factor=2.0, mode="nearest"))


def attend(
    queries: Float[Tensor, "b q c"], keys: Float[Tensor, "b k c"], values: Float[Tensor, "b k c"], heads: int
) -> Float[Tensor, "b q c"]:
    """Compute multi-head softmax attention."""
    q, k, v = (x.unflatten(-1, (heads, -1)).transpose(1, 2) for x in (queries, keys, values))
    return functional.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)


def _embedder(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, outputs), nn.SiLU(), nn.Linear(outputs, outputs))


def _mlp(width: int) -> nn.Sequential:
    inner = EXPANSION * width
    return nn.Sequential(
        nn.LayerNorm(width), nn.Linear(width, inner, bias=False), nn.GELU(), nn.Linear(inner, width, bias=False)
    )


def _timestep_embedding(timestep: int, channels: int) -> Float[Tensor, " channels"]:
    """Return the sinusoidal embedding of a timestep: cosines, then sines, at decreasing frequencies."""
    half = channels // 2
    angles = timestep * torch.exp(-math.log(LONGEST_PERIOD) * torch.arange(half) / half)
    return torch.cat([angles.cos(), angles.sin()])
