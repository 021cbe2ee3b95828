"""Clouds somewhere else in the world, and several as one."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.quaternion import multiply


def transform(
    gaussians: Gaussians, quat: Float[Tensor, " 4"], scale: float, translation: Float[Tensor, " 3"]
) -> Gaussians:
    """A cloud that is scaled, turned and moved, in this order; one state or a batch of them.

    Args:
        gaussians: with colors that look the same from everywhere.
        quat: the turn, wxyz, unit.
        scale: above 0.
        translation: world units.

    Raises:
        BadInput: colors depend on the direction of view, which would have to turn too.
    """
    if gaussians.harmonics.shape[1] > 1:
        raise BadInput("only clouds of one color per Gaussian (harmonics of degree 0) can be turned")
    turn = quat.to(gaussians.means)
    points = torch.cat((torch.zeros_like(gaussians.means[..., :1]), gaussians.means), -1)
    back = turn * turn.new_tensor((1, -1, -1, -1))
    turned = multiply(multiply(turn.expand_as(points), points), back.expand_as(points))[..., 1:]
    return replace(
        gaussians,
        means=scale * turned + translation.to(turned),
        log_scales=gaussians.log_scales + torch.tensor(scale).log().to(turned),
        quats=multiply(turn.expand_as(gaussians.quats), gaussians.quats),
    )


def concatenate(clouds: Sequence[Gaussians]) -> Gaussians:
    """All Gaussians of several clouds with as many states each."""
    return Gaussians(
        torch.cat([cloud.means for cloud in clouds], -2),
        torch.cat([cloud.log_scales for cloud in clouds], -2),
        torch.cat([cloud.quats for cloud in clouds], -2),
        torch.cat([cloud.opacity_logits for cloud in clouds]),
        torch.cat([cloud.harmonics for cloud in clouds]),
    )
