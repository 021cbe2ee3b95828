"""Speed of the CPU rasterizer, forward and backward: against other programs, per phase, and against peak FLOP/s.

Run with `python -m benchmarks.rasterizer` (minutes; `--quick`: less than one; `--json FILE` keeps the rows). All
programs of a cell run interleaved in one process; times are CPU time per view. Peers:

`gsplat_torch`  gsplat's plain torch code (`benchmarks/peers.py`), if gsplat is installed; measured on one view, because
                it renders views one after the other
`reference`     our reference in plain torch, every pixel against every Gaussian; measured on one view of 16 x 16
                pixels, and scaled by the ratio of the areas

The object is a bumpy closed surface of flat Gaussians that fills 65 % of the image.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from itertools import product
from typing import no_type_check

from benchmarks.measure import Times, interleaved, machine, new_console, parser_of, write_rows  # before torch

import numpy as np  # isort: skip
import torch
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from rich.table import Table
from torch import Tensor

from benchmarks.peers import WHITE, blended_pairs, gsplat_torch
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.cameras.viewpoints import turntable
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.spherical_harmonics import rgb_to_sh
from dg4d_lib.kernels.compiling import njit
from dg4d_lib.kernels.simd import LANES, LONG, SimdBuilder
from dg4d_lib.kernels.workers import Scratch
from dg4d_lib.rasterizer.cpu import pack_camera
from dg4d_lib.rasterizer.cpu_bins import TILE, bin_by_tile
from dg4d_lib.rasterizer.cpu_blend import PLANE
from dg4d_lib.rasterizer.cpu_project import RECORD, WHITEN_A, WHITEN_B, WHITEN_C, project, unproject
from dg4d_lib.rasterizer.cpu_tiles import add_duplicates, assign_rows, blend, blend_backward
from dg4d_lib.rasterizer.interface import Rasterizer, get_rasterizer

COUNTS, SIZES, VIEWS = (5_000, 20_000, 100_000), (128, 256, 512), (1, 16, 56)
QUICK_COUNTS, QUICK_SIZES, QUICK_VIEWS = (5_000, 20_000), (128, 256), (1, 16)
ROUNDS, QUICK_ROUNDS = 5, 3
PEERS = ("gsplat_torch", "reference")
RADIUS = 0.74  # world units; fills 65 % of the image
OWN_STATES = "own states"  # one state per view, as in the dynamic stage
SMALL = 16  # pixels per side of the images of plain torch
PHASES = ("project", "bin", "blend", "blend backward", "unproject")
FLOPS_PER_PAIR = 93  # counted: 33 forward, 60 backward, including 11 each for the exponential; a multiply-add is two


@dataclass(frozen=True)
class Row:
    """Comparison with a peer."""

    peer: str
    gaussians: int
    size: int
    views: int
    ours_cpu_ms: float
    peer_cpu_ms: float
    cpu_ratio: float


def bumpy_ball(count: int, states: int = 0) -> Gaussians:
    """Return flat Gaussians on a closed surface, similar to a fitted object, in `states` poses."""
    generator = torch.Generator().manual_seed(0)
    normal = partial(torch.randn, generator=generator)
    direction = torch.nn.functional.normalize(normal(count, 3), dim=-1)
    means = RADIUS * direction * (1 + 0.1 * torch.sin(5 * direction).prod(-1, keepdim=True))
    spacing = 0.73 * (4 * torch.pi * RADIUS**2 / count) ** 0.5  # mean distance to the three nearest neighbors
    scales = spacing * torch.tensor([1, 0.67, 0.25]) * torch.exp(0.35 * normal(count, 3))
    x, y, z = (direction + 0.15 * normal(count, 3)).unbind(-1)  # roughly outward normals
    turn = torch.stack(
        ((x * x + y * y + z * z).sqrt() + z, -y, x, torch.zeros(count)), -1
    )  # rotation from +z to the normal
    opacities = 0.1 + 0.89 * torch.rand(count, generator=generator)
    colors = 0.5 + 0.4 * torch.sin(9 * means + torch.tensor([0.0, 1.0, 2.0]))
    fields = {"means": means, "log_scales": scales.log(), "quats": turn}
    if states:
        phase = torch.linspace(0, 6, states)[:, None, None]
        fields = {name: value + 0.05 * torch.sin(phase + 4 * value) for name, value in fields.items()}
    cloud = Gaussians(**fields, opacity_logits=opacities.logit(), harmonics=rgb_to_sh(colors))
    return Gaussians(**{name: value.requires_grad_() for name, value in vars(cloud).items()})


def ring(size: int, views: int) -> list[OrbitCamera]:
    """Return cameras around the object."""
    return turntable(views, OrbitCamera(12.0, width=size, height=size))


def draw(rasterizer: Rasterizer, cloud: Gaussians, cameras: Sequence[OrbitCamera], times: int = 1) -> None:
    """Render, and compute the gradients of all parameters."""
    for _ in range(times):
        picture = rasterizer(cloud, cameras, WHITE)
        _backward(cloud, (picture.color, picture.alpha, picture.depth))


def draw_peer(render: Callable[[], tuple[Tensor, Tensor]], cloud: Gaussians) -> None:
    """Render with a peer, and compute the gradients."""
    _backward(cloud, render())


def _backward(cloud: Gaussians, pictures: Sequence[Tensor]) -> None:
    torch.autograd.grad(pictures, list(vars(cloud).values()), [torch.ones_like(picture) for picture in pictures])


def measure_cell(count: int, size: int, views: Sequence[int], rounds: int) -> tuple[dict[str, Times], list[str]]:
    """Return the times per view of all programs at one number of Gaussians and size, and the missing peers."""
    fast, plain = get_rasterizer("cpu"), get_rasterizer("reference")
    cloud, several, missing = bumpy_ball(count), views[1], []
    functions: dict[str, Callable[[], object]] = {}
    views_rendered: dict[str, float] = {}
    for n in views:  # few views are repeated, so that a call takes long enough to measure
        times = max(1, several // n)
        functions[str(n)] = partial(draw, fast, cloud, ring(size, n), times)
        views_rendered[str(n)] = n * times
    functions[OWN_STATES] = partial(draw, fast, bumpy_ball(count, several), ring(size, several))
    views_rendered[OWN_STATES] = several
    try:
        functions["gsplat_torch"] = partial(draw_peer, gsplat_torch(cloud, ring(size, 1)[0]), cloud)
    except ImportError:
        missing.append("gsplat_torch (pip install --no-deps gsplat==1.5.3)")
    small = replace(ring(size, 1)[0], width=SMALL, height=SMALL)
    functions["reference"] = partial(draw, plain, cloud, [small])
    views_rendered["reference"] = (SMALL / size) ** 2
    taken = interleaved(functions, rounds)
    return {name: times.per(views_rendered.get(name, 1)) for name, times in taken.items()}, missing


def comparison_rows(count: int, size: int, views: Sequence[int], taken: dict[str, Times]) -> Iterator[Row]:
    """Compare every peer at every number of views."""
    for peer in PEERS:
        if peer in taken:
            for n in views:
                ours, theirs = taken[str(n)].cpu_ms, taken[peer].cpu_ms
                yield Row(peer, count, size, n, ours, theirs, theirs / ours)


def phases(count: int, size: int, rounds: int) -> tuple[dict[str, float], float]:
    """Return the milliseconds of every phase of one view on one thread (minimum), and its millions of pairs."""
    cloud, camera = bumpy_ball(count), ring(size, 1)[0]
    state = [value.detach().numpy() for value in (cloud.means, cloud.quats, cloud.log_scales.exp())]
    coefficients = cloud.harmonics.detach()[:, 0].numpy()
    log_opacities = torch.nn.functional.logsigmoid(cloud.opacity_logits.detach()).numpy()
    lens = pack_camera(camera)
    across = -(-size // TILE)
    records, keys = np.empty((count, RECORD), np.float32), np.empty(count, np.float32)
    gradients = [np.zeros_like(value) for value in state]
    more = [np.zeros(shape, np.float32) for shape in ((count,), (count, 3), (count, 2))]
    planes = [np.empty(shape, np.float32) for shape in ((3, size, size), (size, size), (size, size))]
    kept = (
        np.empty((size, size), np.float32),
        np.empty((across * across, PLANE), np.float32),
        np.empty(across * across, np.bool_),
    )
    white, least = WHITE.numpy(), dict.fromkeys(PHASES, np.inf)
    for _ in range(rounds):
        scratch = Scratch()
        marks = [time.thread_time()]
        project(*state, log_opacities, coefficients, lens, size, size, records, keys, 0, count)
        marks.append(time.thread_time())
        offsets, entries = bin_by_tile(records, keys, across, across, scratch)
        marks.append(time.thread_time())
        blend(records, offsets, entries, white, *planes, *kept, 0, across * across)
        marks.append(time.thread_time())
        slots = scratch.empty(entries.shape, np.uint32)
        grad_records = scratch.empty((assign_rows(entries, count, slots), RECORD))
        blend_backward(records, offsets, entries, white, *planes, *kept, slots, grad_records, 0, across * across)
        add_duplicates(entries, slots, count, grad_records)
        marks.append(time.thread_time())
        unproject(*state, coefficients, lens, keys, grad_records, *gradients, *more, 0, count)
        marks.append(time.thread_time())
        taken = zip(PHASES, marks[:-1], marks[1:], strict=True)
        least = {name: min(least[name], (after - before) * 1e3) for name, before, after in taken}
    a, b, c = (records[:, field] for field in (WHITEN_A, WHITEN_B, WHITEN_C))
    conics = 2 * np.float32(np.log(2)) * np.stack((a * a, a * b, b * b + c * c), -1)
    pixels, _ = blended_pairs(records[:, :2], keys, conics, np.exp(log_opacities), size, size)
    return least, len(pixels) / 1e6


def peak_gflops() -> float:
    """Return the peak rate of vector fused multiply-adds of one core, 2 flops per lane."""
    turns = 1_000_000
    least = np.inf
    for _ in range(10):
        start = time.thread_time()
        _multiply_add(turns)
        least = min(least, time.thread_time() - start)
    return 2 * LANES * _CHAINS * turns / least / 1e9


_CHAINS = 12  # independent chains: more than latency times throughput of multiply-adds on any CPU


@intrinsic
@no_type_check
def _chains(typing_context, turns):
    """Compute twelve independent chains of multiply-adds; return a number that depends on all."""

    def generate(context, builder, signature, arguments):
        e = SimdBuilder(builder)
        # all sums end near 1, because denormal numbers are slow on some CPUs
        factor, term = e.constant(0.999), e.constant([1e-3 * (1 + lane / LANES) for lane in range(LANES)])
        start = [e.constant(chain) for chain in range(_CHAINS)]
        ends = e.loop(ir.Constant(LONG, 0), arguments[0], start, lambda _, sums: [e.fma(x, factor, term) for x in sums])
        return e.sum(reduce(e.add, ends))

    return types.float32(types.int64), generate


@njit(nogil=True)
def _multiply_add(turns: int) -> float:
    return _chains(turns)


def compare(counts: Sequence[int], sizes: Sequence[int], views: Sequence[int], rounds: int) -> tuple[Table, list[Row]]:
    """Return all times and the rows of the file."""
    several = str(views[1])
    rows: list[Row] = []
    ours = [*(str(n) for n in views), OWN_STATES]
    headings = [*(f"V={name}" for name in ours), f"wall, V={several}", "one", "own"]
    table = Table("Gaussians", "pixels", *headings, *PEERS)
    for count, size in product(counts, sizes):
        taken, missing = measure_cell(count, size, views, rounds)
        rows += comparison_rows(count, size, views, taken)
        own = [f"{taken[name].cpu_ms:.2f}" for name in ours] + [f"{taken[several].wall_ms:.2f}"]
        ratios = [f"{taken[name].cpu_ms / taken[several].cpu_ms:.2f}" for name in (str(views[0]), OWN_STATES)]
        peers = [
            f"{taken[p].cpu_ms:.0f} ({taken[p].cpu_ms / taken[several].cpu_ms:.0f}x)" if p in taken else ""
            for p in PEERS
        ]
        table.add_row(str(count), str(size), *own, *ratios, *peers)
    table.title = f"Milliseconds per view, forward and backward; own states and ratios are of V={several}"
    table.caption = f"one, own: V={views[0]} and own states over V={several}" + "".join(f"; no {m}" for m in missing)
    return table, rows


def phase_table(counts: Sequence[int], sizes: Sequence[int], rounds: int) -> Table:
    """Return the phases of one view, and the time of the blended pairs at the machine's peak."""
    peak = peak_gflops()
    table = Table("Gaussians", "pixels", *PHASES, "M pairs", "limit", "over it")
    for count, size in product(counts, sizes):
        least, pairs = phases(count, size, rounds)
        total, limit = sum(least.values()), pairs * FLOPS_PER_PAIR / peak
        numbers = (f"{value:.2f}" for value in (*least.values(), pairs, limit))
        table.add_row(str(count), str(size), *numbers, f"{total / limit:.1f}x")
    table.title = "Milliseconds of one thread for one view"
    table.caption = f"limit: {FLOPS_PER_PAIR} flops per pair at {peak:.0f} GFLOP/s, the measured peak of one core"
    return table


def main() -> None:
    given = parser_of(__doc__, "fewer cells and rounds").parse_args()
    counts, sizes, views, rounds = (
        (QUICK_COUNTS, QUICK_SIZES, QUICK_VIEWS, QUICK_ROUNDS) if given.quick else (COUNTS, SIZES, VIEWS, ROUNDS)
    )
    console = new_console()
    console.print(f"{machine()}, {torch.get_num_threads()} threads")
    table, rows = compare(counts, sizes, views, rounds)
    console.print(table, phase_table(counts, sizes, 5 * rounds))
    if given.json:
        write_rows(given.json, rows)


if __name__ == "__main__":
    main()
