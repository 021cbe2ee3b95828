"""Gaussian mixtures of foreground and background colors, as in GrabCut (Rother et al. 2004)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

MIXTURE = 5  # Gaussians per color model, as in GrabCut
SAMPLES = 8000  # pixels per mixture fit
EM_STEPS = 12
MIN_VARIANCE = 2.0  # of a Gaussian, squared Lab units
MIN_SPREAD = 1e-6  # weighted variance below which a cluster is one color, squared Lab units
MAX_LOG_ODDS = 4.0  # bound of the log odds of a color


@dataclass(frozen=True)
class Mixture:
    """Gaussian mixture in Lab.

    Attributes:
        shares: mixture weights, sum 1.
        means: centers.
        roots: R with R R^T the inverse of the covariance.
        log_norms: log density at the center.
    """

    shares: Float[ndarray, " k"]
    means: Float[ndarray, "k 3"]
    roots: Float[ndarray, "k 3 3"]
    log_norms: Float[ndarray, " k"]

    def log_density(self, colors: Float[ndarray, "p 3"]) -> Float[ndarray, " p"]:
        """Return the log density at colors."""
        return np.logaddexp.reduce(self.log_joint(colors), axis=1)

    def log_joint(self, colors: Float[ndarray, "p 3"]) -> Float[ndarray, "p k"]:
        """Return the log of share times density for every Gaussian."""
        distances = [(((colors - mean) @ root) ** 2).sum(1) for mean, root in zip(self.means, self.roots, strict=True)]
        return np.log(self.shares) + self.log_norms - 0.5 * np.stack(distances, 1)


def foreground_log_odds(colors: Float[ndarray, "p 3"], probability: Float[ndarray, " p"]) -> Float[ndarray, " p"]:
    """Return how much more likely a color is in the foreground, as bounded log odds.

    Args:
        colors: of pixels, Lab.
        probability: estimate that a pixel is foreground, in [0, 1]; one pair of models is fitted to all pixels.
    """
    front, back = fit_mixture(colors, probability**2), fit_mixture(colors, (1 - probability) ** 2)
    odds = front.log_density(colors) - back.log_density(colors)
    return np.clip(odds, -MAX_LOG_ODDS, MAX_LOG_ODDS)


def fit_mixture(colors: Float[ndarray, "p 3"], weights: Float[ndarray, " p"]) -> Mixture:
    """Fit a mixture by weighted EM, initialized by splits along the widest axis; deterministic."""
    subset = np.arange(0, len(colors), max(1, len(colors) // SAMPLES))
    colors, weights = colors[subset], weights[subset] + 1e-6
    owners = np.zeros(len(colors), np.int64)
    for k in range(1, MIXTURE):
        spreads = [
            np.average((colors[owners == j] - colors[owners == j].mean(0)) ** 2, axis=0).sum()
            * weights[owners == j].sum()
            if (owners == j).sum() > 1
            else 0.0
            for j in range(k)
        ]
        if max(spreads) < MIN_SPREAD:  # fewer colors than Gaussians: the others keep no share
            break
        widest = owners == int(np.argmax(spreads))
        centered = colors[widest] - np.average(colors[widest], axis=0, weights=weights[widest])
        axis = np.linalg.eigh((centered * weights[widest, None]).T @ centered)[1][:, -1]
        axis = axis * np.sign(axis[np.abs(axis).argmax()])
        owners[np.flatnonzero(widest)[centered @ axis > 0]] = k
    memberships = np.eye(MIXTURE)[owners]
    mixture = _estimate(colors, weights, memberships)
    for _ in range(EM_STEPS):
        joint = mixture.log_joint(colors)
        memberships = np.exp(joint - np.logaddexp.reduce(joint, axis=1)[:, None])
        mixture = _estimate(colors, weights, memberships)
    return mixture


def _estimate(colors: Float[ndarray, "p 3"], weights: Float[ndarray, " p"], members: Float[ndarray, "p k"]) -> Mixture:
    share = members * weights[:, None]
    total = share.sum(0) + 1e-9
    means = share.T @ colors / total[:, None]
    spreads = np.empty((len(total), 3, 3))
    for k, mean in enumerate(means):
        offset = colors - mean
        spreads[k] = (offset * share[:, k : k + 1]).T @ offset / total[k] + MIN_VARIANCE * np.eye(3)
    log_norms = -0.5 * np.linalg.slogdet(spreads)[1] - 1.5 * np.log(2 * np.pi)
    return Mixture(total / total.sum(), means, np.linalg.cholesky(np.linalg.inv(spreads)), log_norms)
