"""Speed of the deformation field and of SSIM against plain implementations: CPU time, forward and backward.

Run with `python -m benchmarks.deformation` (1 to 2 minutes; `--quick`: seconds; `--json FILE` keeps the rows). Times of
the deformation are per call for all timestamps, those of SSIM per image. Peers:

`grid_sample`            all six planes sampled at every Gaussian and timestamp, as in the papers' code
`grid_sample_once`       spatial planes sampled once per Gaussian, time planes at every timestamp
`grid_sample..._means`   the same with a gradient in the Gaussians' means, as for `motion.fine_tune`
`grid_sample..._heads`   the same with the network: trunk and separate residual heads
`conv2d`                 SSIM by convolutions, as in the code of 3DGS

Freed memory is returned to the system here. Steps keep it (`steps/main.py`), which favors the peers: to compare under
their conditions set `MALLOC_MMAP_MAX_=0 MALLOC_TRIM_THRESHOLD_=2147483647 MALLOC_TOP_PAD_=268435456`.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

from benchmarks.measure import interleaved, machine, new_console, parser_of, write_rows  # before torch

import torch  # isort: skip
from rich.table import Column, Table
from torch import Tensor
from torch.nn import functional

from dg4d_lib.deformation.hexplane import HexPlane, time_lines
from dg4d_lib.deformation.hexplane_kernel import SPATIAL_AXES, hexplane_features
from dg4d_lib.metrics.ssim import C1, C2, SIGMA, WINDOW, ssim
from dg4d_lib.settings import HexPlaneSettings

TIMES, PICTURES = 14, 4


@dataclass(frozen=True)
class Row:
    """Comparison with a peer; `size` in pixels, `views` are timestamps or images."""

    peer: str
    gaussians: int | None
    size: int | None
    views: int
    ours_cpu_ms: float
    peer_cpu_ms: float
    cpu_ratio: float


def sampled(plane: Tensor, places: Tensor) -> Tensor:
    """Sample one plane at positions in [-1, 1], as "positions channels"."""
    found = functional.grid_sample(plane[None], places[None, None], align_corners=True, padding_mode="border")
    return found[0, :, 0].T


def naive_features(coordinates: Tensor, times: Tensor, space: Tensor, time: Tensor) -> Tensor:
    """Return the product of six samples at every Gaussian and timestamp."""
    t, n = len(times), len(coordinates)
    everywhere = coordinates.expand(t, n, 3).reshape(-1, 3)
    timestamps = (2 * times - 1)[:, None].expand(t, n).reshape(-1)
    product = torch.ones(())
    for plane, axes in zip(space, SPATIAL_AXES, strict=True):
        product = product * sampled(plane, everywhere[:, list(axes)])
    for axis, plane in enumerate(time):
        product = product * sampled(plane, torch.stack([everywhere[:, axis], timestamps], -1))
    return product.unflatten(0, (t, n))


def features_with_space_once(coordinates: Tensor, times: Tensor, space: Tensor, time: Tensor) -> Tensor:
    """Return the same product with the spatial planes sampled only once."""
    t, n = len(times), len(coordinates)
    product = torch.ones(())
    for plane, axes in zip(space, SPATIAL_AXES, strict=True):
        product = product * sampled(plane, coordinates[:, list(axes)])
    for axis, plane in enumerate(time):
        places = torch.stack([coordinates[:, axis].expand(t, n), (2 * times - 1)[:, None].expand(t, n)], -1)
        product = product * sampled(plane, places.reshape(-1, 2)).unflatten(0, (t, n))
    return product


def fused_features(coordinates: Tensor, times: Tensor, space: Tensor, time: Tensor) -> Tensor:
    return hexplane_features(coordinates, space, time_lines(time, times))


def heads_one_by_one(field: HexPlane, features: Tensor) -> list[Tensor]:
    """Evaluate h = relu(trunk); B (h + A h + a) + b for means, scales and rotations."""
    hidden = functional.relu(field.trunk(features))
    heads = (field.heads.means, field.heads.log_scales, field.heads.quats)
    return [head.outer(hidden + head.inner(hidden)) for head in heads]


def ssim_by_convolution(images: Tensor, ground_truth: Tensor) -> Tensor:
    """Return the SSIM of "b c h w" images over positions of the window inside the image."""
    steps = torch.arange(WINDOW) - WINDOW // 2
    line = torch.exp(-steps.square() / (2 * SIGMA**2))
    window = (line[:, None] * line / line.sum() ** 2).expand(images.shape[1], 1, WINDOW, WINDOW)
    mean = partial(functional.conv2d, weight=window, groups=len(window))
    mean_x, mean_y = mean(images), mean(ground_truth)
    variance_x, variance_y = mean(images * images) - mean_x**2, mean(ground_truth * ground_truth) - mean_y**2
    covariance = mean(images * ground_truth) - mean_x * mean_y
    light = (2 * mean_x * mean_y + C1) / (mean_x**2 + mean_y**2 + C1)
    return (light * (2 * covariance + C2) / (variance_x + variance_y + C2)).mean((1, 2, 3))


def measure_deformation(count: int, settings: HexPlaneSettings, rounds: int) -> Iterator[Row]:
    """Measure the features, the features with trainable means, and the features with the network."""
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=generator) * 2 - 1
    times = torch.linspace(0, 1, TIMES)
    field = HexPlane(settings, torch.tensor([[-1.0] * 3, [1.0] * 3]), generator)
    for parameter in field.heads.parameters():
        torch.nn.init.normal_(parameter, std=0.1, generator=generator)
    space, time = field.space[0], field.time[0]
    readers = {
        "ours": fused_features,
        "grid_sample": naive_features,
        "grid_sample_once": features_with_space_once,
    }
    pull = torch.randn(TIMES, count, settings.features, generator=generator)
    pulls = [torch.randn(TIMES, count, outputs, generator=generator) for outputs in (3, 3, 4)]

    def features(read: Callable[..., Tensor]) -> None:
        torch.autograd.grad(read(means, times, space, time), [space, time], pull)

    def features_of_means(read: Callable[..., Tensor]) -> None:
        moving = means.clone().requires_grad_()
        torch.autograd.grad(read(moving, times, space, time), [moving, space, time], pull)

    def displaced(read: Callable[..., Tensor]) -> None:
        if read is fused_features:
            moved = field.displace(means, times)
            outputs = [moved.means, moved.log_scales, moved.quats]
        else:
            outputs = heads_one_by_one(field, read(means, times, space, time))
        torch.autograd.grad(outputs, list(field.parameters()), pulls)

    for suffix, whole in (("", features), ("_means", features_of_means), ("_heads", displaced)):
        taken = interleaved({name: partial(whole, read) for name, read in readers.items()}, rounds)
        ours = taken.pop("ours").cpu_ms
        for peer, measured in taken.items():
            yield Row(peer + suffix, count, None, TIMES, ours, measured.cpu_ms, measured.cpu_ms / ours)


def measure_ssim(size: int, rounds: int) -> Iterator[Row]:
    """Measure value and gradient of noisy colors over white, stored channels first as renders are."""
    generator = torch.Generator().manual_seed(0)
    ground_truth = functional.interpolate(
        torch.rand(PICTURES, 3, 9, 9, generator=generator), (size, size), mode="bilinear"
    )
    ground_truth[..., : size // 4] = 1
    images = (ground_truth + 0.05 * torch.randn(ground_truth.shape, generator=generator)).clamp(0, 1).requires_grad_()
    functions: dict[str, Callable[[], object]] = {
        "ours": lambda: torch.autograd.grad(ssim(images.movedim(1, -1), ground_truth.movedim(1, -1)).sum(), images),
        "conv2d": lambda: torch.autograd.grad(ssim_by_convolution(images, ground_truth).sum(), images),
    }
    taken = interleaved(functions, rounds)
    ours, peer = (taken[name].cpu_ms / PICTURES for name in functions)
    yield Row("conv2d", None, size, PICTURES, ours, peer, peer / ours)


def main() -> None:
    options = parser_of(__doc__, "small cases, few rounds").parse_args()
    paper, small = HexPlaneSettings(), HexPlaneSettings(features=16, hidden=32)
    counts, sizes, rounds = ((2_000,), (128,), 3) if options.quick else ((5_000, 20_000), (256, 512), 5)
    console, rows = new_console(), []
    for settings in (paper,) if options.quick else (paper, small):
        title = f"{machine()}; {settings.features} features, {settings.hidden} hidden units, {TIMES} timestamps"
        found = [row for count in counts for row in measure_deformation(count, settings, rounds)]
        console.print(table(title, found))
        rows += found if settings is paper else []  # rows do not contain the number of features
    found = [row for size in sizes for row in measure_ssim(size, rounds)]
    console.print(table(f"{machine()}; SSIM of a color picture", found))
    if options.json:
        write_rows(options.json, [*rows, *found])


def table(title: str, rows: list[Row]) -> Table:
    """Return the rows as a table."""
    result = Table(
        Column("peer", no_wrap=True), "Gaussians", "px", "ours, ms CPU", "peer, ms CPU", "ratio", title=title
    )
    for row in rows:
        count, size = ("-" if value is None else str(value) for value in (row.gaussians, row.size))
        times = (f"{row.ours_cpu_ms:.1f}", f"{row.peer_cpu_ms:.1f}", f"{row.cpu_ratio:.1f}")
        result.add_row(row.peer, count, size, *times)
    return result


if __name__ == "__main__":
    main()
