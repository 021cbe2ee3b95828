"""Quality of a texture atlas: islands, mirrored triangles, coverage, texel density and seams."""

from dataclasses import dataclass

import numpy as np

from dg4d_lib.mesh.extraction.topology import face_components
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh.texturing.seams import seam_differences, seam_points

SMALL = 10  # triangles; smaller islands waste space and show as specks
LEVELS = 255


@dataclass(frozen=True)
class AtlasQuality:
    """Quality of the texture coordinates and the texture of a mesh.

    Attributes:
        islands: connected parts of the texture coordinates.
        small_islands: islands of fewer than ten triangles.
        mirrored: share of the triangles that the texture shows mirrored.
        coverage: share of the texture that triangles cover.
        density_ratio: texels per length on the surface, its 99th over its 1st percentile by area.
        seam_mean: mean difference of the colors on both sides of a seam, of 255.
        seam_p95: 95th percentile of the largest difference of a channel, of 255.
    """

    islands: int
    small_islands: int
    mirrored: float
    coverage: float
    density_ratio: float
    seam_mean: float
    seam_p95: float


def atlas_quality(mesh: TexturedMesh) -> AtlasQuality:
    """Measure the atlas of a mesh."""
    vertices, faces = mesh.vertices.double().cpu().numpy(), mesh.faces.cpu().numpy()
    sides = np.diff(mesh.uvs.double().cpu().numpy()[faces], axis=1)
    turns = sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]  # negative: as seen from outside
    flat = np.abs(turns) / 2
    edges = np.diff(vertices[faces], axis=1)
    areas = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2
    shown = areas > 0
    densities, weights = np.sqrt(flat[shown] / areas[shown]), areas[shown]
    order = np.argsort(densities)
    below = np.cumsum(weights[order]) / weights.sum()
    low, high = densities[order][np.searchsorted(below, (0.01, 0.99)).clip(max=len(order) - 1)]
    sizes = np.bincount(face_components(len(vertices), faces))
    points = seam_points(mesh.vertices, mesh.faces, mesh.uvs, max(mesh.texture.shape[:2]))
    differences = seam_differences(mesh.texture, points) * LEVELS
    return AtlasQuality(
        islands=len(sizes),
        small_islands=int((sizes < SMALL).sum()),
        mirrored=float((turns > 0).mean()),
        coverage=float(flat.sum()),
        density_ratio=float(high / low) if low > 0 else float("inf"),
        seam_mean=float(differences.mean()) if len(differences) else 0.0,
        seam_p95=float(np.quantile(differences.max(1), 0.95)) if len(differences) else 0.0,
    )
