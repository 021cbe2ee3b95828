"""File sizes and write times of an asset: 14 frames, 20,000 vertices, a texture of 1024 x 1024.

Run with `python -m benchmarks.assets` (a minute; `--quick`: a small asset, seconds; `--json FILE` keeps the rows). The
asset is synthetic: a ball with traveling waves, colored by noise at all scales, and splats on it that a HexPlane moves.
Rows without splats do not depend on them. `.4dgs`, a container of moving splats, is a peer; `pip install --target DIR
fourdgs` and `PYTHONPATH=DIR` add it; its input are the PLY files. Goals are sizes, and 5 seconds for one file of every
kind, written in parallel as by the step pack_asset.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.measure import interleaved, machine, new_console, parser_of, write_rows  # before torch

import torch  # isort: skip
from rich.table import Column, Table
from torch import Tensor
from torch.nn.functional import interpolate

from dg4d_lib.asset_settings import GltfSettings, PackSettings
from dg4d_lib.assets.animated import Asset4D, pose_gaussians
from dg4d_lib.assets.formats.compact import CompactAsset, write_compact
from dg4d_lib.assets.formats.glb import write_glb
from dg4d_lib.assets.formats.rigged import fit_asset_rig, write_rigged_glb
from dg4d_lib.assets.formats.splats import write_splat_glb_frames, write_splats, write_spz_frames
from dg4d_lib.assets.formats.usd import write_usdz
from dg4d_lib.assets.formats.web_splats import write_web_splats
from dg4d_lib.assets.rendering.preview import shown_points, write_preview, write_turntable
from dg4d_lib.assets.rendering.viewer_page import build_viewer_page
from dg4d_lib.assets.rendering.webp import write_webp
from dg4d_lib.deformation.factory import new_deformation
from dg4d_lib.deformation.hexplane import HexPlane
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.spherical_harmonics import rgb_to_sh
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.settings import HexPlaneSettings
from steps.pack_asset import WRITER_THREADS

FRAMES, FPS = 14, 12.0
MEGABYTE = 1e6
GLTF = {
    "default": GltfSettings(),
    "png": GltfSettings(image="png"),
    "webp": GltfSettings(image="webp"),
    "still normals": GltfSettings(moving_normals=False),
    "quantized": GltfSettings(quantized=True),
    "quantized, meshopt": GltfSettings(quantized=True, meshopt=True),
}
GOALS_MB = {"asset.glb, default": 8.0, "web splats": 0.4, "viewer page, empty": 1.0}  # goals (ours), with 5,000 splats
GOAL_S = 5.0  # goal (ours), on two cores
EVERY_KIND = (
    "asset.glb, default", "asset_rigged.glb", "viewer page, empty", "splats, PLY", "splats, SPZ", "web splats",
    "compact, exact", "asset.usdz, mesh and splats", "preview.mp4", "turntable.mp4", "preview.webp",
)  # fmt: skip

Write = Callable[[Path], object]  # argument: an empty folder


@dataclass(frozen=True)
class Row:
    """Result of one writer; `splats` is None if it does not depend on them."""

    writer: str
    splats: int | None
    megabytes: float
    cpu_s: float
    wall_s: float


def waving_ball(rows: int, texels: int) -> Asset4D:
    """Return a sphere by latitude and longitude with about `2 rows^2` vertices."""
    v, u = torch.meshgrid(torch.linspace(0, 1, rows + 1), torch.linspace(0, 1, 2 * rows + 1), indexing="ij")
    rest = on_ball(torch.stack([u, v], -1).reshape(-1, 2))
    index = torch.arange(len(rest)).reshape(u.shape)
    a, b, c, d = (part.flatten() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    upper, lower = torch.stack([a, c, b], -1), torch.stack([b, c, d], -1)
    faces = torch.cat([upper[2 * rows :], lower[: -2 * rows]])  # drops the degenerate ones at the poles
    mesh = TexturedMesh(rest, faces, torch.stack([u, v], -1).reshape(-1, 2), noise_picture(texels))
    times = torch.arange(FRAMES)[:, None, None] / FRAMES
    return Asset4D(mesh, 0.05 * torch.sin(2 * math.pi * (times + rest[:, [1, 2, 0]])), FPS)


def on_ball(places: Tensor) -> Tensor:
    """Return the world points of texture coordinates."""
    around, polar = 2 * math.pi * places[:, 0], math.pi * places[:, 1]
    return 0.7 * torch.stack([polar.sin() * around.sin(), polar.cos(), polar.sin() * around.cos()], -1)


def noise_picture(texels: int) -> Tensor:
    """Return colors with a contrast proportional to scale, as in natural images."""
    generator, picture = torch.Generator().manual_seed(0), torch.full((1, 3, texels, texels), 0.5)
    for octave in range(2, round(math.log2(texels)) + 1):
        octave_noise = torch.rand(1, 3, 2**octave, 2**octave, generator=generator) - 0.5
        picture = picture + 2.0 ** (1 - octave) * interpolate(octave_noise, (texels, texels), mode="bicubic")
    return picture[0].movedim(0, -1).clamp(0, 1)


def waving_splats(count: int) -> CompactAsset:
    """Return flat splats on the ball, and a HexPlane of the profile `preview` with waves in its planes."""
    generator = torch.Generator().manual_seed(0)
    places = torch.rand(count, 2, generator=generator)
    places[:, 1] = (1 - 2 * places[:, 1]).acos() / math.pi  # uniform on the ball
    means = on_ball(places)
    log_scales = (torch.tensor([0.03, 0.03, 0.01]) * (5_000 / count) ** 0.5).log().repeat(count, 1)
    log_scales = log_scales + 0.2 * torch.randn(count, 3, generator=generator)
    picture = noise_picture(256)
    colors = picture[(places[:, 1] * 255).long(), (places[:, 0] * 255).long()]
    cloud = Gaussians(
        means,
        log_scales,
        torch.randn(count, 4, generator=generator),
        3 + torch.randn(count, generator=generator),
        rgb_to_sh(colors),
    )
    settings = HexPlaneSettings(features=16, hidden=32)
    field = new_deformation(settings, torch.tensor([[-0.8] * 3, [0.8] * 3]), FRAMES, count, generator)
    assert isinstance(field, HexPlane)
    phases = 6 * torch.rand(2, 3, settings.features, 1, 1, generator=generator)
    steps, cells = (torch.linspace(0, 2 * math.pi, size) for size in (settings.temporal, settings.spatial))
    with torch.no_grad():
        for parameter in field.heads.parameters():
            parameter.normal_(std=0.04, generator=generator)
        field.space[0].copy_(1 + 0.3 * torch.sin(cells[:, None] + cells + phases[0]))
        field.time[0].copy_(1 + 0.3 * torch.sin(steps[:, None] + cells + phases[1]))
    return CompactAsset(cloud, field.requires_grad_(False), settings, FRAMES, FPS)


def mesh_writers(asset: Asset4D) -> Iterator[tuple[str, Write]]:
    for name, settings in GLTF.items():
        yield f"asset.glb, {name}", partial(_glb, asset, settings)
    yield "asset_rigged.glb", lambda folder: write_rig(folder / "a.glb", asset)
    yield "asset.usdz, mesh", lambda folder: write_usdz(folder / "a.usdz", asset, FPS)
    yield (
        "viewer page, empty",
        lambda folder: (folder / "a.html").write_text(build_viewer_page("", b"", None, None, None, {})),
    )


def _glb(asset: Asset4D, settings: GltfSettings, folder: Path) -> None:
    (folder / "a.glb").write_bytes(write_glb(asset, settings))


def splat_writers(asset: Asset4D, splats: CompactAsset, pack: PackSettings) -> Iterator[tuple[str, Write]]:
    cloud, field = splats.gaussians, splats.deformation
    states = pose_gaussians(cloud, field, FRAMES, torch.arange(float(FRAMES)))
    rasterizer, motion = get_rasterizer("auto"), (cloud, field, FRAMES, FPS)
    yield "splats, PLY", lambda folder: write_splats(folder, states)
    yield "splats, SPZ", lambda folder: write_spz_frames(folder, states)
    yield "splats, glTF", lambda folder: write_splat_glb_frames(folder, states)
    yield "web splats", lambda folder: (folder / "a.bin").write_bytes(write_web_splats(states, FPS))
    yield "compact, exact", lambda folder: write_compact(folder / "a.safetensors", splats)
    yield "asset.usdz, mesh and splats", lambda folder: write_usdz(folder / "a.usdz", asset, FPS, states)
    yield "asset.usdz, quantized", lambda folder: write_usdz(folder / "a.usdz", asset, FPS, states, half=True)
    yield (
        "preview.mp4",
        lambda folder: write_preview(folder / "a.mp4", *motion, rasterizer, pack, shown_points(cloud, field, FRAMES)),
    )
    yield "turntable.mp4", lambda folder: write_turntable(folder / "a.mp4", states.at(0), rasterizer, pack)
    yield (
        "preview.webp",
        lambda folder: write_webp(folder / "a.webp", *motion, rasterizer, pack, shown_points(cloud, field, FRAMES)),
    )


def write_rig(path: Path, asset: Asset4D) -> None:
    """Fit and write the rig of the asset."""
    rig, _ = fit_asset_rig(asset, PackSettings().rig_bones, max_error=1)
    assert rig is not None
    path.write_bytes(write_rigged_glb(asset, rig, GltfSettings()))


def fourdgs(folder: Path) -> Write:
    """Return the peer, for a folder of PLY files.

    Raises:
        ImportError: it is not installed.
    """
    library: Any = import_module("fourdgs")
    convert = import_module("fourdgs.convert").convert_ply_sequence
    return lambda out: library.write(str(out / "a.4dgs"), *convert(str(folder), fps=FPS))


def write_in_parallel(writers: Sequence[Write], folder: Path) -> None:
    """Run some writers at a time, as the step does."""
    with ThreadPoolExecutor(WRITER_THREADS) as lanes:
        places = [folder / str(number) for number in range(len(writers))]
        for place in places:
            place.mkdir(exist_ok=True)
        for written in [lanes.submit(write, place) for write, place in zip(writers, places, strict=True)]:
            written.result()


def measure_writers(writers: dict[str, Write], splats: int | None, rounds: int) -> list[Row]:
    """Measure every writer, each in a folder that it overwrites."""
    with TemporaryDirectory() as scratch:
        folders = {name: Path(scratch) / str(i) for i, name in enumerate(writers)}
        for folder in folders.values():
            folder.mkdir()
        taken = interleaved({name: partial(write, folders[name]) for name, write in writers.items()}, rounds)
        rows = []
        for name, times in taken.items():
            megabytes = sum(path.stat().st_size for path in folders[name].iterdir()) / MEGABYTE
            rows.append(Row(name, splats, megabytes, times.cpu_ms / 1e3, times.wall_ms / 1e3))
    return rows


def main() -> None:
    options = parser_of(__doc__, "a small asset, one round").parse_args()
    grid, texels, counts, rounds = (30, 256, (500,), 1) if options.quick else (100, 1024, (5_000, 20_000), 3)
    pack = PackSettings(preview_size=64) if options.quick else PackSettings()
    console, asset = new_console(), waving_ball(grid, texels)
    of_mesh = dict(mesh_writers(asset))
    of_splats = {count: dict(splat_writers(asset, waving_splats(count), pack)) for count in counts}
    rows = measure_writers(of_mesh, None, rounds)
    for count, writers in of_splats.items():
        with TemporaryDirectory() as scratch:
            writers["splats, PLY"](Path(scratch))
            try:
                writers["splats, .4dgs"] = fourdgs(Path(scratch))
            except ImportError as error:
                console.print(f"fourdgs is missing: {error}", markup=False, highlight=False)
            rows += measure_writers(writers, count, rounds)
    title = f"{machine()}; {FRAMES} frames, {len(asset.mesh.vertices)} vertices, {texels} x {texels} texels"
    console.print(table(title, rows))
    every_writer = of_mesh | of_splats[counts[0]]
    seconds = {row.writer: row.wall_s for row in rows if row.splats in (None, counts[0])}
    longest_first = sorted(EVERY_KIND, key=seconds.__getitem__, reverse=True)
    (whole,) = measure_writers(
        {"every kind": partial(write_in_parallel, [every_writer[name] for name in longest_first])}, None, rounds
    )
    console.print(
        f"one file of every kind, {counts[0]} splats: {sum(seconds[name] for name in EVERY_KIND):.2f} s one after the "
        f"other, {whole.wall_s:.2f} s {WRITER_THREADS} at a time; goal {GOAL_S:.0f} s"
    )
    if options.json:
        write_rows(options.json, rows)


def table(title: str, rows: list[Row]) -> Table:
    """Return the rows as a table."""
    result = Table(Column("writer", no_wrap=True), "splats", "MB", "goal, MB", "s CPU", "s wall", title=title)
    for row in rows:
        goal = str(GOALS_MB.get(row.writer, "")) if row.splats in (None, 5_000) else ""
        splats = "" if row.splats is None else str(row.splats)
        result.add_row(row.writer, splats, f"{row.megabytes:.2f}", goal, f"{row.cpu_s:.2f}", f"{row.wall_s:.2f}")
    return result


if __name__ == "__main__":
    main()
