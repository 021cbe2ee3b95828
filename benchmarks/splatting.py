"""How much faster the processor's rasterizer is than plain torch: CPU time per view, forward and backward.

Run with `python -m benchmarks.splatting` (half a minute). Both run in turn in one process, so that what else the
machine does weighs on both; the ratio is what to look at. Plain torch takes every pixel against every Gaussian, so its
time grows with the pixels: it is measured on a picture of a quarter of the width and height, and multiplied.
"""

import os
import time
from dataclasses import replace

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # torch's idle threads would count as CPU time

import torch
from rich.console import Console
from rich.table import Table

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.cameras.viewpoints import turntable
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.rasterizer.interface import Rasterizer, choose_rasterizer

CASES = ((5_000, 128), (5_000, 256), (20_000, 256))  # Gaussians, pixels
VIEWS, ROUNDS = 4, 5
REDUCTION = 4  # of the width and height of the picture that plain torch draws


def bumpy_ball(count: int) -> Gaussians:
    """Flat opaque Gaussians on a closed surface, as a fitted object has them."""
    generator = torch.Generator().manual_seed(0)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    means = direction * (0.6 + 0.1 * torch.sin(5 * direction).prod(-1, keepdim=True))
    spacing = (4 * torch.pi * 0.36 / count) ** 0.5
    scales = spacing * torch.tensor([0.8, 0.6, 0.2]) * torch.exp(0.35 * torch.randn(count, 3, generator=generator))
    cloud = Gaussians(
        means,
        scales.log(),
        torch.randn(count, 4, generator=generator),
        2 * torch.randn(count, generator=generator),
        torch.randn(count, 1, 3, generator=generator),
    )
    return Gaussians(**{name: value.requires_grad_() for name, value in vars(cloud).items()})


def cpu_seconds(rasterizer: Rasterizer, cloud: Gaussians, cameras: list[OrbitCamera]) -> float:
    """CPU time of a picture and its gradient."""
    start = time.process_time()
    picture = rasterizer(cloud, cameras, torch.ones(3))
    (picture.color.square().mean() + picture.alpha.mean()).backward()
    return (time.process_time() - start) / len(cameras)


def main() -> None:
    fast, plain = choose_rasterizer("cpu"), choose_rasterizer("reference")
    table = Table("Gaussians", "pixels", "cpu, ms per view", "reference, ms per view", "ratio")
    for count, size in CASES:
        cloud, cameras = bumpy_ball(count), turntable(VIEWS, OrbitCamera(12.0, width=size, height=size))
        small = replace(cameras[0], width=size // REDUCTION, height=size // REDUCTION)
        for rasterizer in (fast, plain):  # the first call compiles, or imports
            cpu_seconds(rasterizer, bumpy_ball(100), [small])
        times = [cpu_seconds(fast, cloud, cameras) for _ in range(ROUNDS)]
        plain_time = REDUCTION**2 * cpu_seconds(plain, cloud, [small])
        times += [cpu_seconds(fast, cloud, cameras) for _ in range(ROUNDS)]
        own_time = sorted(times)[ROUNDS]
        table.add_row(
            str(count), str(size), f"{own_time * 1e3:.2f}", f"{plain_time * 1e3:.0f}", f"{plain_time / own_time:.0f}"
        )
    Console().print(table)


if __name__ == "__main__":
    main()
