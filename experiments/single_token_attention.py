"""Cost of cross-attention to one token, with and without the shortcut of `diffusion/single_token_attention.py`.

Kept as evidence for the shortcut. Run with `python -m experiments.single_token_attention` (15 minutes, 8 GB; `--quick`:
tiny networks, seconds; `--json FILE` keeps the rows). U-Nets of the published sizes with random weights, float32, one
thread, no GPU. Columns:

`TFLOP`       per call, counted by `torch.utils.flop_counter` with attention, without computing anything
`launches`    operations per call other than views, approximately the kernel launches of a GPU
`s CPU`       per call, medians of interleaved calls; "-" if the rounds would take hours
`difference`  largest difference of outputs over their standard deviation: rounding
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from benchmarks.measure import interleaved, machine, new_console, parser_of, write_rows  # before torch

import torch  # isort: skip
from rich.table import Column, Table
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.paper_schedule import FULL, Sizes, svd_unet, zero123_unet
from dg4d_lib.diffusion.latents import LATENT_CHANNELS, LATENT_SIZE
from dg4d_lib.diffusion.single_token_attention import shorten_attention


@dataclass(frozen=True)
class Row:
    """Network with one input size; frames are per video of the batch."""

    network: str
    batch: int
    frames: int | None
    size: int
    tflop_before: float
    tflop: float
    launches_before: int
    launches: int
    cpu_s_before: float | None = None
    cpu_s: float | None = None
    difference: float | None = None


@dataclass(frozen=True)
class Case:
    """Inputs of a network; `size` is that of the latents."""

    batch: int
    size: int
    frames: int | None = None
    timed: bool = True

    @torch.no_grad()
    def call(self, unet: Any) -> Tensor:
        """Call the network on fixed noise and tokens, different for each item of the batch."""
        generator = torch.Generator().manual_seed(0)
        draw = partial(torch.randn, generator=generator)
        tokens = draw(self.batch, 1, unet.config.cross_attention_dim)
        if self.frames is None:
            latents = draw(self.batch, 2 * LATENT_CHANNELS, self.size, self.size)
            return unet(latents, torch.full((self.batch,), 500), tokens).sample
        latents = draw(self.batch, self.frames, 2 * LATENT_CHANNELS, self.size, self.size)
        return unet(latents, torch.tensor(0.5), tokens, draw(self.batch, 3)).sample


class Launches(TorchDispatchMode):
    """Counter of operations that compute something."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        view = func.is_view or func is torch.ops.aten._unsafe_view.default
        self.count += func.namespace == "aten" and not view
        return func(*args, **(kwargs or {}))


def rows(build: Callable[[], Any], cases: list[Case], rounds: int) -> Iterator[Row]:
    """Compare a network of diffusers with its shortcut, sharing the weights."""
    before = build().eval().requires_grad_(False)
    with torch.device("meta"):
        after = shorten_attention(build().eval().requires_grad_(False))
    after.load_state_dict(before.state_dict(), assign=True)
    with FakeTensorMode() as nothing:  # tensors without data
        drafts = build().eval(), shorten_attention(build().eval())
    for case in cases:
        (tflop_before, launches_before), (tflop, launches) = (cost(case, draft, nothing) for draft in drafts)
        row = Row(
            type(before).__name__, case.batch, case.frames, case.size, tflop_before, tflop, launches_before, launches
        )
        if case.timed:
            expected = case.call(before)
            difference = float((case.call(after) - expected).abs().max() / expected.std())
            times = interleaved({"before": partial(case.call, before), "after": partial(case.call, after)}, rounds)
            cpu_s_before, cpu_s = (times[name].cpu_ms / 1e3 for name in ("before", "after"))
            row = replace(row, cpu_s_before=cpu_s_before, cpu_s=cpu_s, difference=difference)
        yield row


def cost(case: Case, draft: Any, nothing: FakeTensorMode) -> tuple[float, int]:
    """Return TFLOP and launches of a call."""
    with nothing, Launches() as launches:
        case.call(draft)
    # the counter does not support fused attention on CPUs, but its matrix products
    with nothing, sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as flops:
        case.call(draft)
    return flops.get_total_flops() / 1e12, launches.count


def main() -> None:
    options = parser_of(__doc__, "tiny networks").parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    pictures = [Case(2, LATENT_SIZE), Case(4, LATENT_SIZE)]
    videos = [Case(2, 32, 4), Case(2, 16, 14), Case(2, 64, 14, timed=False)]
    if options.quick:
        pictures, videos = [Case(2, 16)], [Case(2, 16, 3), Case(2, 16, 14, timed=False)]
    sizes, rounds = (Sizes(), 3) if options.quick else (FULL, 7)
    console, found = new_console(), []
    console.print(f"{machine()}; torch {torch.__version__}, one thread; before / after")
    for build, cases in ((zero123_unet, pictures), (svd_unet, videos)):
        found += list(rows(partial(build, sizes), cases, rounds))
    console.print(table(found))
    if options.json:
        write_rows(options.json, found)


def table(rows: list[Row]) -> Table:
    """Return the rows as a table."""
    result = Table(
        Column("network", no_wrap=True),
        "batch",
        "frames",
        "latents",
        Column("TFLOP", no_wrap=True),
        "launches",
        "s CPU",
        "difference",
    )
    for row in rows:
        result.add_row(
            row.network,
            str(row.batch),
            "-" if row.frames is None else str(row.frames),
            str(row.size),
            side_by_side(row.tflop_before, row.tflop, ".3g"),
            side_by_side(row.launches_before, row.launches, ""),
            side_by_side(row.cpu_s_before, row.cpu_s, ".2f"),
            "-" if row.difference is None else f"{row.difference:.0e}",
        )
    return result


def side_by_side(before: float | None, after: float | None, form: str) -> str:
    """Return before, after and the change."""
    if before is None or after is None:
        return "-"
    return f"{before:{form}} / {after:{form}} ({after / before - 1:+.1%})"


if __name__ == "__main__":
    main()
