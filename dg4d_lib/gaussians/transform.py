"""Similarity transforms, concatenation and thinning of clouds."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.quaternion import quat_multiply


def transform(
    gaussians: Gaussians, quat: Float[Tensor, " 4"], scale: float, translation: Float[Tensor, " 3"]
) -> Gaussians:
    """Scale, rotate and translate a cloud, in this order; one state or a batch of them.

    Args:
        gaussians: with view-independent colors.
        quat: rotation, wxyz, unit.
        scale: above 0.
        translation: world units.

    Raises:
        BadInput: the colors are view-dependent; rotating spherical harmonics is not supported.
    """
    if gaussians.harmonics.shape[1] > 1:
        degree = math.isqrt(gaussians.harmonics.shape[1]) - 1
        raise BadInput(f"only clouds with spherical harmonics of degree 0 can be rotated; given degree {degree}")
    rotation = quat.to(gaussians.means)
    points = torch.cat((torch.zeros_like(gaussians.means[..., :1]), gaussians.means), -1)
    conjugate = rotation * rotation.new_tensor((1, -1, -1, -1))
    rotated = quat_multiply(quat_multiply(rotation.expand_as(points), points), conjugate.expand_as(points))[..., 1:]
    return replace(
        gaussians,
        means=scale * rotated + translation.to(rotated),
        log_scales=gaussians.log_scales + torch.tensor(scale).log().to(rotated),
        quats=quat_multiply(rotation.expand_as(gaussians.quats), gaussians.quats),
    )


def concatenate(clouds: Sequence[Gaussians]) -> Gaussians:
    """Concatenate clouds with the same number of states."""
    return Gaussians(
        torch.cat([cloud.means for cloud in clouds], -2),
        torch.cat([cloud.log_scales for cloud in clouds], -2),
        torch.cat([cloud.quats for cloud in clouds], -2),
        torch.cat([cloud.opacity_logits for cloud in clouds]),
        torch.cat([cloud.harmonics for cloud in clouds]),
    )


def thinned(cloud: Gaussians, step: int) -> Gaussians:
    """Return every n-th Gaussian of one state, enlarged to cover the same area."""
    thin = cloud.subset(slice(None, None, step))
    return replace(thin, log_scales=thin.log_scales + 0.5 * math.log(step))
