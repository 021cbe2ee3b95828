"""Tracked mesh against a mesh per frame: surface distance and image quality.

Run with `python -m benchmarks.mesh_modes PACKAGE ...` on packages with a tracked mesh (seconds per frame; `--quick`:
two frames; `--json FILE` keeps the rows). The reference surface of a frame is extracted from its Gaussians as in the
mode `per_frame`: cleaned, unwrapped and baked. Distances to it are in thousandths of a world unit; its distance to
itself is the sampling error. Renders are compared with the splats of the frame over white: PSNR over the union of both
silhouettes, and IoU of the silhouettes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.measure import machine, new_console, parser_of, write_rows  # before torch: how its threads wait

import torch  # isort: skip
from rich.table import Column, Table
from torch import Tensor

from dg4d_lib.assets.animated import Asset4D, pose_gaussians
from dg4d_lib.assets.formats.compact import read_compact
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.images import color_over_white
from dg4d_lib.mesh.extraction.density import density_field
from dg4d_lib.mesh.extraction.extract import select_level
from dg4d_lib.mesh.render import render_mesh
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.metrics.image import iou, psnr
from dg4d_lib.metrics.surface import chamfer_distance, sample_surface
from dg4d_lib.rasterizer.interface import Rasterizer, get_rasterizer
from dg4d_lib.settings import MeshSettings
from steps.artifacts.package_files import COMPACT
from steps.artifacts.packages import read_manifest
from steps.artifacts.rendering import read_surface
from steps.extract_mesh import textured_mesh

AZIMUTHS_DEG = (0.0, 90.0)  # the input view and the right side
SIZE = 512  # pixels
POINTS = 50_000  # samples per surface
SETTINGS = MeshSettings(max_faces=20000)  # as the profile `preview`
PER_WORLD_UNIT = 1000
MODES = "tracked", "per_frame"
FIGURES = "chamfer", "input_psnr", "input_iou", "side_psnr", "side_iou"


@dataclass(frozen=True)
class Row:
    """Mode on one package, means over frames; distances in thousandths of a world unit, PSNR in dB."""

    package: str
    mode: str
    frames: int
    chamfer: float
    input_psnr: float
    input_iou: float
    side_psnr: float
    side_iou: float


def measure_package(folder: Path, count: int, rasterize: Rasterizer) -> list[Row]:
    asset = read_surface(folder, read_manifest(folder))
    if not isinstance(asset, Asset4D):
        raise SystemExit(f"{folder} has a mesh per frame; give a package of a tracked mesh")
    fit = read_compact(folder / COMPACT)
    gaussians, deformation, frames = fit.gaussians, fit.deformation, fit.frames
    first = pose_gaussians(gaussians, deformation, frames, torch.zeros(1)).at(0)
    level, _ = select_level(density_field(first, SETTINGS), first, rasterize, SETTINGS.density_threshold)
    selected = [i * frames // count for i in range(count)]
    states = pose_gaussians(gaussians, deformation, frames, torch.tensor(selected, dtype=torch.float32))
    rows = []
    for i, frame in enumerate(selected):
        extracted = textured_mesh(states.at(i), level, rasterize, SETTINGS)
        tracked = replace(asset.mesh, vertices=asset.mesh.vertices + asset.offsets[frame])
        ground_truth, generator = splats(states.at(i), rasterize), torch.Generator().manual_seed(frame)
        for mode, mesh in (("tracked", tracked), ("per_frame", extracted)):
            points = [sample_surface(each.vertices, each.faces, POINTS, generator) for each in (mesh, extracted)]
            apart = chamfer_distance(*points)
            rows.append(Row(folder.name, mode, 1, PER_WORLD_UNIT * apart, *compare_renders(mesh, ground_truth)))
    return [mean_row(folder.name, [row for row in rows if row.mode == mode]) for mode in MODES]


def cameras() -> list[OrbitCamera]:
    return [OrbitCamera(0.0, azimuth, width=SIZE, height=SIZE) for azimuth in AZIMUTHS_DEG]


def splats(state: Gaussians, rasterize: Rasterizer) -> tuple[Tensor, Tensor]:
    """Return color over white, and alpha."""
    with torch.no_grad():
        rendering = rasterize(state, cameras(), torch.ones(3))
    return rendering.color, rendering.alpha


def compare_renders(mesh: TexturedMesh, ground_truth: tuple[Tensor, Tensor]) -> list[float]:
    """Return PSNR and IoU in the first view, then in the second."""
    color, alpha = render_mesh(mesh, cameras())
    seen = ((alpha > 0.5) | (ground_truth[1] > 0.5)).float()
    pairs = torch.stack([psnr(color_over_white(color, alpha), ground_truth[0], seen), iou(alpha, ground_truth[1])], 1)
    return pairs.flatten().tolist()


def mean_row(package: str, rows: Sequence[Row]) -> Row:
    """Return the mean of rows with one mode."""
    means = [sum(getattr(row, name) for row in rows) / len(rows) for name in FIGURES]
    return Row(package, rows[0].mode, sum(row.frames for row in rows), *means)


def main() -> None:
    parser = parser_of(__doc__, "two frames per package")
    parser.add_argument("packages", type=Path, nargs="+", metavar="PACKAGE", help="folders written by `dg4d make`")
    parser.add_argument("--frames", type=int, default=4, help="frames per package, evenly spread")
    options = parser.parse_args()
    rasterize = get_rasterizer("auto")
    count = 2 if options.quick else options.frames
    rows = [row for folder in options.packages for row in measure_package(folder, count, rasterize)]
    means = [mean_row("mean", [row for row in rows if row.mode == mode]) for mode in MODES]
    new_console().print(table(f"{machine()}; {SIZE} px, {POINTS} points a surface", [*rows, *means]))
    if options.json:
        write_rows(options.json, rows)


def table(title: str, rows: list[Row]) -> Table:
    """Return the rows as a table."""
    heads = "frames", "chamfer", "input PSNR", "input IoU", "side PSNR", "side IoU"
    result = Table(Column("package", no_wrap=True), Column("mode", no_wrap=True), *heads, title=title)
    for row in rows:
        figures = f"{row.chamfer:.2f}", f"{row.input_psnr:.2f}", f"{row.input_iou:.3f}"
        side = f"{row.side_psnr:.2f}", f"{row.side_iou:.3f}"
        result.add_row(row.package, row.mode, str(row.frames), *figures, *side)
    return result


if __name__ == "__main__":
    main()
