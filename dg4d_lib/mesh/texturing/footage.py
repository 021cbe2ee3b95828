"""Textures fitted to footage: least squares between renders of a mesh and the frames that it follows.

Baking averages colors that texels read from the frames. Frames are coarser than the texture, so reading them blurs, and
rendering blurs again; the fit undoes both.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from numpy.typing import NDArray
from scipy.sparse import diags_array
from scipy.sparse.linalg import LinearOperator, cg
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.kernels.workers import torch_on_one_thread
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh.texturing.bake import INSIDE, PosedSurface, covered_texels, grade_pixels
from dg4d_lib.mesh.texturing.seams import level_seams, seam_points
from dg4d_lib.mesh_rasterizer.texture import Taps, TextureLookup, build_lookup, sample_texture
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh

SAMPLES = 2  # per pixel along each axis
ITERATIONS = 5  # of conjugate gradients
KEPT = 0.02  # weight of a texel's squared change; that of a pixel's squared error is 1
EVEN = 0.5  # weight of the squared difference between the changes of neighboring texels
UNRELIABLE = 0.3  # weight of a pixel beside an outline or behind an occluding edge
STEP = 15  # pixel sides, at the depth of a pixel: a neighbor that is nearer by more occludes

Texture = Float[Tensor, "h w 3"]


@dataclass(frozen=True)
class _Pixels:
    """Pixels of frames, and the samples of the texture that they average.

    Attributes:
        lookup: of all samples.
        pixels: of every sample, the index of its pixel; the number of pixels for samples of none.
        colors: of the pixels in the footage.
        weights: of their squared errors.
    """

    lookup: TextureLookup
    pixels: Int64[Tensor, " n"]
    colors: Float[Tensor, "p 3"]
    weights: Float[Tensor, "p 1"]

    def render(self, texture: Texture) -> Float[Tensor, "p 3"]:
        """Return the colors of the pixels with a texture; linear in it."""
        sums = texture.new_zeros((len(self.colors) + 1, 3))
        return sums.index_add(0, self.pixels, sample_texture(texture, self.lookup))[:-1] / SAMPLES**2


def fit_texture(mesh: TexturedMesh, footage: Sequence[PosedSurface]) -> Texture:
    """Return the texture whose renders are closest to footage, near the given one where no frame shows more.

    Args:
        mesh: with the texture to start from.
        footage: its surface at frames of the driving video, seen from the input camera; split along seams as the mesh.

    Returns:
        Colors in [0, 1], equal on both sides of a seam. Pixels that the mesh or the subject covers in part have no say:
        no background enters.
    """
    pixels = [seen for surface in footage if (seen := _seen_pixels(mesh, surface)) is not None]
    if not pixels:
        return mesh.texture
    with torch_on_one_thread():  # sums of several threads depend on their number
        covered = covered_texels(mesh.faces, mesh.uvs, len(mesh.texture))
        inside = torch.zeros(mesh.texture.shape[:2], dtype=torch.bool)
        inside[covered.rows, covered.columns] = True
        texture = mesh.texture + _best_change(mesh.texture, inside, _joined(pixels))
    points = seam_points(mesh.vertices, mesh.faces, mesh.uvs, len(texture))
    return level_seams(texture.clamp(0, 1), points)


def _best_change(start: Texture, inside: Bool[Tensor, "h w"], frames: _Pixels) -> Texture:
    """Return the change of a texture that fits the frames best, given its texels inside of charts."""
    variable = start.clone().requires_grad_()
    seen = frames.render(variable)

    def spread(errors: Float[Tensor, "p 3"]) -> Texture:
        """Apply the transpose of the renders, which are linear, to weighted errors."""
        (gradient,) = torch.autograd.grad(seen, variable, frames.weights * errors, retain_graph=True)
        return gradient

    def normal(flat: NDArray[np.float32]) -> NDArray[np.float32]:
        change = torch.from_numpy(flat.reshape(start.shape)).to(start)
        with torch.no_grad():
            rendered = frames.render(change)
        return _flat(spread(rendered) + KEPT * change + EVEN * _differences(change, inside))

    diagonal = _flat(spread(torch.ones_like(seen)) + KEPT + 4 * EVEN)
    matrix, scale = LinearOperator(2 * diagonal.shape, normal, dtype=np.float32), diags_array(1 / diagonal)
    change, _ = cg(matrix, _flat(spread(frames.colors - seen.detach())), rtol=0, maxiter=ITERATIONS, M=scale)
    return torch.from_numpy(change.reshape(start.shape)).to(start)


def _flat(texture: Texture) -> NDArray[np.float32]:
    return texture.numpy().ravel()


def _seen_pixels(mesh: TexturedMesh, surface: PosedSurface) -> _Pixels | None:
    """Return the pixels of a frame that both the subject and the mesh cover wholly, None if there are none."""
    camera = OrbitCamera(width=surface.color.shape[1], height=surface.color.shape[0])
    fine = replace(camera, width=SAMPLES * camera.width, height=SAMPLES * camera.height)
    fragments = rasterize_mesh(surface.vertices, mesh.faces, [fine])
    lookup = build_lookup(surface.vertices, mesh.faces, mesh.uvs, mesh.texture.shape[:2], [fine], fragments)
    weights = surface.weight * _trust(mesh, surface, camera)
    _, rows, columns = lookup.covered.nonzero().T
    places = rows // SAMPLES * camera.width + columns // SAMPLES
    full = torch.bincount(places, minlength=weights.numel()) == SAMPLES**2
    used = full & (weights.flatten() > 0)
    if not bool(used.any()):
        return None
    indices = torch.where(used, used.cumsum(0) - 1, used.sum())
    return _Pixels(lookup, indices[places], surface.color.flatten(0, 1)[used], weights.flatten()[used, None])


def _trust(mesh: TexturedMesh, surface: PosedSurface, camera: OrbitCamera) -> Float[Tensor, "h w"]:
    """Return the weight of every pixel: less beside outlines and occluding edges, 0 outside of the subject."""
    color, alpha = surface.color[None], surface.alpha[None, ..., 0]
    _, grade, depth, front = grade_pixels(color, alpha, [camera], surface.vertices, mesh.faces, 1)
    unreliable: Bool[Tensor, "h w"] = (grade < INSIDE) | (depth - front > STEP * depth / camera.focal)
    return (torch.where(unreliable, UNRELIABLE, 1.0) * (grade > 0))[0]


def _joined(parts: Sequence[_Pixels]) -> _Pixels:
    """Return the pixels of several frames as those of one."""
    counts = [len(part.colors) for part in parts]
    total, firsts = sum(counts), torch.tensor([0, *counts]).cumsum(0).tolist()
    samples = torch.tensor([0, *(len(part.pixels) for part in parts)]).cumsum(0).tolist()
    pixels = [
        torch.where(part.pixels < count, part.pixels + first, total)
        for part, count, first in zip(parts, counts, firsts, strict=False)
    ]
    levels = []
    for taps in zip_longest(*(part.lookup.levels for part in parts)):
        shown = [(tap, first) for tap, first in zip(taps, samples, strict=False) if tap is not None]
        shifted = torch.cat([tap.pixels + first for tap, first in shown])
        levels.append(
            Taps(shifted, torch.cat([tap.uvs for tap, _ in shown]), torch.cat([tap.weights for tap, _ in shown]))
        )
    covered = torch.cat([part.lookup.covered for part in parts])
    colors, weights = torch.cat([part.colors for part in parts]), torch.cat([part.weights for part in parts])
    return _Pixels(TextureLookup(covered, tuple(levels)), torch.cat(pixels), colors, weights)


def _differences(texture: Texture, inside: Bool[Tensor, "h w"]) -> Texture:
    """Return the gradient of half the sum of squared differences between neighbors, one of them inside of a chart.

    Charts are two texels apart, so that none has an effect on another.
    """
    down = texture.diff(dim=0) * (inside[1:] | inside[:-1])[..., None]
    right = texture.diff(dim=1) * (inside[:, 1:] | inside[:, :-1])[..., None]
    gradient = torch.zeros_like(texture)
    gradient[1:] += down
    gradient[:-1] -= down
    gradient[:, 1:] += right
    gradient[:, :-1] -= right
    return gradient
