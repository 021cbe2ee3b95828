"""Duration of the paper's schedule with full-size networks of random weights, against the arithmetic lower bound.

Run with `python -m benchmarks.paper_schedule` on a machine with a CUDA device (`--json FILE` keeps the rows); nothing
is downloaded. `--quick` is a smoke test with tiny networks on any device; its times mean nothing. Columns:

`s`        seconds of the stage, including first calls, without loading
`TFLOP`    operations of all networks, by the FLOP counter of every run
`TFLOP/s`  operations per second
`floor s`  the planned operations at 790 TFLOP/s (bf16, one H100)
`/ floor`  seconds over that bound
`GiB`      peak GPU memory, weights included
`outside`  fraction of the time without networks: rendering, losses, optimizers
"""

import gc
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial, wraps
from typing import Any

from benchmarks.measure import machine, new_console, parser_of, write_rows  # before torch: how its threads wait

import torch  # isort: skip
from diffusers import (
    AutoencoderKL,
    AutoencoderKLTemporalDecoder,
    UNet2DConditionModel,
    UNetSpatioTemporalConditionModel,
)
from diffusers.utils import logging
from rich.table import Column, Table
from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

from dg4d_lib.diffusion.components import Placement, compute_dtype, frozen
from dg4d_lib.diffusion.flop_counter import attach_flop_counter, count_flops
from dg4d_lib.diffusion.latents import LATENT_CHANNELS
from dg4d_lib.diffusion.single_token_attention import shorten_attention
from dg4d_lib.diffusion.video_model import GIB, VideoModel
from dg4d_lib.fitting.motion import fit_motion
from dg4d_lib.fitting.static import fit_gaussians
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.initialize import blob
from dg4d_lib.guidance.distillation import TimestepSchedule
from dg4d_lib.guidance.interface import GuidancePrior
from dg4d_lib.guidance.zero123 import POSE_DIM, Zero123
from dg4d_lib.images import over_white
from dg4d_lib.input_settings import SvdSettings
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.rasterizer.interface import get_rasterizer, preferred_device
from dg4d_lib.refiner_settings import VideoToVideoSettings
from dg4d_lib.settings import BlobStartSettings, MotionSettings, Precision, StaticSettings, Zero123PriorSettings
from dg4d_lib.texture.refine import MeshClip, refine_textures
from dg4d_lib.texture.refiner import VideoToVideo
from dg4d_lib.video.driving import DrivingVideo
from dg4d_lib.video.svd import StableVideo
from steps.artifacts.motions import new_deformation
from steps.fit_gaussians import BLOB_RADIUS
from steps.profiles import PipelineSettings, profile, revise

FLOORS_S = {
    "video": 1.2,
    "static": 9.1,
    "dynamic": 12.8,
    "refinement": 21.7,
}  # planned TFLOP at 790 TFLOP/s; the video is 512 x 512
LADDER = [{"until": 1.0, "size": 32}]
QUICK = {
    "driving.frames": 2,
    "driving.height": 64,
    "driving.width": 64,
    "driving.model.num_inference_steps": 2,
    "static.iterations": 2,
    "static.views": 2,
    "static.start.points": 200,
    "static.reference_size": 32,
    "static.resolution_schedule": LADDER,
    "motion.iterations": 2,
    "motion.views": 1,
    "motion.reference_size": 32,
    "motion.resolution_schedule": LADDER,
    "mesh.texture_size": 64,
    "refiner.texture.iterations": 1,
    "refiner.texture.size": 64,
    "refiner.model.num_inference_steps": 4,
}


@dataclass(frozen=True)
class Clip:
    """Sizes of a CLIP image encoder."""

    width: int = 64
    layers: int = 2
    heads: int = 4
    embedding: int = 32


@dataclass(frozen=True)
class Sizes:
    """Sizes of the networks: channels of the first level of every U-Net and VAE, and the image encoders."""

    unet: int = 32
    vae: int = 32
    clip: Clip = Clip()  # Zero-1-to-3's: ViT-L/14
    eye: Clip = Clip()  # the video model's: ViT-H/14


