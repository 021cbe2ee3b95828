"""ImageDream's network: a U-Net that denoises several views of one object together (Wang and Shi 2023).

Three things are added to the U-Net of Stable Diffusion 2.1: self-attention runs over the pixels of all views of a set,
the camera is added to the embedding of time, and cross-attention also sees tokens of the picture. Modules carry the
names of the published weights (`input_blocks.1.1.transformer_blocks.0.attn2.to_k_ip.weight`), so a file loads as it is.
"""

import math
from dataclasses import dataclass, fields
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

GROUPS = 32
LONGEST_PERIOD = 10000.0  # of the sines that embed time
RESAMPLER_LAYERS = 4
RESAMPLER_HEAD = 64  # channels of a head
EXPANSION = 4  # inner channels of a feed-forward layer, and of the embedding of time


@dataclass(frozen=True)
class MultiViewUnetConfig:
    """Sizes, under the names that `unet/config.json` has for them; the defaults are the published model's.

    Attributes:
        in_channels: of a latent.
        out_channels: of a predicted noise.
        model_channels: of the first level.
        channel_mult: channels of every level, times `model_channels`.
        num_res_blocks: per level on the way down; one more on the way up.
        attention_resolutions: how many times smaller than the latent the levels with attention are.
        num_head_channels: channels of an attention head.
        transformer_depth: attention blocks in a row.
        context_dim: channels of a token.
        camera_dim: numbers of a camera.
        ip_dim: tokens of the picture.
        ip_weight: of what the picture's tokens say, against the text's.
        image_dim: channels of the picture's features (the published file does not name it: CLIP ViT-H/14).
        image_heads: of the attention that makes the picture's tokens (the published file does not name it).
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
        """The sizes in a `config.json`; keys that are no sizes are ignored."""
        names = [field.name for field in fields(MultiViewUnetConfig) if field.name in config]
        sizes: dict[str, Any] = {
            name: tuple(config[name]) if isinstance(config[name], list) else config[name] for name in names
        }
        return MultiViewUnetConfig(**sizes)


class MultiViewUnet(nn.Module):
    """Predicts the noise of sets of views.

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
                self.input_blocks.append(_Layers([_Shrink(channels)]))
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
                    layers.append(_Grow(channels))
                self.output_blocks.append(_Layers(layers))
        self.out = nn.Sequential(
            nn.GroupNorm(GROUPS, channels), nn.SiLU(), nn.Conv2d(width, shape.out_channels, 3, padding=1)
        )

    def _block(self, inputs: int, outputs: int, level: int) -> list[nn.Module]:
        """The layers of one block of a level."""
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
        """The noise in the latents.

        Args:
            latents: s sets of v views; the views of a set see each other.
            timestep: how noisy they are, 0 to 999.
            cameras: of every view.
            text: tokens of a set's text.
            image: features of a set's picture.
        """
        sets, views = latents.shape[:2]
        time = self.time_embed(_sines(timestep, self.shape.model_channels).to(latents))
        embedding = time + self.camera_embed(cameras.flatten(0, 1))
        tokens = torch.cat([text, self.image_embed(image)], 1).repeat_interleave(views, 0)
        x, kept = latents.flatten(0, 1), []
        for block in self.input_blocks:
            x = block(x, embedding, tokens, views)
            kept.append(x)
        x = self.middle_block(x, embedding, tokens, views)
        for block in self.output_blocks:
            x = block(torch.cat([x, kept.pop()], 1), embedding, tokens, views)
        return self.out(x).unflatten(0, (sets, views))


class _Layers(nn.ModuleList):
    """Layers in a row; each gets what it needs."""

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
    """Two convolutions beside a shortcut; the embedding is added between them."""

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
    """Attention over the pixels of a set, then over tokens, beside a shortcut."""

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
    """What pixels tell each other, what the tokens tell them, and what they make of it."""

    def __init__(self, channels: int, shape: MultiViewUnetConfig) -> None:
        super().__init__()
        head = shape.num_head_channels
        self.attn1 = _Attention(channels, channels, head)
        self.attn2 = _Attention(channels, shape.context_dim, head, shape.ip_dim, shape.ip_weight)
        self.ff = _FeedForward(channels)
        self.norm1, self.norm2, self.norm3 = (nn.LayerNorm(channels) for _ in range(3))

    def forward(self, pixels: Tensor, tokens: Tensor, views: int) -> Tensor:
        of_set = self.norm1(pixels).unflatten(0, (-1, views)).flatten(1, 2)
        pixels = pixels + self.attn1(of_set, of_set).unflatten(1, (views, -1)).flatten(0, 1)
        pixels = pixels + self.attn2(self.norm2(pixels), tokens)
        return pixels + self.ff(self.norm3(pixels))


