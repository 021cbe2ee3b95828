"""LGM's asymmetric U-Net with attention across four views (Tang et al. 2024, "LGM", section 3.3).

Modules have the names of the published weights (`unet.down_blocks.3.attns.0.attn.qkv.weight`), so files load unchanged.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

VIEWS = 4
LAYERS = 2  # residual blocks per encoder level; decoder levels have one more
HEADS = 16
GROUPS = 32
SKIP_SCALE = 0.5**0.5  # keeps the variance of a sum of two


@dataclass(frozen=True)
class UnetConfig:
    """Channels and cross-view attention of every level; the defaults are those of the published "big" model.

    Attributes:
        down_channels: encoder, multiples of 32; every level but the last halves the size.
        down_attention: encoder levels with attention.
        up_channels: decoder, multiples of 32; every level but the last doubles the size.
        up_attention: decoder levels with attention.
    """

    down_channels: tuple[int, ...] = (64, 128, 256, 512, 1024, 1024)
    down_attention: tuple[bool, ...] = (False, False, False, True, True, True)
    up_channels: tuple[int, ...] = (1024, 1024, 512, 256, 128)
    up_attention: tuple[bool, ...] = (True, True, True, False, False)


class Unet(nn.Module):
    """U-Net over sets of four views.

    Args:
        inputs: channels of a view.
        outputs: channels of a view.
        config: of the levels.
    """

    def __init__(self, inputs: int, outputs: int, config: UnetConfig) -> None:
        super().__init__()
        down, up = config.down_channels, config.up_channels
        self.conv_in = nn.Conv2d(inputs, down[0], 3, padding=1)
        self.down_blocks = nn.ModuleList(
            _Down(down[max(i - 1, 0)], down[i], config.down_attention[i], shrink=i < len(down) - 1)
            for i in range(len(down))
        )
        self.mid_block = _Middle(down[-1])
        self.up_blocks = nn.ModuleList(
            _Up(up[max(i - 1, 0)], down[-2 - i], up[i], config.up_attention[i], grow=i < len(up) - 1)
            for i in range(len(up))
        )
        self.norm_out = _norm(up[-1])
        self.conv_out = nn.Conv2d(up[-1], outputs, 3, padding=1)

    def forward(self, views: Float[Tensor, "b c h w"]) -> Float[Tensor, "b o i j"]:
        """Process views; four consecutive ones show one object."""
        x = self.conv_in(views)
        skips = [x]
        for block in self.down_blocks:
            x = block(x, skips)
        x = self.mid_block(x)
        for block in self.up_blocks:
            x = block(x, skips)
        return self.conv_out(functional.silu(self.norm_out(x)))


class _Down(nn.Module):
    """Encoder level; all its outputs become skip connections."""

    def __init__(self, inputs: int, outputs: int, attention: bool, shrink: bool) -> None:
        super().__init__()
        self.nets = nn.ModuleList(_Residual(outputs if i else inputs, outputs) for i in range(LAYERS))
        self.attns = nn.ModuleList(_view_attention(outputs, attention) for _ in range(LAYERS))
        self.downsample = nn.Conv2d(outputs, outputs, 3, stride=2, padding=1) if shrink else None

    def forward(self, x: Tensor, skips: list[Tensor]) -> Tensor:
        for net, attention in zip(self.nets, self.attns, strict=True):
            x = attention(net(x))
            skips.append(x)
        if self.downsample is not None:
            x = self.downsample(x)
            skips.append(x)
        return x


class _Middle(nn.Module):
    """Bottleneck."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.nets = nn.ModuleList(_Residual(channels, channels) for _ in range(2))
        self.attns = nn.ModuleList([_ViewAttention(channels)])

    def forward(self, x: Tensor) -> Tensor:
        return self.nets[1](self.attns[0](self.nets[0](x)))


class _Up(nn.Module):
    """Decoder level; takes one skip connection per residual block, the last from the level above."""

    def __init__(self, inputs: int, skip: int, outputs: int, attention: bool, grow: bool) -> None:
        super().__init__()
        self.nets = nn.ModuleList(
            _Residual((outputs if i else inputs) + (skip if i == LAYERS else outputs), outputs)
            for i in range(LAYERS + 1)
        )
        self.attns = nn.ModuleList(_view_attention(outputs, attention) for _ in range(LAYERS + 1))
        self.upsample = nn.Conv2d(outputs, outputs, 3, padding=1) if grow else None

    def forward(self, x: Tensor, skips: list[Tensor]) -> Tensor:
        for net, attention in zip(self.nets, self.attns, strict=True):
            x = attention(net(torch.cat([x, skips.pop()], 1)))
        if self.upsample is not None:
            x = self.upsample(functional.interpolate(x, scale_factor=2.0, mode="nearest"))
        return x


class _Residual(nn.Module):
    """Residual block of two convolutions."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.norm1, self.norm2 = _norm(inputs), _norm(outputs)
        self.conv1 = nn.Conv2d(inputs, outputs, 3, padding=1)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, padding=1)
        self.shortcut = nn.Identity() if inputs == outputs else nn.Conv2d(inputs, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        residue = self.conv1(functional.silu(self.norm1(x)))
        residue = self.conv2(functional.silu(self.norm2(residue)))
        return (residue + self.shortcut(x)) * SKIP_SCALE


class _ViewAttention(nn.Module):
    """Self-attention over the pixels of all four views."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = _norm(channels)
        self.attn = _Attention(channels)

    def forward(self, x: Tensor) -> Tensor:
        images, channels, height, width = x.shape
        tokens = self.norm(x).flatten(2).mT.reshape(images // VIEWS, VIEWS * height * width, channels)
        seen = self.attn(tokens).reshape(images, height * width, channels).mT.reshape(x.shape)
        return (seen + x) * SKIP_SCALE


class _Attention(nn.Module):
    """Softmax self-attention."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.qkv = nn.Linear(channels, 3 * channels, bias=False)
        self.proj = nn.Linear(channels, channels)

    def forward(self, tokens: Tensor) -> Tensor:
        queries, keys, values = self.qkv(tokens).unflatten(-1, (3, HEADS, -1)).permute(2, 0, 3, 1, 4)
        seen = functional.scaled_dot_product_attention(queries, keys, values)
        return self.proj(seen.transpose(1, 2).flatten(2))


def _view_attention(channels: int, attention: bool) -> nn.Module:
    return _ViewAttention(channels) if attention else nn.Identity()


def _norm(channels: int) -> nn.GroupNorm:
    return nn.GroupNorm(GROUPS, channels, eps=1e-5)
