"""Detection of stray Gaussians, which separate from the subject while it moves and float beside it as specks."""

from collections.abc import Iterable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from dg4d_lib.gaussians.cloud import Gaussians

EXTENT = 2.0  # standard deviations along the longest axis, to which a Gaussian is seen
GAP = 0.06  # largest gap between the extents of connected neighbors, world units
FEW = 5  # size from which a cluster is a piece of the subject
NEIGHBORS = 16  # candidates of a Gaussian for links; more than `FEW`
MOST = 0.01  # share of strays; where more come off, the cloud is sparse, or the subject falls to pieces


def find_strays(states: Iterable[Gaussians]) -> Bool[Tensor, " n"]:
    """Find Gaussians that are far from all but a few others at some frames, but not at all frames.

    What is apart at every frame is a piece of the subject, however small.

    Args:
        states: Gaussians of the first frames, of the next ones, and so on, as many as memory holds; world units.

    Returns:
        True for strays; none are found if they were more than a hundredth of the cloud.
    """
    apart = []
    for some in states:
        extents = EXTENT * some.log_scales.exp().amax(-1)
        apart += [_are_apart(*frame) for frame in zip(some.means, extents, strict=True)]
    strays: Bool[Tensor, " n"] = torch.from_numpy(np.any(apart, 0) & ~np.all(apart, 0))
    return strays if int(strays.sum()) <= MOST * len(strays) else torch.zeros_like(strays)


def _are_apart(means: Float[Tensor, "n 3"], extents: Float[Tensor, " n"]) -> NDArray[np.bool_]:
    """Return true for Gaussians of clusters of less than `FEW`."""
    places, reach, count = means.cpu().numpy(), extents.cpu().numpy(), len(means)
    tree = cKDTree(places)
    links = _links(tree, reach, np.arange(count), FEW - 1)  # enough for most Gaussians, and found faster
    few = _are_few(links, count)
    if few.any():
        distances, _ = cKDTree(places[few]).query(places)
        close = np.flatnonzero(distances <= GAP + reach + reach[few].max())  # all others have no links to the few
        few = _are_few(np.concatenate([links, _links(tree, reach, close, NEIGHBORS)], 1), count)
    return few


def _links(
    tree: cKDTree, reach: Float[np.ndarray, " n"], searched: Int[np.ndarray, " m"], neighbors: int
) -> Int[np.ndarray, "2 k"]:
    """Return pairs that belong together: some Gaussians and those of their nearest neighbors within the gap."""
    near = range(1, min(neighbors + 1, len(reach)) + 1)  # the first is itself
    distances, others = map(np.asarray, tree.query(tree.data[searched], near))
    row, column = np.nonzero(distances - reach[searched, None] - reach[others] <= GAP)
    return np.stack([searched[row], others[row, column]])


def _are_few(links: Int[np.ndarray, "2 k"], count: int) -> NDArray[np.bool_]:
    """Return true for Gaussians of clusters of less than `FEW`."""
    graph = coo_array((np.ones(links.shape[1], bool), tuple(links)), (count, count))
    _, clusters = connected_components(graph, directed=False)
    few: NDArray[np.bool_] = (np.bincount(clusters) < FEW)[clusters]
    return few
