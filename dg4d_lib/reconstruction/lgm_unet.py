"""LGM's network: an asymmetric U-Net that looks at four views at once (Tang et al. 2024, "LGM", section 3.3).

Modules carry the names of the published weights (`unet.down_blocks.3.attns.0.attn.qkv.weight`): a file loads as it is.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

VIEWS = 4
LAYERS = 2  # residual blocks of a level on the way down; one more on the way up
HEADS = 16
GROUPS = 32
SKIP_SCALE = 0.5**0.5  # keeps the variance of a sum of two


@dataclass(frozen=True)
class UnetConfig:
    """Channels of every level, and which levels exchange what the views see; the defaults are the published "big".

    Attributes:
        down_channels: multiples of 32; every level but the last halves the size.
        down_attention: one per level.
        up_channels: multiples of 32; every level but the last doubles the size.
        up_attention: one per level.
    """

    down_channels: tuple[int, ...] = (64, 128, 256, 512, 1024, 1024)
    down_attention: tuple[bool, ...] = (False, False, False, True, True, True)
    up_channels: tuple[int, ...] = (1024, 1024, 512, 256, 128)
    up_attention: tuple[bool, ...] = (True, True, True, False, False)


class Unet(nn.Module):
    """Features of four views to features of four views.

    Args:
        inputs: channels of a view.
        outputs: channels of a view.
        shape: of the levels.
    """

    def __init__(self, inputs: int, outputs: int, shape: UnetConfig) -> None:
        super().__init__()
        down, up = shape.down_channels, shape.up_channels
        self.conv_in = nn.Conv2d(inputs, down[0], 3, padding=1)
        self.down_blocks = nn.ModuleList(
            _Down(down[max(i - 1, 0)], down[i], shape.down_attention[i], shrink=i < len(down) - 1)
            for i in range(len(down))
        )
        self.mid_block = _Middle(down[-1])
        self.up_blocks = nn.ModuleList(
            _Up(up[max(i - 1, 0)], down[-2 - i], up[i], shape.up_attention[i], grow=i < len(up) - 1)
            for i in range(len(up))
        )
        self.norm_out = _norm(up[-1])
        self.conv_out = nn.Conv2d(up[-1], outputs, 3, padding=1)

    def forward(self, views: Float[Tensor, "b c h w"]) -> Float[Tensor, "b o i j"]:
        """Four consecutive images are the views of one object."""
        x = self.conv_in(views)
        skips = [x]
        for block in self.down_blocks:
            x = block(x, skips)
        x = self.mid_block(x)
        for block in self.up_blocks:
            x = block(x, skips)
        return self.conv_out(functional.silu(self.norm_out(x)))


class _Down(nn.Module):
    """A level on the way down; everything it computes is kept for the way up."""

    def __init__(self, inputs: int, outputs: int, attention: bool, shrink: bool) -> None:
        super().__init__()
        self.nets = nn.ModuleList(_Residual(outputs if i else inputs, outputs) for i in range(LAYERS))
        self.attns = nn.ModuleList(_exchange(outputs, attention) for _ in range(LAYERS))
        self.downsample = nn.Conv2d(outputs, outputs, 3, stride=2, padding=1) if shrink else None

    def forward(self, x: Tensor, skips: list[Tensor]) -> Tensor:
        for net, exchange in zip(self.nets, self.attns, strict=True):
            x = exchange(net(x))
            skips.append(x)
        if self.downsample is not None:
            x = self.downsample(x)
            skips.append(x)
        return x


class _Middle(nn.Module):
    """The deepest level."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.nets = nn.ModuleList(_Residual(channels, channels) for _ in range(2))
        self.attns = nn.ModuleList([_ViewAttention(channels)])

    def forward(self, x: Tensor) -> Tensor:
        return self.nets[1](self.attns[0](self.nets[0](x)))


class _Up(nn.Module):
    """A level on the way up; takes back one kept feature per residual block, the last of them from the level above."""

    def __init__(self, inputs: int, skip: int, outputs: int, attention: bool, grow: bool) -> None:
        super().__init__()
        self.nets = nn.ModuleList(
            _Residual((outputs if i else inputs) + (skip if i == LAYERS else outputs), outputs)
            for i in range(LAYERS + 1)
        )
        self.attns = nn.ModuleList(_exchange(outputs, attention) for _ in range(LAYERS + 1))
        self.upsample = nn.Conv2d(outputs, outputs, 3, padding=1) if grow else None

    def forward(self, x: Tensor, skips: list[Tensor]) -> Tensor:
        for net, exchange in zip(self.nets, self.attns, strict=True):
            x = exchange(net(torch.cat([x, skips.pop()], 1)))
        if self.upsample is not None:
            x = self.upsample(functional.interpolate(x, scale_factor=2.0, mode="nearest"))
        return x


class _Residual(nn.Module):
    """Two convolutions beside a shortcut."""

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
    """Every pixel of the four views looks at every other."""

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
    """Softmax attention of tokens with themselves."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.qkv = nn.Linear(channels, 3 * channels, bias=False)
        self.proj = nn.Linear(channels, channels)

    def forward(self, tokens: Tensor) -> Tensor:
        queries, keys, values = self.qkv(tokens).unflatten(-1, (3, HEADS, -1)).permute(2, 0, 3, 1, 4)
        seen = functional.scaled_dot_product_attention(queries, keys, values)
        return self.proj(seen.transpose(1, 2).flatten(2))


def _exchange(channels: int, attention: bool) -> nn.Module:
    return _ViewAttention(channels) if attention else nn.Identity()


def _norm(channels: int) -> nn.GroupNorm:
    return nn.GroupNorm(GROUPS, channels, eps=1e-5)
