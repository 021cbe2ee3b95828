"""Other splatting programs behind our rasterizer interface, and the pairs of pixel and Gaussian to blend."""

import importlib
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any, no_type_check
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera, intrinsics
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.kernels.compiling import njit
from dg4d_lib.rasterizer.interface import MAX_ALPHA, MAX_SIGMA, MIN_ALPHA, MIN_TRANSMITTANCE, NEAR

WHITE = torch.ones(3)


def gsplat_torch(cloud: Gaussians, camera: OrbitCamera) -> Callable[[], tuple[Tensor, Tensor]]:
    """Return gsplat's plain torch code as a function that renders color with depth, and alpha, over white.

    Its projection and its `accumulate` are called unchanged, as `_rasterize_to_pixels` does. Two CUDA dependencies are
    replaced: the list of pairs to blend comes from a compiled loop (`blended_pairs`), and the two functions of nerfacc
    that `accumulate` calls are written in torch (`_nerfacc`), because nerfacc's scans need a GPU.

    Raises:
        ImportError: gsplat is not installed.
    """
    gsplat: Any = importlib.import_module("gsplat.cuda._torch_impl")
    width, height = camera.width, camera.height
    pose = camera.viewmat().float()[None]
    lens = intrinsics([camera])
    nerfacc, behind = _nerfacc(), torch.cat((WHITE, torch.zeros(1)))

    def draw() -> tuple[Tensor, Tensor]:
        covariances, _ = gsplat._quat_scale_to_covar_preci(cloud.quats, cloud.log_scales.exp(), compute_preci=False)
        _, centers, depths, conics, _ = gsplat._fully_fused_projection(
            cloud.means, covariances, pose, lens, width, height, near_plane=NEAR
        )
        opacities = cloud.opacity_logits.sigmoid()[None]
        projected = (value[0].detach().numpy() for value in (centers, depths, conics, opacities))
        pixels, members = (torch.from_numpy(ids) for ids in blended_pairs(*projected, width, height))
        values = torch.cat((cloud.colors[None], depths[..., None]), -1)
        with patch.dict(sys.modules, nerfacc=nerfacc):
            picture, alpha = gsplat.accumulate(
                centers, conics, opacities, values, members, pixels, torch.zeros_like(pixels), width, height
            )
        return picture + (1 - alpha) * behind, alpha

    return draw


@no_type_check
def blended_pairs(centers, depths, conics, opacities, width, height):
    """Return pixels and Gaussians of one view's blended pairs, by pixel, front to back."""
    order = np.argsort(depths, kind="stable")
    order = order[depths[order] > NEAR]
    counts = np.zeros(width * height, np.int64)
    empty = np.empty(0, np.int64)
    _visit(centers, conics, opacities, order, width, height, counts, False, empty, empty)
    places = np.cumsum(counts) - counts
    pixels, members = np.empty((2, counts.sum()), np.int64)
    _visit(centers, conics, opacities, order, width, height, places, True, pixels, members)
    return pixels, members


@njit(cache=True)
@no_type_check
def _visit(centers, conics, opacities, order, width, height, places, listing, pixels, members):
    """Count the pairs of every pixel in `places`, or list them from there on."""
    left_over = np.ones(width * height, np.float32)
    for g in order:
        a, b, c = conics[g]
        determinant = a * c - b * b
        reach = min(MAX_SIGMA, np.sqrt(2 * np.log(max(opacities[g] / MIN_ALPHA, 1))))
        right, down = reach * np.sqrt(c / determinant), reach * np.sqrt(a / determinant)
        x, y = centers[g]
        for row in range(max(int(y - down), 0), min(int(y + down) + 1, height)):
            for column in range(max(int(x - right), 0), min(int(x + right) + 1, width)):
                dx, dy = column + np.float32(0.5) - x, row + np.float32(0.5) - y
                alpha = min(MAX_ALPHA, opacities[g] * np.exp(-(a * dx * dx + c * dy * dy) / 2 - b * dx * dy))
                pixel = row * width + column
                if alpha < MIN_ALPHA or left_over[pixel] < 0:
                    continue
                if left_over[pixel] * (1 - alpha) <= MIN_TRANSMITTANCE:
                    left_over[pixel] = -1
                    continue
                left_over[pixel] *= 1 - alpha
                if listing:
                    pixels[places[pixel]] = pixel
                    members[places[pixel]] = g
                places[pixel] += 1


def _nerfacc() -> ModuleType:
    """Return CPU versions of the nerfacc functions that gsplat imports; products along rays use running sums."""

    def render_weight_from_alpha(alphas: Tensor, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
        logs = torch.log1p(-alphas.double())
        before = logs.cumsum(0) - logs
        starts = torch.searchsorted(ray_indices, torch.arange(n_rays)).clamp(max=len(logs) - 1)
        passed = (before - before[starts][ray_indices]).exp().float()
        return alphas * passed, passed

    def accumulate_along_rays(weights: Tensor, values: Tensor | None, ray_indices: Tensor, n_rays: int) -> Tensor:
        source = weights[:, None] if values is None else weights[:, None] * values
        return torch.zeros(n_rays, source.shape[1]).index_add(0, ray_indices, source)

    module = ModuleType("nerfacc")
    module.__dict__.update(
        render_weight_from_alpha=render_weight_from_alpha, accumulate_along_rays=accumulate_along_rays
    )
    return module
