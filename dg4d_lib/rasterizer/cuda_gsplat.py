"""CUDA rasterizer: gsplat's kernels (https://docs.gsplat.studio) with the semantics of `interface`, float32.

gsplat 1.5.3 has the same blur, alpha limits, exclusive stop, bounds, frustum margin, order and depth; all but the blur
and the near plane are compiled in. Differences:
- Gradients: the final transmittance of a pixel is computed as 1 - alpha, so where it is small they are accurate to 1e-3
  only; sums are atomic, so two runs differ in the last digits; exponentials and divisions are CUDA's fast versions.
- gsplat mixes the gradients of several states with fewer Gaussians than a warp has lanes: they are rendered one by one.
- Covariances are formed in 3D: long needles lose digits, most of all in the gradients of scales. In needles with a
  standard deviation above about 1500 pixels, pairs whose exponent rounds below zero are skipped, then whole needles.
- `visible` rounds the bounding box up to whole pixels, so it may include a Gaussian that ends just outside the image.
- Not drawn: a quaternion of norm zero, a depth beyond 1e10. A scale beyond 1e9 hides the Gaussian or everything behind
  it, and may give non-finite gradients.
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

from dg4d_lib.cameras.orbit import OrbitCamera, intrinsics, viewmats
from dg4d_lib.devices import to_device_async
from dg4d_lib.errors import BackendUnavailable
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.rasterizer import reference
from dg4d_lib.rasterizer.interface import BLUR, NEAR, Rendering, has_state_per_camera, require_finite, shared_size

DEVICE = torch.device("cuda")
WARP = 32  # threads
NOTICE = "compiling gsplat's kernels for this GPU: takes minutes, once"

_log = logging.getLogger(__name__)


def rasterize(
    gaussians: Gaussians,
    cameras: Sequence[OrbitCamera],
    background: Float[Tensor, " 3"],
    means2d_offsets: Float[Tensor, "b n 2"] | None = None,
) -> Rendering:
    """Render one image per camera in one call of gsplat; differentiable once; `means2d_offsets` must be zero.

    Images and gradients are returned on the device and in the precision of the Gaussians. For the arguments see
    `Rasterizer`.

    Raises:
        BadInput: no cameras, cameras of different sizes, a number of states other than the number of cameras, or
            non-finite Gaussians.
        BackendUnavailable: gsplat has no kernels and could not compile them.
    """
    height, width = shared_size(cameras)
    per_camera = has_state_per_camera(gaussians, cameras)
    require_finite(gaussians)
    if len(gaussians) == 0:  # gsplat divides by the number of Gaussians
        return reference.rasterize(gaussians, cameras, background, means2d_offsets)
    if per_camera and len(cameras) > 1 and len(gaussians) < WARP:
        return _one_by_one(gaussians, cameras, background, means2d_offsets)
    _require_kernels()
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.colors)
    means, quats, scales, opacities, colors = (value.to(DEVICE, torch.float32) for value in fields)
    grad2d: list[Tensor] = []
    if means2d_offsets is not None:
        means = _Grad2d.apply(means, means2d_offsets, grad2d)
    poses = to_device_async(viewmats(cameras).float(), DEVICE)
    Ks = to_device_async(intrinsics(cameras), DEVICE)
    backgrounds = to_device_async(background.detach().float(), DEVICE).expand(len(cameras), 3)
    if per_camera:  # a batch of clouds with one camera each
        opacities, colors = opacities.expand(len(cameras), -1), colors.expand(len(cameras), -1, -1)
        poses, Ks, backgrounds = poses[:, None], Ks[:, None], backgrounds[:, None]
    images, alpha, info = rasterization(
        means, quats, scales, opacities, colors, poses, Ks, width, height,
        near_plane=NEAR, eps2d=BLUR, backgrounds=backgrounds, render_mode="RGB+D", packed=False,
    )  # fmt: skip
    if means2d_offsets is not None and info["means2d"].requires_grad:
        info["means2d"].register_hook(grad2d.append)
    shape = (len(cameras), height, width)
    color, depth = images.reshape(*shape, 4).to(gaussians.means).split((3, 1), -1)
    visible = (info["radii"] > 0).all(-1).reshape(len(cameras), len(gaussians)).to(gaussians.means.device)
    return Rendering(color, alpha.reshape(*shape, 1).to(gaussians.means), depth, visible)


@cache
def _require_kernels() -> None:
    """Load gsplat's kernels or compile them, which takes minutes once.

    Raises:
        BackendUnavailable: gsplat has no kernels and could not compile them (`_C` is None without nvcc).
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
            f"gsplat's CUDA kernels are missing{reason}: run `make setup CUDA=1` where the GPU is; it compiles them, "
            "or install the CUDA toolkit (nvcc) of torch's CUDA version; or choose rasterizer=cpu"
        ) from failure


def _one_by_one(
    gaussians: Gaussians,
    cameras: Sequence[OrbitCamera],
    background: Float[Tensor, " 3"],
    means2d_offsets: Float[Tensor, "b n 2"] | None,
) -> Rendering:
    """Render every state in a separate call; in a warp, gsplat adds up gradients by index regardless of the state."""
    views = []
    for view, camera in enumerate(cameras):
        offsets = None if means2d_offsets is None else means2d_offsets[view : view + 1]
        views.append(vars(rasterize(gaussians.at(view), [camera], background, offsets)).values())
    return Rendering(*(torch.cat(parts) for parts in zip(*views, strict=True)))


class _Grad2d(torch.autograd.Function):
    """Identity on the means that passes the gradient of gsplat's internal means2d to `means2d_offsets`.

    Backward reaches means2d before the means, so the hook has stored its gradient by then.
    """

    @staticmethod
    def forward(ctx: Any, means: Tensor, offsets: Tensor, grad2d: list[Tensor]) -> Tensor:
        ctx.grad2d, ctx.offsets = grad2d, offsets.detach()
        return means.view_as(means)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        return gradient, ctx.grad2d.pop().reshape(ctx.offsets.shape).to(ctx.offsets), None