FULL = Sizes(320, 128, Clip(1024, 24, 16, 768), Clip(1280, 32, 16, 1024))


@dataclass(frozen=True)
class Row:
    """Result of one stage; no memory without a GPU, no lower bound for tiny networks."""

    stage: str
    seconds: float
    tflop: float
    tflop_per_s: float
    floor_s: float | None
    over_floor: float | None
    peak_gib: float | None
    outside_networks: float


@dataclass
class Clock:
    """Accumulated time of networks."""

    device: torch.device
    seconds: float = 0.0

    def watch(self, owner: object, *methods: str) -> None:
        """Add the time within these methods."""
        for method in methods:
            object.__setattr__(owner, method, self._timed(getattr(owner, method)))  # some owners are frozen

    def now(self) -> float:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return time.perf_counter()

    def _timed(self, method: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(method)
        def timed(*positional: Any, **named: Any) -> Any:
            start = self.now()
            made = method(*positional, **named)
            self.seconds += self.now() - start
            return made

        return timed


@dataclass(frozen=True)
class Schedule:
    """Settings of the paper, and networks of a size.

    Attributes:
        settings: of the whole pipeline.
        sizes: of the networks.
        device: of the networks.
    """

    settings: PipelineSettings
    sizes: Sizes
    device: torch.device

    def rows(self) -> Iterator[Row]:
        """Run all stages in order, each on the result of the one before."""
        subject, clock = disc(self.settings.subject.size), Clock(self.device)
        driving, refiner, prior_settings = self.settings.driving, self.settings.refiner, self.settings.prior
        assert isinstance(driving, SvdSettings) and isinstance(refiner, VideoToVideoSettings)
        assert isinstance(prior_settings, Zero123PriorSettings)
        motion = self.video_model(driving.model, clock)
        maker = StableVideo(driving, motion)
        row, (video,) = self.measured("video", clock, lambda: maker.generate_all(subject, [seeded()]))
        yield row
        del motion, maker
        prior = self.zero123(prior_settings)
        row, gaussians = self.measured("static", clock, lambda: self.fit(prior, subject, clock))
        yield row
        row, _ = self.measured("dynamic", clock, lambda: self.fit_motion(prior, gaussians, video, clock))
        yield row
        del prior
        textures = self.video_model(refiner.model, clock)
        yield self.measured("refinement", clock, lambda: self.refine(refiner, textures, video))[0]

    def measured(self, stage: str, clock: Clock, work: Callable[[], Any]) -> tuple[Row, Any]:
        on_gpu = self.device.type == "cuda"
        if on_gpu:
            reset_peak_memory()
        clock.seconds, start = 0.0, clock.now()
        with count_flops() as flops:
            made = work()
        seconds, floor = clock.now() - start, FLOORS_S[stage] if self.sizes == FULL else None
        row = Row(
            stage=stage,
            seconds=seconds,
            tflop=sum(flops.values()) / 1e12,
            tflop_per_s=sum(flops.values()) / 1e12 / seconds,
            floor_s=floor,
            over_floor=seconds / floor if floor else None,
            peak_gib=torch.cuda.max_memory_allocated(self.device) / GIB if on_gpu else None,
            outside_networks=1 - clock.seconds / seconds,
        )
        return row, made

    def fit(self, model: Zero123, subject: torch.Tensor, clock: Clock) -> Gaussians:
        static = self.settings.static
        assert isinstance(static.start, BlobStartSettings)
        start = blob(static.start.points, BLOB_RADIUS, seeded()).to(preferred_device("auto"))
        prior = load_prior(model, subject[None], static, clock)
        return fit_gaussians(start, subject, prior, get_rasterizer("auto"), static, seeded())

    def fit_motion(self, model: Zero123, gaussians: Gaussians, video: DrivingVideo, clock: Clock) -> None:
        dynamic = self.settings.motion
        deformation = new_deformation(
            self.settings.deformation, gaussians.to(torch.device("cpu")), len(video), seeded()
        )
        deformation.to(gaussians.means.device)
        prior = load_prior(model, torch.cat([video.frames, video.alpha], -1), dynamic, clock)
        fit_motion(gaussians, deformation, video, prior, get_rasterizer("auto"), dynamic, seeded())

    def refine(self, settings: VideoToVideoSettings, model: VideoModel, video: DrivingVideo) -> None:
        there = DrivingVideo(video.frames.to(self.device), video.alpha.to(self.device), video.fps)
        refiner = VideoToVideo(settings, model, there.over(there.frames.new_ones(3))[0])
        mesh = ball(self.settings.mesh.texture_size, self.device)
        clips = [MeshClip(mesh, torch.zeros_like(mesh.vertices)[None])] * len(video)
        refine_textures(clips, there, refiner, settings.texture, seeded())

    def zero123(self, settings: Zero123PriorSettings) -> Zero123:
        sizes = self.sizes
        tokens = sizes.clip.embedding
        make = partial(self.network, settings.precision, channels_last=self.device.type == "cuda")
        return Zero123(
            vae=make(lambda: AutoencoderKL(up_block_types=("UpDecoderBlock2D",) * 4, **vae(sizes))),
            unet=shorten_attention(make(lambda: zero123_unet(sizes))),
            image_encoder=make(lambda: image_encoder(sizes.clip)),
            camera_projection=make(lambda: torch.nn.Linear(tokens + POSE_DIM, tokens)),
            settings=settings,
        )

    def video_model(self, settings: Any, clock: Clock) -> VideoModel:
        make, sizes = partial(self.network, settings.precision), self.sizes
        unet = shorten_attention(make(lambda: svd_unet(sizes)))
        decoder = make(lambda: AutoencoderKLTemporalDecoder(**vae(sizes)))
        model = VideoModel(unet, decoder, make(lambda: image_encoder(sizes.eye)), settings, self.device)
        clock.watch(model, "encode_condition", "encode", "decode", "denoise")
        return model

    def network(self, precision: Precision, build: Callable[[], Any], channels_last: bool = False) -> Any:
        placement = Placement(self.device, compute_dtype(self.device, precision), channels_last)
        with self.device:
            return attach_flop_counter(frozen(build().to(placement.dtype), placement))


def reset_peak_memory() -> None:
    """Reset the peak of the GPU memory to the current use."""
    gc.collect()  # flop counters and hooks form reference cycles
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()


def load_prior(
    model: Zero123, cutouts: torch.Tensor, stage: StaticSettings | MotionSettings, clock: Clock
) -> GuidancePrior:
    """Return the prior conditioned on some frames, with timed methods."""
    clock.watch(
        prior := model.conditioned_on(over_white(cutouts), TimestepSchedule(stage.t_max_start, stage.t_max_end)), "loss"
    )
    return prior


def zero123_unet(sizes: Sizes) -> UNet2DConditionModel:
    """Return the U-Net of Zero-1-to-3."""
    return UNet2DConditionModel(
        in_channels=2 * LATENT_CHANNELS,
        block_out_channels=levels(sizes.unet),
        cross_attention_dim=sizes.clip.embedding,
    )


def svd_unet(sizes: Sizes) -> UNetSpatioTemporalConditionModel:
    """Return the U-Net of Stable Video Diffusion."""
    return UNetSpatioTemporalConditionModel(
        block_out_channels=levels(sizes.unet),
        num_attention_heads=tuple(max(1, channels // 64) for channels in levels(sizes.unet)),
        cross_attention_dim=sizes.eye.embedding,
        num_frames=14,
    )


def levels(width: int) -> tuple[int, ...]:
    return (width, 2 * width, 4 * width, 4 * width)


def vae(sizes: Sizes) -> dict[str, Any]:
    return {
        "block_out_channels": levels(sizes.vae),
        "down_block_types": ("DownEncoderBlock2D",) * 4,
        "layers_per_block": 2,
        "latent_channels": LATENT_CHANNELS,
    }


def image_encoder(sizes: Clip) -> CLIPVisionModelWithProjection:
    config = CLIPVisionConfig(
        hidden_size=sizes.width,
        intermediate_size=4 * sizes.width,
        num_hidden_layers=sizes.layers,
        num_attention_heads=sizes.heads,
        projection_dim=sizes.embedding,
        image_size=224,
        patch_size=14,
    )
    return CLIPVisionModelWithProjection(config)


def seeded() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def disc(size: int) -> torch.Tensor:
    """Return a cut-out of a colored disc."""
    rows, columns = torch.meshgrid(*[torch.linspace(-1, 1, size)] * 2, indexing="ij")
    inside = (rows.square() + columns.square() < 0.36).float()
    return torch.stack([(rows + 1) / 2, (columns + 1) / 2, 0.4 * inside, inside], -1)


def ball(texture: int, device: torch.device) -> TexturedMesh:
    """Return a gray sphere with about as many triangles as an extracted mesh."""
    rows, columns = 100, 200
    down, around = torch.linspace(0, 1, rows), torch.linspace(0, 1, columns)
    v, u = (place.flatten() for place in torch.meshgrid(down, around, indexing="ij"))
    polar, azimuth = torch.pi * v, 2 * torch.pi * u
    vertices = torch.stack([polar.sin() * azimuth.sin(), polar.cos(), polar.sin() * azimuth.cos()], -1)
    corner = (torch.arange(rows - 1)[:, None] * columns + torch.arange(columns - 1)).flatten()
    below = corner + columns
    faces = torch.cat([torch.stack([corner, below, below + 1], -1), torch.stack([corner, below + 1, corner + 1], -1)])
    gray = torch.full((texture, texture, 3), 0.5)
    return TexturedMesh(*(value.to(device) for value in (0.5 * vertices, faces, torch.stack([u, v], -1), gray)))


def main() -> None:
    parser = parser_of(__doc__, "tiny networks, small numbers, any device")
    options = parser.parse_args()
    found = torch.cuda.is_available()
    if not found and not options.quick:
        parser.error("there is no CUDA device here; --quick runs tiny networks without one")
    device = torch.device("cuda" if found else "cpu")
    console = new_console()
    name = machine()
    settings = revise(profile("paper"), QUICK if options.quick else {})
    if found:
        about = torch.cuda.get_device_properties(device)
        settings = revise(settings, {"prior.memory_gb": max(6, about.total_memory // GIB)})
        name = f"{about.name}, {about.total_memory / GIB:.0f} GiB"
    logging.set_verbosity_error()  # casting networks is intended
    console.print(
        f"{name}; torch {torch.__version__}; {'tiny' if options.quick else 'full-size'} networks, random weights"
    )
    rows = []
    for row in Schedule(settings, Sizes() if options.quick else FULL, device).rows():
        console.print(f"{row.stage}: {row.seconds:.1f} s")
        rows.append(row)
    console.print(table(rows))
    if options.json:
        write_rows(options.json, rows)


def table(rows: list[Row]) -> Table:
    """Return the rows as a table."""
    result = Table(Column("stage", no_wrap=True), "s", "TFLOP", "TFLOP/s", "floor s", "/ floor", "GiB", "outside")
    for row in rows:
        limits = (row.floor_s, row.over_floor, row.peak_gib)
        result.add_row(
            row.stage,
            f"{row.seconds:.1f}",
            f"{row.tflop:,.4g}",
            f"{row.tflop_per_s:,.3g}",
            *("-" if value is None else f"{value:.1f}" for value in limits),
            f"{row.outside_networks:.0%}",
        )
    return result


if __name__ == "__main__":
    main()