class _Attention(nn.Module):
    """Softmax attention; the last `picture` tokens have keys, values and a sum of their own."""

    def __init__(self, channels: int, context: int, head: int, picture: int = 0, picture_weight: float = 1.0) -> None:
        super().__init__()
        self.heads, self.picture, self.picture_weight = channels // head, picture, picture_weight
        self.to_q = nn.Linear(channels, channels, bias=False)
        self.to_k, self.to_v = (nn.Linear(context, channels, bias=False) for _ in range(2))
        if picture:
            self.to_k_ip, self.to_v_ip = (nn.Linear(context, channels, bias=False) for _ in range(2))
        self.to_out = nn.Sequential(nn.Linear(channels, channels))

    def forward(self, x: Tensor, tokens: Tensor) -> Tensor:
        words = tokens[:, : tokens.shape[1] - self.picture]
        queries = self.to_q(x)
        seen = attend(queries, self.to_k(words), self.to_v(words), self.heads)
        if self.picture:
            shown = tokens[:, -self.picture :]
            about = attend(queries, self.to_k_ip(shown), self.to_v_ip(shown), self.heads)
            seen = seen + self.picture_weight * about
        return self.to_out(seen)


class _FeedForward(nn.Module):
    """A gated layer."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        inner = EXPANSION * channels
        self.net = nn.Sequential(_Gated(channels, inner), nn.Identity(), nn.Linear(inner, channels))

    def forward(self, x: Tensor) -> Tensor:
        return self.net(x)


class _Gated(nn.Module):
    """Half of the channels open and close the other half."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.proj = nn.Linear(inputs, 2 * outputs)

    def forward(self, x: Tensor) -> Tensor:
        values, gates = self.proj(x).chunk(2, -1)
        return values * functional.gelu(gates)


class _Resampler(nn.Module):
    """Features of a picture to a few tokens, which ask the features and each other."""

    def __init__(self, shape: MultiViewUnetConfig) -> None:
        super().__init__()
        width = shape.context_dim
        self.latents = nn.Parameter(torch.randn(1, shape.ip_dim, width) / width**0.5)
        self.proj_in = nn.Linear(shape.image_dim, width)
        self.proj_out = nn.Linear(width, width)
        self.norm_out = nn.LayerNorm(width)
        self.layers = nn.ModuleList(
            _Exchange([_Asking(width, shape.image_heads), _thinking(width)]) for _ in range(RESAMPLER_LAYERS)
        )

    def forward(self, features: Float[Tensor, "s m e"]) -> Float[Tensor, "s n d"]:
        features, tokens = self.proj_in(features), self.latents.expand(len(features), -1, -1)
        for exchange in self.layers:
            tokens = exchange(features, tokens)
        return self.norm_out(self.proj_out(tokens))


class _Exchange(nn.ModuleList):
    """Tokens ask, then think."""

    def forward(self, features: Tensor, tokens: Tensor) -> Tensor:
        ask, think = self
        tokens = tokens + ask(features, tokens)
        return tokens + think(tokens)


class _Asking(nn.Module):
    """Tokens attend to features and to themselves."""

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


class _Shrink(nn.Module):
    """Half the size."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.op = nn.Conv2d(channels, channels, 3, stride=2, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return self.op(x)


class _Grow(nn.Module):
    """Twice the size."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return self.conv(functional.interpolate(x, scale_factor=2.0, mode="nearest"))


def attend(
    queries: Float[Tensor, "b q c"], keys: Float[Tensor, "b k c"], values: Float[Tensor, "b k c"], heads: int
) -> Float[Tensor, "b q c"]:
    """Softmax attention with the channels divided among the heads."""
    q, k, v = (x.unflatten(-1, (heads, -1)).transpose(1, 2) for x in (queries, keys, values))
    return functional.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)


def _embedder(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, outputs), nn.SiLU(), nn.Linear(outputs, outputs))


def _thinking(width: int) -> nn.Sequential:
    inner = EXPANSION * width
    return nn.Sequential(
        nn.LayerNorm(width), nn.Linear(width, inner, bias=False), nn.GELU(), nn.Linear(inner, width, bias=False)
    )


def _sines(timestep: int, channels: int) -> Float[Tensor, " channels"]:
    """Cosines, then sines, of the timestep at falling frequencies."""
    half = channels // 2
    angles = timestep * torch.exp(-math.log(LONGEST_PERIOD) * torch.arange(half) / half)
    return torch.cat([angles.cos(), angles.sin()])
