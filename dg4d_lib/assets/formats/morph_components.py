"""Principal components of a vertex animation: fewer morph targets than frames, blended by animated weights."""

import numpy as np
from jaxtyping import Float


def principal_components(
    offsets: Float[np.ndarray, "t v 3"], count: int
) -> tuple[Float[np.ndarray, "k v 3"], Float[np.ndarray, "t k"]]:
    """Approximate offsets by components times weights, with the least sum of squares.

    Args:
        offsets: of the vertices at every frame; a frame without offsets gets weights of 0.
        count: maximum number of components; less if fewer are exact.

    Returns:
        Components in the order of their share, each scaled so that its largest weight is 1, and their weights.
    """
    rows = offsets.reshape(len(offsets), -1).astype(np.float64)
    left, values, _ = np.linalg.svd(rows @ rows.T)
    kept = max(1, int((values[:count] > values[0] * 1e-12).sum()))
    weights = left[:, :kept]  # orthonormal columns
    components = weights.T @ rows
    largest = np.abs(weights).max(0)
    shape = (kept, *offsets.shape[1:])
    return (components * largest[:, None]).reshape(shape).astype("<f4"), (weights / largest).astype("<f4")


def fit_components(values: Float[np.ndarray, "t v 3"], weights: Float[np.ndarray, "t k"]) -> Float[np.ndarray, "k v 3"]:
    """Return the components that times these weights approximate values best."""
    solution = np.linalg.pinv(weights.astype(np.float64)) @ values.reshape(len(values), -1)
    return solution.reshape(-1, *values.shape[1:]).astype("<f4")
