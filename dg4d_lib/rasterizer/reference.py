"""Reference rasterizer in plain torch: every pixel against every Gaussian, gradients by autograd.

It defines the results of the other backends. Notation of Kerbl et al. 2023, section 4 (name here -> symbol there):
`half` -> J W R S, `jacobian` -> J, `covars2d` -> Sigma', `sigma` -> the exponent of alpha = o e^-sigma,
`transmittance` -> T.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import log

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.quaternion import quat_to_rotmat
from dg4d_lib.rasterizer.interface import (
    BLUR,
    FRUSTUM_MARGIN,
    MAX_ALPHA,
    MAX_SIGMA,
    MIN_ALPHA,
    MIN_TRANSMITTANCE,
    NEAR,
    Rendering,
    has_state_per_camera,
    require_finite,
    shared_size,
)

_PAIRS_PER_CHUNK = 1 << 18  # pixels times Gaussians; fits into the cache


def rasterize(
    gaussians: Gaussians,
    cameras: Sequence[OrbitCamera],
    background: Float[Tensor, " 3"],
    means2d_offsets: Float[Tensor, "b n 2"] | None = None,
) -> Rendering:
    """Render one image per camera in the precision of the Gaussians, float32 or float64.

    Gaussians whose covariance overflows are not drawn. For the arguments see `Rasterizer`.

    Raises:
        BadInput: no cameras, cameras of different sizes, a number of states other than the number of cameras, or
            non-finite Gaussians.
    """
    height, width = shared_size(cameras)
    per_camera = has_state_per_camera(gaussians, cameras)
    require_finite(gaussians)
    background = background.to(gaussians.means)
    if means2d_offsets is None:
        means2d_offsets = gaussians.means.new_zeros(len(cameras), len(gaussians), 2)
    views = []
    for view, camera in enumerate(cameras):
        state = gaussians.at(view) if per_camera else gaussians
        offsets = means2d_offsets[view].to(state.means)
        visible, drawn = _sorted_by_depth(_project(state, camera, offsets), height, width)
        splats = _project(state.subset(drawn), camera, offsets[drawn])  # gradients of others could be 0 times infinity
        views.append((*_render(splats, background, height, width), visible))
    color, alpha, depth, visible = (torch.stack(parts) for parts in zip(*views, strict=True))
    return Rendering(color, alpha, depth, visible)


@dataclass
class _Splats:
    """Projected Gaussians of one camera, pixels."""

    means2d: Float[Tensor, "n 2"]
    covars2d: Float[Tensor, "n 2 2"]
    depths: Float[Tensor, " n"]
    opacities: Float[Tensor, " n"]
    colors: Float[Tensor, "n 3"]


def _project(gaussians: Gaussians, camera: OrbitCamera, means2d_offsets: Float[Tensor, "n 2"]) -> _Splats:
    viewmat = camera.viewmat().to(gaussians.means)
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    x, y, z = (gaussians.means @ rotation.T + translation).unbind(-1)
    focal, (tan_x, tan_y) = camera.focal, camera.tan_half_fov
    means2d = torch.stack((focal * x / z + 0.5 * camera.width, focal * y / z + 0.5 * camera.height), -1)
    clamped_x = z * (x / z).clamp(-FRUSTUM_MARGIN * tan_x, FRUSTUM_MARGIN * tan_x)
    clamped_y = z * (y / z).clamp(-FRUSTUM_MARGIN * tan_y, FRUSTUM_MARGIN * tan_y)
    zero = torch.zeros_like(z)
    jacobian = focal * torch.stack(
        (1 / z, zero, -clamped_x / z**2, zero, 1 / z, -clamped_y / z**2), -1
    ).unflatten(-1, (2, 3))  # fmt: skip
    half = jacobian @ rotation @ (quat_to_rotmat(gaussians.quats) * gaussians.scales[:, None, :])
    covars2d = half @ half.mT + BLUR * torch.eye(2).to(half)
    return _Splats(means2d + means2d_offsets, covars2d, z, gaussians.opacities, gaussians.colors)


@torch.no_grad()
def _sorted_by_depth(splats: _Splats, height: int, width: int) -> tuple[Bool[Tensor, " n"], Int[Tensor, " m"]]:
    """Return which Gaussians are visible, and the indices of these, the nearest first."""
    visible = _visible(splats, height, width)
    order = torch.argsort(splats.depths, stable=True)
    return visible, order[visible[order]]


def _render(
    splats: _Splats, background: Float[Tensor, " 3"], height: int, width: int
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w 1"], Float[Tensor, "h w 1"]]:
    """Return color, alpha and depth; the Gaussians are sorted by depth."""
    rows, columns = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack((columns, rows), -1).reshape(-1, 2).to(background)
    chunk = max(1, _PAIRS_PER_CHUNK // max(1, splats.depths.numel()))
    parts = [checkpoint(_blend, part, splats, background, use_reentrant=False) for part in pixels.split(chunk)]
    color, alpha, depth = torch.cat(parts).reshape(height, width, 5).split((3, 1, 1), -1)
    return color, alpha, depth


def _visible(splats: _Splats, height: int, width: int) -> Bool[Tensor, " n"]:
    """Return true for Gaussians beyond the near plane, opaque enough, and with a pixel center in their bounds."""
    opaque = splats.opacities > MIN_ALPHA
    radius = (2 * (splats.opacities.clamp(min=MIN_ALPHA).log() - log(MIN_ALPHA))).sqrt().clamp(max=MAX_SIGMA)
    extent = radius[:, None] * splats.covars2d.diagonal(dim1=-2, dim2=-1).sqrt()
    size = torch.tensor((width, height)).to(splats.means2d)
    on_screen = ((splats.means2d + extent > 0.5) & (splats.means2d - extent < size - 0.5)).all(-1)
    finite = splats.means2d.isfinite().all(-1) & torch.linalg.det(splats.covars2d).isfinite()
    return opaque & on_screen & finite & (splats.depths > NEAR)


def _blend(pixels: Float[Tensor, "p 2"], splats: _Splats, background: Float[Tensor, " 3"]) -> Float[Tensor, "p 5"]:
    """Return color, alpha and depth of some pixels; the Gaussians are sorted by depth."""
    (xx, xy), (_, yy) = splats.covars2d.permute(1, 2, 0)
    determinant = xx * yy - xy * xy
    dx, dy = (pixels[:, None] - splats.means2d).unbind(-1)
    sigma = (0.5 * (yy * dx * dx + xx * dy * dy) - xy * dx * dy) / determinant
    alpha = (splats.opacities * (-sigma).exp()).clamp(max=MAX_ALPHA)
    alpha = torch.where(alpha >= MIN_ALPHA, alpha, 0)
    with torch.no_grad():  # the product never grows, so a stopped pixel stays stopped
        blended = (1 - alpha).cumprod(-1) > MIN_TRANSMITTANCE
    alpha = torch.where(blended, alpha, 0)
    remaining = torch.cat((pixels.new_ones(len(pixels), 1), (1 - alpha).cumprod(-1)), -1)
    weights, transmittance = alpha * remaining[:, :-1], remaining[:, -1:]
    color = weights @ splats.colors + transmittance * background
    return torch.cat((color, 1 - transmittance, weights @ splats.depths[:, None]), -1)
