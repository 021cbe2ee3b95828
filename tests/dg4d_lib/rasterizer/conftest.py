"""Clouds, backends and cotangents that the rasterizer tests share."""

from collections.abc import Callable, Sequence

import pytest
import torch
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BackendUnavailable
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.spherical_harmonics import rgb_to_sh
from dg4d_lib.rasterizer.interface import Rasterizer, Rendering, get_rasterizer

COLORFUL = torch.tensor([0.9, 0.1, 0.4])


@pytest.fixture(params=["reference", "cpu", pytest.param("cuda_gsplat", marks=pytest.mark.gpu)])
def backend(request: pytest.FixtureRequest) -> str:
    """The name of every backend that can run here."""
    try:
        get_rasterizer(request.param)
    except BackendUnavailable as missing:
        pytest.skip(str(missing))
    return request.param


@pytest.fixture
def rasterize(backend: str) -> Rasterizer:
    """Every backend that can run here."""
    return get_rasterizer(backend)


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
            rgb_to_sh(rgb),
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
def cotangents() -> Callable[[Rendering], tuple[Tensor, Tensor, Tensor]]:
    """Random weights of color, alpha and depth, the same for renderings of one shape."""

    def make(rendering: Rendering) -> tuple[Tensor, Tensor, Tensor]:
        generator = torch.Generator().manual_seed(11)
        shapes = (rendering.color.shape, rendering.alpha.shape, rendering.depth.shape)
        color, alpha, depth = (torch.randn(shape, generator=generator) for shape in shapes)
        return color, alpha, depth

    return make


@pytest.fixture
def drawn() -> Callable[..., tuple[Rendering, dict[str, Tensor]]]:
    """A rendering of a cloud in a precision, and the leaves whose gradients are of interest, by name."""

    def draw(
        rasterize: Rasterizer,
        cloud: Gaussians,
        cameras: Sequence[OrbitCamera],
        dtype: torch.dtype,
        background: Tensor = COLORFUL,
    ) -> tuple[Rendering, dict[str, Tensor]]:
        leaves = {name: value.detach().to(dtype).requires_grad_() for name, value in vars(cloud).items()}
        offsets = cloud.means.new_zeros(len(cameras), len(cloud), 2, dtype=dtype).requires_grad_()
        return rasterize(Gaussians(**leaves), cameras, background, offsets), {**leaves, "means2d_offsets": offsets}

    return draw


@pytest.fixture
def gradients(cotangents) -> Callable[..., dict[str, Tensor]]:
    """Gradients of the leaves under the cotangents, at the pixels of a mask."""

    def differentiate(rendering: Rendering, leaves: dict[str, Tensor], mask: Tensor | None = None) -> dict[str, Tensor]:
        pictures = (rendering.color, rendering.alpha, rendering.depth)
        weights = [weight.to(rendering.color) for weight in cotangents(rendering)]
        if mask is not None:
            weights = [weight * mask.to(weight) for weight in weights]
        found = torch.autograd.grad(pictures, list(leaves.values()), weights)
        return dict(zip(leaves, found, strict=True))

    return differentiate


@pytest.fixture
def forward_and_backward(drawn, gradients) -> Callable[..., tuple[Rendering, dict[str, Tensor]]]:
    """A rendering, and its gradients under the cotangents at every pixel."""

    def run(
        rasterize: Rasterizer, cloud: Gaussians, cameras: Sequence[OrbitCamera], dtype: torch.dtype
    ) -> tuple[Rendering, dict[str, Tensor]]:
        rendering, leaves = drawn(rasterize, cloud, cameras, dtype)
        return rendering, gradients(rendering, leaves)

    return run
