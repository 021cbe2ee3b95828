"""GPU memory of the large networks per item, against the plan of the micro-batches.

Run with `python -m benchmarks.memory` on a machine with a CUDA device, or as `python -m tests.emulation.gpu
benchmarks.memory` with an emulated one, which does not include the workspace of kernels (five minutes, 12 GB;
`--quick`: tiny networks; `--json FILE` keeps the rows). Networks of the published sizes, random weights, half precision
except SVD's encoder; images of 256 x 256. Columns:

`GiB`      peak, weights included
`each`     MiB per item
`planned`  MiB per item in the plan, which has to be larger
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from benchmarks.measure import machine, new_console, parser_of, write_rows  # before torch: how its threads wait

import torch  # isort: skip
from diffusers.utils import logging
from rich.table import Column, Table

from benchmarks.paper_schedule import FULL, Clock, Schedule, Sizes, reset_peak_memory, seeded
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.diffusion.latents import SIZE
from dg4d_lib.diffusion.video_model import DECODER_GB, ENCODER_GB, GIB, UNET_GB
from dg4d_lib.guidance.distillation import TimestepSchedule
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.guidance.zero123 import VIEW_GB
from dg4d_lib.input_settings import SvdSettings
from dg4d_lib.settings import Zero123PriorSettings
from steps.profiles import profile

FRAMES, VIEWS = 14, 4
MEGAPIXELS = SIZE * SIZE / 1e6


@dataclass(frozen=True)
class Row:
    """Measurement of some items; without a plan for the weights alone."""

    passage: str
    items: int
    peak_gib: float
    each_mib: float | None = None
    planned_mib: float | None = None


def rows(sizes: Sizes, device: torch.device) -> Iterator[Row]:
    """Measure both networks, weights first."""
    settings = profile("paper")
    schedule = Schedule(settings, sizes, device)
    prior_settings, driving = settings.prior, settings.driving
    assert isinstance(prior_settings, Zero123PriorSettings) and isinstance(driving, SvdSettings)

    model = schedule.zero123(prior_settings)
    prior = model.conditioned_on(torch.ones(1, SIZE, SIZE, 3), TimestepSchedule(settings.static.t_max_start))
    yield Row("Zero-1-to-3", 0, measure_peak(lambda: None)[1])
    pictures = torch.rand(VIEWS, SIZE, SIZE, 3, generator=seeded()).to(device).requires_grad_()
    views = [GuidanceView(OrbitCamera(azimuth_deg=90.0 * i), 0) for i in range(VIEWS)]
    yield row(
        "views, there and back",
        VIEWS,
        VIEW_GB[prior_settings.precision],
        lambda: differentiate_loss(prior, pictures, views),
    )
    del model, prior

    video_model = schedule.video_model(driving.model, Clock(device))
    yield Row("SVD", 0, measure_peak(lambda: None)[1])
    condition = video_model.encode_condition(torch.rand(SIZE, SIZE, 3, generator=seeded()), [seeded()])
    video = torch.rand(FRAMES, SIZE, SIZE, 3, generator=seeded()).to(device)
    encoder, decoder = 4 * ENCODER_GB, 2 * DECODER_GB  # GiB x bytes of the dtype; the encoder needs float32
    yield row("frames, encoded", FRAMES, encoder * MEGAPIXELS, lambda: video_model.encode(video))
    noise = video_model.sample_noise(video_model.latent_shape(1, FRAMES, SIZE, SIZE), [seeded()])
    half = 2 * UNET_GB * MEGAPIXELS * FRAMES
    yield row("videos, with and without the picture", 2, half, lambda: video_model.denoise(noise, condition, (9, 3)))
    yield row("frames, decoded", FRAMES, decoder * MEGAPIXELS, lambda: video_model.decode(noise[0]))


def differentiate_loss(prior: Any, pictures: torch.Tensor, views: list[GuidanceView]) -> None:
    """Compute the loss and its gradient."""
    prior.loss(pictures, pictures[..., :1].detach(), views, 0.5, seeded()).backward()


def row(passage: str, items: int, planned_gb: float, work: Callable[[], Any]) -> Row:
    """Measure items that are processed at once."""
    before, peak = measure_peak(work)
    return Row(passage, items, peak, (peak - before) / items * 1024, planned_gb * 1024)


def measure_peak(work: Callable[[], Any]) -> tuple[float, float]:
    """Return GiB before and at the peak."""
    reset_peak_memory()
    before = torch.cuda.max_memory_allocated() / GIB
    work()
    return before, torch.cuda.max_memory_allocated() / GIB


def main() -> None:
    parser = parser_of(__doc__, "tiny networks")
    options = parser.parse_args()
    if not torch.cuda.is_available():
        parser.error("there is no CUDA device here; python -m tests.emulation.gpu benchmarks.memory emulates one")
    logging.set_verbosity_error()  # casting networks is intended
    console = new_console()
    console.print(f"{torch.cuda.get_device_name()}; {machine()}; torch {torch.__version__}")
    found = list(rows(Sizes() if options.quick else FULL, torch.device("cuda")))
    console.print(table(found))
    if options.json:
        write_rows(options.json, found)


def table(rows: list[Row]) -> Table:
    """Return the rows as a table."""
    result = Table(Column("passage", no_wrap=True), "items", "GiB", "each", "planned")
    for row in rows:
        numbers = (row.each_mib, row.planned_mib)
        cells = ("-" if number is None else f"{number:.0f}" for number in numbers)
        result.add_row(row.passage, str(row.items or "-"), f"{row.peak_gib:.2f}", *cells)
    return result


if __name__ == "__main__":
    main()
