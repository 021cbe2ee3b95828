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
PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # of Lab channels


@dataclass(frozen=True)
class Mixture:
    """Gaussian mixture in Lab.

    Attributes:
        means: centers.
        logs: log of share times density of every Gaussian, as coefficients of the monomials of `_monomials`.
    """

    means: Float[ndarray, "k 3"]
    logs: Float[ndarray, "k m"]

    def log_density(self, colors: Float[ndarray, "p 3"]) -> Float[ndarray, " p"]:
        """Return the log density at colors."""
        return _log_sum(self.logs @ _monomials(colors))


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
    monomials = _monomials(colors)
    mixture = _estimate(monomials, weights * (owners == np.arange(MIXTURE)[:, None]))
    for _ in range(EM_STEPS):
        joint = mixture.logs @ monomials
        mixture = _estimate(monomials, weights * np.exp(joint - _log_sum(joint)))
    return mixture


def _monomials(colors: Float[ndarray, "p 3"]) -> Float[ndarray, "m p"]:
    """Return 1, the color, and the products of two of its channels: Gaussians are the exponentials of their sums."""
    ones = np.ones((1, len(colors)))
    products = [colors[:, i] * colors[:, j] for i, j in PAIRS]
    return np.concatenate([ones, colors.T, np.stack(products)])


def _log_sum(logs: Float[ndarray, "k p"]) -> Float[ndarray, " p"]:
    """Return the log of the sum of exponentials; a plain loop over `logaddexp` takes ten times as long."""
    greatest = logs.max(0)
    return np.asarray(greatest + np.log(np.exp(logs - greatest).sum(0)))


def _estimate(monomials: Float[ndarray, "m p"], weights: Float[ndarray, "k p"]) -> Mixture:
    """Return the mixture with the weighted moments of the colors."""
    moments = weights @ monomials.T
    total = moments[:, 0] + 1e-9
    means = moments[:, 1:4] / total[:, None]
    logs = np.empty((len(total), 4 + len(PAIRS)))
    for k, (mean, products) in enumerate(zip(means, moments[:, 4:] / total[:, None], strict=True)):
        spread = MIN_VARIANCE * np.eye(3)
        for (i, j), product in zip(PAIRS, products, strict=True):
            spread[i, j] += product - mean[i] * mean[j]
            spread[j, i] = spread[i, j]
        precision = np.linalg.inv(spread)
        norm = -0.5 * np.linalg.slogdet(spread)[1] - 1.5 * np.log(2 * np.pi)
        logs[k, 0] = np.log(total[k] / total.sum()) + norm - 0.5 * mean @ precision @ mean
        logs[k, 1:4] = precision @ mean
        logs[k, 4:] = [-(0.5 if i == j else 1.0) * precision[i, j] for i, j in PAIRS]
    return Mixture(means, logs)
