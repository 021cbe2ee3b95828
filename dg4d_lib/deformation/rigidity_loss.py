"""Local rigidity loss over time (Luiten et al. 2024, Dynamic 3D Gaussians)."""

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from dg4d_lib.deformation.rigidity_loss_kernel import rigidity_sum
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.quaternion import quat_to_rotmat

NEIGHBORS = 20  # per Gaussian (Luiten et al. 2024)
FALLOFF = 2000.0  # per world unit squared: weights are exp(-FALLOFF d^2) (Luiten et al. 2024)


def neighborhoods(
    means: Float[Tensor, "n 3"], count: int = NEIGHBORS
) -> tuple[Int[Tensor, "n k"], Float[Tensor, "n k"]]:
    """Return the nearest neighbors of every Gaussian in the canonical cloud, and their weights.

    None is its own neighbor; a single Gaussian has none.
    """
    count = min(count, len(means) - 1)
    points = means.detach().cpu().numpy()
    distances, indices = map(torch.as_tensor, cKDTree(points).query(points, k=range(1, count + 2)))
    others = indices != torch.arange(len(points))[:, None]
    others[others.all(1), -1] = False  # of many at one place, it may not be among the nearest itself
    distances, indices = (values[others].view(len(points), count) for values in (distances, indices))
    return indices.long().to(means.device), torch.exp(-FALLOFF * distances.to(means).square())


def rigidity_loss(moved: Gaussians, indices: Int[Tensor, "n k"], weights: Float[Tensor, "n k"]) -> Float[Tensor, ""]:
    """Return the mean weighted change of neighbor offsets, seen in each Gaussian's own frame, between frames.

    Args:
        moved: the cloud at every frame (fields "t n 3").
        indices: neighbors, from `neighborhoods`.
        weights: of the neighbors.
    """
    steps = len(moved.means) - 1
    if steps < 1 or not indices.numel():
        return moved.means.new_zeros(())
    on_cpu = moved.means.device.type == "cpu" and moved.means.dtype == torch.float32
    total = (rigidity_sum if on_cpu else rigidity_sum_reference)(moved.means, moved.quats, indices, weights)
    return total / (steps * indices.numel())


def rigidity_sum_reference(
    means: Float[Tensor, "t n 3"],
    quats: Float[Tensor, "t n 4"],
    indices: Int[Tensor, "n k"],
    weights: Float[Tensor, "n k"],
) -> Float[Tensor, ""]:
    """Return `rigidity_sum` in plain torch: the reference, also used on other devices and precisions."""
    edges = means[:, indices] - means[:, :, None]
    local = torch.einsum("tnij,tnki->tnkj", quat_to_rotmat(quats), edges)
    return (weights * local.diff(dim=0).norm(dim=-1)).sum()
