"""The rasterizer for CUDA: gsplat's kernels (https://docs.gsplat.studio) behind the semantics of `interface`, float32.

gsplat 1.5.3 has the same blur, least and greatest alpha, exclusive stop, bounds, margin of the frustum, order and
depth; all but the blur and the near plane are compiled in. What differs:
- Gradients: the last transmittance of a pixel is 1 - alpha, so where little light is left they are good to 1e-3 only;
  sums are atomic, so two runs differ in the last digits; exponentials and divisions are CUDA's fast ones.
- Gradients of several states with fewer Gaussians than a warp has lanes are mixed up: they are drawn one by one.
- Covariances are formed in 3D: long needles lose digits, most of all the gradients of scales. In needles of a standard
  deviation beyond some 1500 pixels, pairs whose exponent rounds below zero are left out, and then whole needles.
- `visible` rounds the bounding box up to whole pixels: it may count a Gaussian that ends just outside of the picture.
- Not drawn: a quaternion of norm zero, a depth beyond 1e10. A scale beyond 1e9 hides the Gaussian or everything behind
  it, and may give gradients that are not finite.
"""

import logging
from collections.abc import Sequence
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from gsplat import rasterization
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.utils.cpp_extension import get_default_build_root

from dg4d_lib.cameras.orbit import OrbitCamera, world_to_camera
from dg4d_lib.devices import to_device_async
from dg4d_lib.errors import BackendUnavailable
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.rasterizer import reference
from dg4d_lib.rasterizer.interface import BLUR, NEAR, Rendering, has_state_per_camera, require_finite, shared_size

DEVICE = torch.device("cuda")
WARP = 32  # lanes
NOTICE = "compiling gsplat's kernels for this GPU: some minutes, once"

_log = logging.getLogger(__name__)


def rasterize(
    gaussians: Gaussians,
    cameras: Sequence[OrbitCamera],
    background: Float[Tensor, " 3"],
    means2d_offsets: Float[Tensor, "b n 2"] | None = None,
) -> Rendering:
    """Render every camera's picture in one call of gsplat; differentiable once; `means2d_offsets` are taken to be zero.

    Drawn on the GPU; pictures and gradients come back where the Gaussians are, in their precision. For the arguments
    see `Rasterizer`.

    Raises:
        BadInput: no cameras, cameras of different sizes, a number of states other than the number of cameras, or
            Gaussians with numbers that are not finite.
        BackendUnavailable: gsplat could not compile its kernels.
    """
    height, width = shared_size(cameras)
    moving = has_state_per_camera(gaussians, cameras)
    require_finite(gaussians)
    if len(gaussians) == 0:  # gsplat divides by their number
        return reference.rasterize(gaussians, cameras, background, means2d_offsets)
    if moving and len(cameras) > 1 and len(gaussians) < WARP:
        return _one_by_one(gaussians, cameras, background, means2d_offsets)
    _require_kernels()
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.colors)
    means, quats, scales, opacities, colors = (value.to(DEVICE, torch.float32) for value in fields)
    caught: list[Tensor] = []
    if means2d_offsets is not None:
        means = _ScreenGradient.apply(means, means2d_offsets, caught)
    poses, lenses = to_device_async(world_to_camera(cameras).float(), DEVICE), to_device_async(_lenses(cameras), DEVICE)
    backgrounds = to_device_async(background.detach().float(), DEVICE).expand(len(cameras), 3)
    if moving:  # a batch of clouds with one camera each
        opacities, colors = opacities.expand(len(cameras), -1), colors.expand(len(cameras), -1, -1)
        poses, lenses, backgrounds = poses[:, None], lenses[:, None], backgrounds[:, None]
    pictures, alpha, info = rasterization(
        means, quats, scales, opacities, colors, poses, lenses, width, height,
        near_plane=NEAR, eps2d=BLUR, backgrounds=backgrounds, render_mode="RGB+D", packed=False,
    )  # fmt: skip
    if means2d_offsets is not None and info["means2d"].requires_grad:
        info["means2d"].register_hook(caught.append)
    views = (len(cameras), height, width)
    color, depth = pictures.reshape(*views, 4).to(gaussians.means).split((3, 1), -1)
    visible = (info["radii"] > 0).all(-1).reshape(len(cameras), len(gaussians)).to(gaussians.means.device)
    return Rendering(color, alpha.reshape(*views, 1).to(gaussians.means), depth, visible)


@cache
def _require_kernels() -> None:
    """Have gsplat load its kernels or compile them; that takes minutes once, and fails in many ways.

    Raises:
        BackendUnavailable: it has none (None where there is no nvcc), or could not compile them.
    """
    if find_spec("gsplat.csrc") is None and not any(Path(get_default_build_root()).rglob("gsplat_cuda.so")):
        _log.info(NOTICE)
    try:
        failure, kernels = None, import_module("gsplat.cuda._backend")._C
    except (ImportError, OSError, RuntimeError) as error:
        failure, kernels = error, None
    if kernels is None:
        first_line = str(failure or "").partition("\n")[0]
        reason = f" ({first_line})" if first_line else ""
        raise BackendUnavailable(
            f"gsplat has no kernels here{reason}: install the CUDA toolkit (nvcc) of torch's CUDA version, or a wheel "
            "of gsplat that holds them (https://docs.gsplat.studio/whl); or choose rasterizer=cpu"
        ) from failure


def _one_by_one(
    gaussians: Gaussians,
    cameras: Sequence[OrbitCamera],
    background: Float[Tensor, " 3"],
    means2d_offsets: Float[Tensor, "b n 2"] | None,
) -> Rendering:
    """Every state in a call of its own: gsplat sums gradients in a warp by a Gaussian's number, whatever its state."""
    views = []
    for view, camera in enumerate(cameras):
        offsets = None if means2d_offsets is None else means2d_offsets[view : view + 1]
        views.append(vars(rasterize(gaussians.at(view), [camera], background, offsets)).values())
    return Rendering(*(torch.cat(parts) for parts in zip(*views, strict=True)))


def _lenses(cameras: Sequence[OrbitCamera]) -> Float[Tensor, "b 3 3"]:
    """Intrinsics: focal lengths and the principal point, pixels."""
    return torch.tensor(
        [
            ((camera.focal, 0, camera.width / 2), (0, camera.focal, camera.height / 2), (0, 0, 1))
            for camera in cameras
        ]
    )  # fmt: skip


class _ScreenGradient(torch.autograd.Function):
    """The identity on the means; gives `means2d_offsets` the gradient that was caught at the projected centers.

    These exist inside of gsplat only. In backward they come before the means, so their gradient is there by then.
    """

    @staticmethod
    def forward(ctx: Any, means: Tensor, offsets: Tensor, caught: list[Tensor]) -> Tensor:
        ctx.caught, ctx.offsets = caught, offsets.detach()
        return means.view_as(means)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        return gradient, ctx.caught.pop().reshape(ctx.offsets.shape).to(ctx.offsets), None
