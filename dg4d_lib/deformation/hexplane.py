"""HexPlane deformation field: six feature planes over space and time and a small MLP (Cao and Johnson 2023; paper 3.2).

With zero-initialized residual heads the deformation is exactly zero at the start; in the first iteration only the last
matrices of the heads receive a gradient.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from dg4d_lib.deformation.hexplane_kernel import SPATIAL_AXES, hexplane_features
from dg4d_lib.deformation.interface import Displacement
from dg4d_lib.settings import HexPlaneSettings

PLANES = 3  # of space and of time; the public code sums its regularizers over them
ROWS = 1 << 13  # Gaussians times timestamps per pass of the MLP on the CPU: the activations fit into the cache


class ResidualHead(nn.Module):
    """Residual head, zero-initialized: h = relu(x); y = h + A h + a; out = B y + b."""

    def __init__(self, hidden: int, outputs: int) -> None:
        super().__init__()
        self.inner, self.outer = nn.Linear(hidden, hidden), nn.Linear(hidden, outputs)
        for parameter in self.parameters():
            nn.init.zeros_(parameter)

    def fold(self) -> tuple[Float[Tensor, "outputs hidden"], Float[Tensor, "outputs 1"]]:
        """Return B (1 + A) and B a + b: the head is affine in h, so one matrix and one offset suffice."""
        a, b = self.inner, self.outer
        return torch.addmm(b.weight, b.weight, a.weight), torch.addmv(b.bias, b.weight, a.bias)[:, None]


class Heads(nn.Module):
    """MLP heads: features of a Gaussian at a time to its displacement."""

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.means, self.log_scales, self.quats = (ResidualHead(hidden, outputs) for outputs in (3, 3, 4))

    def forward(self, trunk: nn.Linear, features: Float[Tensor, "t n c"]) -> Displacement:
        """Return the displacement at every time, with `trunk` as the first layer.

        On the CPU the rows are split so that activations stay in the cache, and the product is taken transposed,
        because a matrix with ten rows is faster there than one with ten columns.
        """
        heads = (self.means, self.log_scales, self.quats)
        matrix, offset = (torch.cat(parts) for parts in zip(*(head.fold() for head in heads), strict=True))
        times, count, _ = features.shape
        rows = features.flatten(0, 1)
        parts = rows.split(ROWS) if rows.device.type == "cpu" else [rows]
        outputs = torch.cat([torch.addmm(offset, matrix, functional.relu(trunk(part)).T) for part in parts], 1)
        return Displacement(*outputs.unflatten(1, (times, count)).movedim(0, -1).split((3, 3, 4), -1))


class HexPlane(nn.Module):
    """Deformation model of the paper.

    Args:
        settings: sizes and regularizers.
        bounds: lower and upper corner of the box that the planes cover, world units.
        generator: initializes the planes and the MLP.
        last: time of the last frame on the time axis of the planes, which ends at 1.
    """

    bounds: Tensor

    def __init__(
        self,
        settings: HexPlaneSettings,
        bounds: Float[Tensor, "2 3"],
        generator: torch.Generator | None = None,
        last: float = 1.0,
    ) -> None:
        super().__init__()
        self.settings, self.last = settings, last
        self.register_buffer("bounds", bounds)
        c, t = settings.features, settings.temporal
        sizes = [max(2, round(settings.spatial * scale)) for scale in settings.scales]
        self.space = nn.ParameterList(torch.empty(3, c, r, r).uniform_(0.1, 0.5, generator=generator) for r in sizes)
        self.time = nn.ParameterList(torch.ones(3, c, t, r) for r in sizes)
        self.trunk = nn.Linear(c * len(sizes), settings.hidden)
        nn.init.xavier_uniform_(self.trunk.weight, generator=generator)
        nn.init.zeros_(self.trunk.bias)
        self.heads = Heads(settings.hidden)
        if not settings.zero_start:
            for matrix in (parameter for parameter in self.heads.parameters() if parameter.ndim == 2):
                nn.init.xavier_uniform_(matrix, generator=generator)

    def displace(self, means: Float[Tensor, "n 3"], times: Float[Tensor, " t"]) -> Displacement:
        """Return the displacements at times in [0, 1]; means outside the box are clamped to it."""
        low, high = self.bounds
        coordinates = ((means - low) / (high - low) * 2 - 1).clamp(-1, 1)
        on_cpu = means.device.type == "cpu" and means.dtype == torch.float32
        read = hexplane_features if on_cpu else plane_features
        features = [
            read(coordinates, space, time_lines(time, self.last * times))
            for space, time in zip(self.space, self.time, strict=True)
        ]
        displacement: Displacement = self.heads(self.trunk, torch.cat(features, -1))
        return displacement

    def grid_parameters(self) -> list[nn.Parameter]:
        """Return the parameters that use `plane_lr`: the six planes."""
        return [*self.space, *self.time]

    def length_parameters(self) -> list[nn.Parameter]:
        """Return the parameters that carry the unit of length: the last layer of the head of the means."""
        return list(self.heads.means.outer.parameters())

    def regularization_loss(self) -> Float[Tensor, ""]:
        """Return the weighted spatial variation, temporal smoothness and temporal sparsity; zero by default.

        Each is a mean over a plane, summed over three planes: three times the mean over all, as they have one size.
        Spatial planes have second differences along both axes; the public code has them along the rows only.
        """
        s = self.settings
        variation, smoothness, sparsity = (
            PLANES * weight for weight in (s.variation_weight, s.smoothness_weight, s.sparsity_weight)
        )
        total = self.bounds.new_zeros(())
        for space, time in zip(self.space, self.time, strict=True):
            if variation:
                total = total + variation * sum(mean_square_curvature(space, axis) for axis in (-1, -2))
            if smoothness:
                total = total + smoothness * mean_square_curvature(time, -2)
            if sparsity:
                total = total + sparsity * (time - 1).abs().mean()
        return total


def mean_square_curvature(planes: Float[Tensor, "..."], axis: int) -> Float[Tensor, ""]:
    """Return the mean squared second difference along an axis; 0 if it has fewer than three steps."""
    differences = planes.diff(n=2, dim=axis)
    return differences.square().mean() if differences.numel() else planes.new_zeros(())


def time_lines(planes: Float[Tensor, "3 c steps r"], times: Float[Tensor, " t"]) -> Float[Tensor, "3 t c r"]:
    """Sample the time planes at these times, linearly between the steps, both ends included."""
    steps = planes.shape[2]
    position = times.clamp(0, 1) * (steps - 1)
    hat = (1 - (position[:, None] - torch.arange(steps, dtype=planes.dtype, device=planes.device)).abs()).clamp(min=0)
    return torch.einsum("ts,acsr->atcr", hat, planes)


def plane_features(
    coordinates: Float[Tensor, "n 3"], planes: Float[Tensor, "3 c r r"], lines: Float[Tensor, "3 t c r"]
) -> Float[Tensor, "t n c"]:
    """Return the product of the six samples; coordinates in [-1, 1], corners aligned.

    The reference implementation of `hexplane_features` in plain torch, used on other devices and precisions.
    """
    pairs = torch.stack([torch.stack([coordinates[:, axis] for axis in axes], -1) for axes in SPATIAL_AXES])
    samples = functional.grid_sample(planes, pairs[:, None], align_corners=True, padding_mode="border")[:, :, 0]
    space = samples[0] * samples[1] * samples[2]  # the backward pass of `prod` synchronizes with the GPU
    last = lines.shape[-1] - 1
    position = (coordinates + 1) / 2 * last
    left = position.floor().clamp(0, last - 1)
    weight = (position - left).to(lines.dtype)
    left = left.long()
    features = space.T
    for axis in range(3):
        i, f = left[:, axis], weight[:, axis]
        features = features * (lines[axis][..., i] * (1 - f) + lines[axis][..., i + 1] * f).transpose(-1, -2)
    return features
