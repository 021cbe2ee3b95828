"""Local rigidity over time (Luiten et al. 2024): neighbors keep their places in each other's frames."""

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from dg4d_lib.deformation.rigidity_loss_kernel import rigidity_sum
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.quaternion import rotation_matrix

NEIGHBORS = 20
FALLOFF = 2000.0  # per world unit squared, of the weights exp(-FALLOFF d^2)


def neighborhoods(
    means: Float[Tensor, "n 3"], count: int = NEIGHBORS
) -> tuple[Int[Tensor, "n k"], Float[Tensor, "n k"]]:
    """The nearest neighbors of every Gaussian and their weights, at rest."""
    count = min(count, len(means) - 1)
    places = means.detach().cpu().numpy()
    distances, indices = map(torch.as_tensor, cKDTree(places).query(places, k=count + 1))
    return indices[:, 1:].long().to(means.device), torch.exp(-FALLOFF * distances[:, 1:].to(means).square())


def rigidity_loss(moved: Gaussians, indices: Int[Tensor, "n k"], weights: Float[Tensor, "n k"]) -> Float[Tensor, ""]:
    """Mean weighted distance of neighbors from where the Gaussian's own rotation carries them from frame to frame.

    Args:
        moved: the cloud at every frame (fields "t n 3").
        indices: neighbors, from `neighborhoods`.
        weights: theirs.
    """
    steps = len(moved.means) - 1
    if steps < 1:
        return moved.means.new_zeros(())
    turns = rotation_matrix(moved.quats)
    on_cpu = moved.means.device.type == "cpu" and moved.means.dtype == torch.float32
    total = (rigidity_sum if on_cpu else rigidity_sum_reference)(moved.means, turns, indices, weights)
    return total / (steps * indices.numel())


def rigidity_sum_reference(
    means: Float[Tensor, "t n 3"],
    turns: Float[Tensor, "t n 3 3"],
    indices: Int[Tensor, "n k"],
    weights: Float[Tensor, "n k"],
) -> Float[Tensor, ""]:
    """The definition of `rigidity_sum`, and what runs on other devices and precisions."""
    edges = means[:, indices] - means[:, :, None]
    local = torch.einsum("tnij,tnki->tnkj", turns, edges)
    return (weights * local.diff(dim=0).norm(dim=-1)).sum()
