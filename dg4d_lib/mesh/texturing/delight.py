"""Removal of shading from a texture: the light of the picture, which viewers would add a second time.

The logarithm of the luminance is fitted by spherical harmonics of degree 2 in the surface normal, which hold nearly all
of a distant light's diffuse shading (Ramamoorthi and Hanrahan 2001). Markings that do not follow the normal are
outliers of the fit and stay; a belly that is brighter or darker than the back is taken for shading.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import ndimage
from torch import Tensor

from dg4d_lib.geometry.normals import vertex_normals
from dg4d_lib.mesh.extraction.topology import group_vertices
from dg4d_lib.mesh.models.model import to_linear, to_srgb
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh.texturing.bake import Texels, locate_texels
from dg4d_lib.mesh.texturing.smoothing import taubin_smooth
from dg4d_lib.mesh.texturing.unwrap import SMOOTHING

LUMINANCE = (0.2126, 0.7152, 0.0722)  # of linear red, green and blue (Rec. 709)
DARKEST = 0.005  # linear luminance; darker texels count as this bright
ROUNDS = 10  # of the robust fit
OUTLIER = 0.2  # residual of the logarithm from which a texel's weight falls (Huber)
STIFF = 1e-3  # Tikhonov weight of the terms that are not constant
MOST_GAIN = 2.0  # bounds of the correction: this, and its inverse


def delight(mesh: TexturedMesh) -> TexturedMesh:
    """Divide the low-order shading out of a mesh's texture; the mean of the logarithm of the luminance stays."""
    return replace(mesh, texture=remove_shading(mesh.texture, mesh))


def remove_shading(texture: Float[Tensor, "h w 3"], mesh: TexturedMesh) -> Float[Tensor, "h w 3"]:
    """Divide the low-order shading out of a square texture of a mesh, which need not be its own.

    Args:
        texture: sRGB colors in [0, 1].
        mesh: surface at rest, and its texture coordinates.
    """
    size = len(texture)
    vertices, faces, uvs = mesh.vertices.cpu(), mesh.faces.cpu(), mesh.uvs.cpu()
    texels = locate_texels(vertices, _smooth_normals(vertices, faces), faces, uvs, size)
    if len(texels.rows) == 0:
        return texture
    linear = to_linear(texture.detach().cpu().double().numpy())
    gain = _gain(linear, texels)
    return torch.from_numpy(to_srgb(linear * gain[..., None])).to(texture)


def _smooth_normals(vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]) -> Float[Tensor, "v 3"]:
    """Return normals of a smoothed surface, so that bumps of the mesh do not become visible in the texture."""
    first, position = group_vertices(vertices.numpy())
    joined = position[faces.numpy()]
    smooth = torch.from_numpy(taubin_smooth(vertices.numpy()[first], joined, SMOOTHING)).to(vertices)
    return vertex_normals(smooth, torch.from_numpy(joined))[position]


def _gain(linear: Float[np.ndarray, "h w 3"], texels: Texels) -> Float[np.ndarray, "h w"]:
    """Return the factor of every texel; around charts that of the nearest texel of a chart."""
    rows, columns = texels.rows.numpy(), texels.columns.numpy()
    brightness = np.log(np.maximum(linear[rows, columns] @ np.array(LUMINANCE), DARKEST))
    shading = _fit(_harmonics(texels.normals.double().numpy()), brightness)
    bound = np.log(MOST_GAIN)
    gain, empty = np.ones(linear.shape[:2]), np.ones(linear.shape[:2], bool)
    gain[rows, columns] = np.exp((shading.mean() - shading).clip(-bound, bound))
    empty[rows, columns] = False
    nearest = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    return np.asarray(gain[tuple(nearest)])


def _fit(basis: Float[np.ndarray, "p k"], values: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """Fit values by least squares, reweighted towards absolute residuals; return the fitted values."""
    weights, stiff = np.ones(len(values)), np.diag([0.0, *[STIFF * len(values)] * (basis.shape[1] - 1)])
    fitted = np.zeros(len(values))
    for _ in range(ROUNDS):
        weighted = basis * weights[:, None]
        fitted = basis @ np.linalg.solve(weighted.T @ basis + stiff, weighted.T @ values)
        weights = OUTLIER / np.maximum(np.abs(values - fitted), OUTLIER)
    return fitted


def _harmonics(normals: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 9"]:
    """Evaluate the real spherical harmonics of degrees 0 to 2, up to their factors."""
    x, y, z = normals.T
    return np.stack([np.ones_like(x), x, y, z, x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1], 1)
