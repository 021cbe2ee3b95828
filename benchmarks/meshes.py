"""Defects of packaged meshes, at rest and in every frame: crossings, flips, folds, creases, handles; and their atlas.

Run with `python -m benchmarks.meshes PACKAGE ...` (`--json FILE` keeps the rows of the first table). A mesh per frame
has no rest shape: its frames are counted one by one, and nothing is flipped. Of several packages, the last rows are the
means.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from benchmarks.measure import new_console, parser_of, write_rows

import numpy as np  # isort: skip
import torch
from rich.table import Table

from benchmarks.atlas_quality import AtlasQuality, atlas_quality
from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.assets.placement import Surface
from dg4d_lib.mesh.extraction.topology import join_seams
from dg4d_lib.mesh.folds import SurfaceDefects, genus, surface_defects
from steps.artifacts.packages import read_manifest
from steps.artifacts.rendering import mesh_at, read_surface

PERCENT, EDGES = 100, 1.5  # edges per triangle of a closed surface


@dataclass(frozen=True)
class Row:
    """Defects of the mesh of one package; shares in percent of the triangles or edges.

    Attributes:
        package: name of the folder.
        moment: "rest", "mean" of all frames, or "worst": of all frames, in each column.
        triangles: number of triangles.
        crossing: triangles that cross others.
        flipped: triangles that turned over.
        folds: edges above 120 degrees.
        creases: edges above 60 degrees.
        deviation_deg: root mean square angle between neighbors.
        genus: handles.
    """

    package: str
    moment: str
    triangles: float
    crossing: float
    flipped: float
    folds: float
    creases: float
    deviation_deg: float
    genus: float


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("packages", type=Path, nargs="+", help="folders of unpacked packages")
    options = parser.parse_args()
    rows = [row for folder in options.packages for row in measure(folder)]
    if len(options.packages) > 1:
        rows += [mean_row([row for row in rows if row.moment == moment]) for moment in ("mean", "worst")]
    console = new_console()
    console.print(table(rows))
    console.print(atlas_table({folder.name: measure_atlas(folder) for folder in options.packages}))
    if options.json:
        write_rows(options.json, rows)


def measure(folder: Path) -> Iterator[Row]:
    """Measure the mesh of a package at rest, if it has a rest shape, and in all frames."""
    manifest = read_manifest(folder)
    surface = read_surface(folder, manifest)
    if isinstance(surface, Asset4D):
        joined, faces = join_seams(surface.mesh.vertices.numpy(), surface.mesh.faces.numpy())
        rest = surface.mesh.vertices.numpy()[joined]
        yield _row(folder.name, "rest", [surface_defects(rest, faces)], [genus(faces)], max)
    frames = [_frame(surface, float(frame)) for frame in range(manifest.frames)]
    defects, handles = [list(column) for column in zip(*frames, strict=True)]
    yield _row(folder.name, "mean", defects, handles, np.mean)
    yield _row(folder.name, "worst", defects, handles, max)


def mean_row(rows: list[Row]) -> Row:
    """Return the means of the rows of several packages."""
    names = [field.name for field in fields(Row)][2:]
    means = {name: float(np.mean([getattr(row, name) for row in rows])) for name in names}
    return Row("mean", rows[0].moment, **means)


def table(rows: list[Row]) -> Table:
    """Return the rows as a table."""
    shown = Table(title="Defects of meshes, percent of triangles or edges")
    names = ("package", "moment", "triangles", "crossing", "flipped", "folds", "creases", "deviation", "genus")
    for name in names:
        shown.add_column(name, justify="left" if name in {"package", "moment"} else "right")
    for row in rows:
        shares = (f"{share:.3f}" for share in (row.crossing, row.flipped, row.folds, row.creases))
        rest = (f"{row.deviation_deg:.1f}", f"{row.genus:g}")
        shown.add_row(row.package, row.moment, f"{row.triangles:.0f}", *shares, *rest)
    return shown


def measure_atlas(folder: Path) -> AtlasQuality:
    """Measure texture coordinates and texture of a package, of the first frame if it has a mesh per frame."""
    surface = read_surface(folder, read_manifest(folder))
    return atlas_quality(surface.mesh if isinstance(surface, Asset4D) else surface[0])


def atlas_table(qualities: dict[str, AtlasQuality]) -> Table:
    """Return the qualities of atlases by package as a table."""
    shown = Table(title="Texture atlases")
    shown.add_column("package")
    for name in (
        "islands",
        "of < 10 triangles",
        "mirrored",
        "coverage",
        "density p99 / p1",
        "seams, mean",
        "seams, p95",
    ):
        shown.add_column(name, justify="right")
    for package, quality in qualities.items():
        shares = (f"{share:.1%}" for share in (quality.mirrored, quality.coverage))
        seams = (f"{difference:.2f} / 255" for difference in (quality.seam_mean, quality.seam_p95))
        counts = (str(quality.islands), str(quality.small_islands))
        shown.add_row(package, *counts, *shares, f"{quality.density_ratio:.2f}", *seams)
    return shown


def _frame(surface: Surface, position: float) -> tuple[SurfaceDefects, int]:
    mesh = mesh_at(surface, torch.tensor(position, dtype=torch.float64))
    rest = surface.mesh.vertices if isinstance(surface, Asset4D) else mesh.vertices
    joined, faces = join_seams(rest.numpy(), mesh.faces.numpy())
    return surface_defects(mesh.vertices.numpy()[joined], faces, rest.numpy()[joined]), genus(faces)


def _row(
    package: str,
    moment: str,
    found: list[SurfaceDefects],
    handles: list[int],
    reduce: Callable[[Sequence[float]], float],
) -> Row:
    def share(name: str, of: float) -> float:
        return float(reduce([getattr(defects, name) * PERCENT / (of * defects.faces) for defects in found]))

    return Row(
        package,
        moment,
        float(reduce([defects.faces for defects in found])),
        crossing=share("self_intersecting", 1),
        flipped=share("flipped", 1),
        folds=share("folds", EDGES),
        creases=share("creases", EDGES),
        deviation_deg=float(reduce([defects.normal_deviation_deg for defects in found])),
        genus=float(reduce(handles)),
    )


if __name__ == "__main__":
    main()
