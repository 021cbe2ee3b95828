"""Fairing of surfaces, and low-pass filters of values on them.

The density of Gaussians leaves bumps and craters, which lamps show. Fairing minimizes the squared distance to the given
vertices plus a thin-plate energy, the weighted square of the Laplacian (Desbrun et al. 1999). Bumps of half its
wavelength lose 94 % of their height, those of twice it 6 %.
"""

import math

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from scipy import ndimage
from scipy.sparse import csr_array, diags_array
from scipy.spatial import cKDTree

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.geometry.normals import vertex_normals
from dg4d_lib.mesh.extraction.unfold import without_new_defects
from dg4d_lib.mesh.folds import DefectFinder
from dg4d_lib.mesh.neighbors import edge_graph, graph_laplacian, mesh_edges, neighbor_means, screened_factors
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh

SHORTEST = 5.0  # edges: shorter waves are noise of the sampling
THICKNESSES = 2.0  # longest wavelength, in thicknesses of a part: longer waves are its shape
OPPOSITE = -0.5  # cosine between the normals of the two sides of a part, at most
ROUNDS = 10  # averagings of wavelengths over neighbors
HOLD = 100.0  # weight of the position of vertices on the outline of the input view, against 1 elsewhere
INPUT_CAMERA = OrbitCamera(width=256, height=256)


class LowPass:
    """Low-pass filter of values at the vertices of a surface."""

    def __init__(
        self,
        edges: csr_array,
        strength: Float[np.ndarray, " v"],
        weights: Float[np.ndarray, " v"] | None = None,
    ) -> None:
        """Factorize the system.

        Args:
            edges: adjacency of the vertices.
            strength: weight of the squared Laplacian at every vertex; see `strength_of`.
            weights: of the given values, 1 if None.
        """
        laplacian = diags_array(1 / np.maximum(edges.sum(axis=1), 1)) @ graph_laplacian(edges)
        self._weights = np.ones(len(strength)) if weights is None else weights
        bending = csr_array(laplacian.T @ diags_array(strength) @ laplacian)
        self._factors = screened_factors(bending, self._weights)

    def __call__(self, values: Float[np.ndarray, " v"]) -> Float64[np.ndarray, " v"]:
        """Return the filtered values."""
        filtered: Float64[np.ndarray, " v"] = self._factors.solve(self._weights * values.astype(np.float64))
        return filtered


def strength_of(
    wavelength: Float[np.ndarray, " v"], vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Float64[np.ndarray, " v"]:
    """Return the strength by which waves of a length lose half of their height.

    On even triangles of edge length h the Laplacian of a wave is (pi h / wavelength) squared times the wave.

    Args:
        wavelength: world units.
        vertices: world units.
        faces: indices into the vertices.
    """
    edges = mesh_edges(faces)
    length = float(np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1).mean())
    return np.asarray((np.maximum(wavelength / length, SHORTEST) / math.pi) ** 4, np.float64)


def bump_filter(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], wavelength: float) -> LowPass:
    """Return the filter that takes bumps from values on a surface, such as steps along its normals.

    Args:
        vertices: of the surface at rest, world units.
        faces: counter-clockwise seen from outside, of nearly equal edges.
        wavelength: of bumps that lose half of their height, world units; 5 edges at least.
    """
    edges = edge_graph(faces, len(vertices))
    return LowPass(edges, _strength(vertices, faces, edges, wavelength))


def fair(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], wavelength: float
) -> Float[np.ndarray, "v 3"]:
    """Return vertices without bumps; on the outline of the input view they move in depth alone.

    Where that would fold thin parts, they move less.

    Args:
        vertices: of a surface of nearly equal edges, world units.
        faces: counter-clockwise seen from outside.
        wavelength: of bumps that lose half of their height, world units, less on thin parts; 0 changes nothing.
    """
    if wavelength == 0:
        return vertices
    edges = edge_graph(faces, len(vertices))
    strength = _strength(vertices, faces, edges, wavelength)
    held = LowPass(edges, strength, 1 + HOLD * outline_shares(vertices, faces, INPUT_CAMERA))
    free = LowPass(edges, strength)
    columns = zip((held, held, free), vertices.T, strict=True)  # x and y are parallel to the picture of the input view
    smooth = np.stack([filtered(column) for filtered, column in columns], 1)
    return without_new_defects(vertices, smooth, faces, edges, DefectFinder(faces).defective).astype(vertices.dtype)


def outline_shares(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], camera: OrbitCamera
) -> Float64[np.ndarray, " v"]:
    """Return a weight per vertex in [0, 1]: 1 on the outline of a surface, 0 away from it."""
    fragments = rasterize_mesh(torch.from_numpy(vertices).float(), torch.from_numpy(faces), [camera])
    shown = fragments.faces[0].numpy()
    border = (shown >= 0) & ~ndimage.binary_erosion(shown >= 0)
    corners, weights = faces[shown[border]], fragments.barycentrics[0].numpy()[border]
    return np.bincount(corners.ravel(), weights.ravel(), len(vertices)).clip(max=1)


def thickness(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], most: float
) -> Float64[np.ndarray, " v"]:
    """Return the thickness of the matter behind every vertex, the distance to the other side of the surface.

    Args:
        vertices: world units.
        faces: counter-clockwise seen from outside.
        most: thickness at which the result is clamped, world units.
    """
    normals = vertex_normals(torch.from_numpy(vertices).float(), torch.from_numpy(faces)).double().numpy()
    tree = cKDTree(np.concatenate([vertices, most * normals], 1))
    nearest = tree.query(np.concatenate([vertices, -most * normals], 1))[1]
    ways = vertices[nearest] - vertices
    distances = np.linalg.norm(ways, axis=1).astype(np.float64)
    opposite = np.einsum("vi,vi->v", normals, normals[nearest]) <= OPPOSITE
    behind = np.einsum("vi,vi->v", normals, ways) < 0  # else it is across a gap
    return np.where(opposite & behind, distances, most).clip(max=most)


def _strength(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], edges: csr_array, wavelength: float
) -> Float64[np.ndarray, " v"]:
    """Return strengths for a wavelength, shorter on thin parts.

    Thickness is measured without the bumps, which are thin parts themselves.
    """
    alike = strength_of(np.full(len(vertices), float(wavelength)), vertices, faces)
    if wavelength == 0:
        return alike
    even = LowPass(edges, alike)
    smooth = np.stack([even(column) for column in vertices.T], 1)
    waves = THICKNESSES * thickness(smooth, faces, wavelength / THICKNESSES)
    mean_of_neighbors = neighbor_means(edges)
    for _ in range(ROUNDS):
        waves = (waves + mean_of_neighbors @ waves) / 2
    return strength_of(waves, vertices, faces)
