"""Speed of rendering on a GPU, forward and backward: our backend, bare calls of gsplat, and our CPU rasterizer.

Run with `python -m benchmarks.gpu_rasterizer` on a machine with a CUDA device (`--quick`: few cells; `--json FILE`
keeps the rows). All programs of a cell run interleaved in one process; times are milliseconds of a call, all views
together. The object is that of `benchmarks.rasterizer`; with `own states` every view has Gaussians of its own, as in
the dynamic stage. A bare call has its cameras on the GPU and checks nothing.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from itertools import product

from benchmarks.measure import interleaved, machine, new_console, parser_of, write_rows  # before torch

import torch  # isort: skip
from rich.table import Table

from benchmarks.peers import WHITE
from benchmarks.rasterizer import bumpy_ball, draw, draw_peer, ring
from dg4d_lib.cameras.orbit import OrbitCamera, intrinsics, viewmats
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.rasterizer.interface import BLUR, NEAR, get_rasterizer

COUNTS, SIZES, VIEWS = (5_000, 20_000, 100_000), (128, 256, 512), (1, 4, 14)
QUICK_COUNTS, QUICK_SIZES, QUICK_VIEWS = (5_000,), (128,), (1, 4)
ROUNDS, QUICK_ROUNDS = 20, 3


@dataclass(frozen=True)
class Row:
    """Times of one cell, milliseconds per call."""

    gaussians: int
    size: int
    views: int
    own_states: bool
    ours_ms: float
    gsplat_ms: float
    cpu_ms: float
    over_gsplat: float
    faster_than_cpu: float


def bare_gsplat(cloud: Gaussians, cameras: list[OrbitCamera]) -> Callable[[], tuple[torch.Tensor, torch.Tensor]]:
    """Return a call of gsplat that renders color with depth, and alpha, over white."""
    rasterization = import_module("gsplat").rasterization
    size, count = cameras[0].width, len(cameras)
    states = cloud.means.ndim == 3
    poses = viewmats(cameras).float().cuda()
    lenses = intrinsics(cameras).cuda()
    white = WHITE.cuda().expand(count, 3)
    if states:
        poses, lenses, white = poses[:, None], lenses[:, None], white[:, None]

    def render() -> tuple[torch.Tensor, torch.Tensor]:
        opacities, colors = cloud.opacities, cloud.colors
        if states:
            opacities, colors = opacities.expand(count, -1), colors.expand(count, -1, -1)
        pictures, alpha, _ = rasterization(
            cloud.means, cloud.quats, cloud.scales, opacities, colors, poses, lenses, size, size,
            near_plane=NEAR, eps2d=BLUR, backgrounds=white, render_mode="RGB+D", packed=False,
        )  # fmt: skip
        return pictures, alpha

    return render


def synchronized(work: Callable[[], object]) -> None:
    """Do some work and wait for the GPU."""
    work()
    torch.cuda.synchronize()


def on_gpu(cloud: Gaussians) -> Gaussians:
    """Return the parameters of a cloud as parameters on the GPU."""
    return Gaussians(**{name: value.detach().cuda().requires_grad_() for name, value in vars(cloud).items()})


def measure(gaussians: int, size: int, views: int, own_states: bool, rounds: int) -> Row:
    """Measure one cell."""
    here, cameras = bumpy_ball(gaussians, views if own_states else 0), ring(size, views)
    there = on_gpu(here)
    functions = {
        "ours": partial(draw, get_rasterizer("cuda_gsplat"), there, cameras),
        "gsplat": partial(draw_peer, bare_gsplat(there, cameras), there),
        "cpu": partial(draw, get_rasterizer("cpu"), here, cameras),
    }
    taken = interleaved({name: partial(synchronized, work) for name, work in functions.items()}, rounds)
    ours, gsplat, cpu = (taken[name].wall_ms for name in functions)
    return Row(gaussians, size, views, own_states, ours, gsplat, cpu, ours / gsplat, cpu / ours)


def main() -> None:
    parser = parser_of(__doc__, "few cells, few rounds")
    options = parser.parse_args()
    if not torch.cuda.is_available():
        parser.error("there is no CUDA device here")
    console = new_console()
    console.print(f"{torch.cuda.get_device_name()}; {machine()}; torch {torch.__version__}")
    counts, sizes, views = (QUICK_COUNTS, QUICK_SIZES, QUICK_VIEWS) if options.quick else (COUNTS, SIZES, VIEWS)
    rounds = QUICK_ROUNDS if options.quick else ROUNDS
    rows = [
        measure(count, size, n, states, rounds)
        for count, size, n in product(counts, sizes, views)
        for states in ((False, True) if n > 1 else (False,))
    ]
    table = Table("Gaussians", "size", "views", "own states", "ours ms", "gsplat ms", "CPU ms", "/ gsplat", "CPU /")
    for row in rows:
        times = (f"{value:.2f}" for value in (row.ours_ms, row.gsplat_ms, row.cpu_ms, row.over_gsplat))
        states = "yes" if row.own_states else ""
        table.add_row(f"{row.gaussians:,}", str(row.size), str(row.views), states, *times, f"{row.faster_than_cpu:.1f}")
    console.print(table)
    if options.json:
        write_rows(options.json, rows)


if __name__ == "__main__":
    main()
