"""Clouds and cotangents that the rasterizer tests share."""

from collections.abc import Callable, Sequence
from typing import Any

import pytest
import torch
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.harmonics import harmonics_of_color
from dg4d_lib.rasterizer.interface import Rasterizer, Rendering


@pytest.fixture
def blobs() -> Callable[..., Gaussians]:
    """Opaque round Gaussians: `blobs([(x, y, z), ...], scale, opacity, colors)`, float64."""

    def make(
        means: Sequence[Sequence[float]],
        scale: float = 0.05,
        opacity: float = 0.8,
        colors: Sequence[Sequence[float]] | None = None,
    ) -> Gaussians:
        n = len(means)
        rgb = torch.full((n, 3), 0.5).double() if colors is None else torch.tensor(colors).double()
        return Gaussians(
            torch.tensor(means).double(),
            torch.full((n, 3), scale).double().log(),
            torch.tensor([[1.0, 0.0, 0.0, 0.0]]).double().repeat(n, 1),
            torch.full((n,), opacity).double().logit(),
            harmonics_of_color(rgb),
        )

    return make


@pytest.fixture
def random_cloud() -> Callable[..., Gaussians]:
    """Random Gaussians around the origin with quaternions of any length, float64; `states` adds a leading batch."""

    def make(
        count: int, states: int = 0, scale: float = 0.05, spread: float = 0.5, opacity: float = 0.0, place: float = 0.3
    ) -> Gaussians:
        generator = torch.Generator().manual_seed(3)

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        batch = (states,) if states else ()
        cloud = Gaussians(
            place * normal(*batch, count, 3),
            spread * normal(*batch, count, 3) + torch.tensor(scale).double().log(),
            normal(*batch, count, 4),
            normal(count) + opacity,
            normal(count, 1, 3),
        )
        return cloud.to(torch.float32).to(torch.float64)  # rounded once, so that both precisions see the same cloud

    return make


@pytest.fixture
def forward_and_backward() -> Callable[..., tuple[Rendering, dict[str, Tensor]]]:
    """A rendering, and the gradients under random cotangents for color, alpha and depth."""

    def run(
        rasterizer: Rasterizer, gaussians: Gaussians, cameras: Sequence[OrbitCamera], dtype: torch.dtype, **options: Any
    ) -> tuple[Rendering, dict[str, Tensor]]:
        leaves = {name: value.detach().to(dtype).requires_grad_() for name, value in vars(gaussians).items()}
        offsets = torch.zeros(len(cameras), len(gaussians), 2, dtype=dtype, requires_grad=True)
        background = options.get("background", torch.tensor([0.9, 0.1, 0.4]))
        rendering = rasterizer(Gaussians(**leaves), cameras, background, offsets)
        generator = torch.Generator().manual_seed(11)
        loss = torch.zeros((), dtype=dtype)
        for picture in (rendering.color, rendering.alpha, rendering.depth):
            cotangent = torch.randn(picture.shape, generator=generator, dtype=torch.float64).to(dtype)
            loss = loss + (cotangent * picture).sum()
        loss.backward()
        gradients = {name: value.grad for name, value in {**leaves, "screen_offsets": offsets}.items()}
        return rendering, {name: value for name, value in gradients.items() if value is not None}

    return run
