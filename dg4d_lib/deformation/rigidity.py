"""Local rigidity over time (Luiten et al. 2024): neighbors keep their places in each other's frames."""

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

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


def rigidity(moved: Gaussians, indices: Int[Tensor, "n k"], weights: Float[Tensor, "n k"]) -> Float[Tensor, ""]:
    """Mean weighted distance of neighbors from where the Gaussian's own rotation carries them from frame to frame.

    Args:
        moved: the cloud at every frame (fields "t n 3").
        indices: neighbors, from `neighborhoods`.
        weights: theirs.
    """
    edges = moved.means[:, indices] - moved.means[:, :, None]
    turns = rotation_matrix(moved.quats)
    local = torch.einsum("tnij,tnki->tnkj", turns, edges)
    return (weights * (local[1:] - local[:-1]).norm(dim=-1)).mean() if len(local) > 1 else edges.new_zeros(())
