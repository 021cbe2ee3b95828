"""Subjects in photographs, without learned weights: what does not belong to the border, sharpened by color models.

First guess: boundary connectivity of superpixels and background-weighted contrast (Zhu, Liang, Wei and Sun 2014,
"Saliency Optimization from Robust Background Detection"). Then, as in GrabCut (Rother et al. 2004), Gaussian mixtures
of both sides and a smoothness that stops at edges; the cut is relaxed to a random walk with priors (Grady 2005), a
linear system.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import sparse
from scipy.sparse import csgraph
from scipy.sparse.linalg import spsolve
from skimage.segmentation import slic

SUPERPIXELS = 250
COMPACTNESS = 15.0  # of superpixels, Lab units
SAME_COLOR = 4.0  # Lab units: a step below it costs nothing on a path to the border
GEODESIC = 10.0  # Lab units: reach of a region along such paths (sigma_clr of the paper)
NEIGHBORHOOD = 0.4  # of the frame: reach of contrast (sigma_spa of the paper)
CENTER = 0.45  # of the half frame: how far from the middle a photograph's subject is expected, standard deviation
MIXTURE = 5  # Gaussians of a color model, as in GrabCut
ROUNDS = 3  # of color models and cuts in turn
SMOOTHNESS = 6.0  # weight of the edges of the pixel grid against the color models
PRIOR = 0.6  # weight of the first guess in log odds; the rest is color
SURE = 4.0  # log odds beyond which color does not get more certain
SAMPLES = 8000  # pixels a mixture is fitted to
EM_STEPS = 12
GRAIN = 2.0  # Lab units squared: the least variance of a Gaussian


@dataclass(frozen=True)
class Mixture:
    """Gaussians in Lab.

    Attributes:
        shares: their weights, with sum 1.
        means: their centers.
        roots: R with R R^T the inverse of the covariance.
        log_norms: logarithm of the density at the center.
    """

    shares: Float[ndarray, " k"]
    means: Float[ndarray, "k 3"]
    roots: Float[ndarray, "k 3 3"]
    log_norms: Float[ndarray, " k"]

    def log_density(self, colors: Float[ndarray, "p 3"]) -> Float[ndarray, " p"]:
        """Natural logarithm of the density at these colors."""
        return np.logaddexp.reduce(self.log_joint(colors), axis=1)

    def log_joint(self, colors: Float[ndarray, "p 3"]) -> Float[ndarray, "p k"]:
        """Log of share times density, for every Gaussian."""
        distances = [(((colors - mean) @ root) ** 2).sum(1) for mean, root in zip(self.means, self.roots, strict=True)]
        return np.log(self.shares) + self.log_norms - 0.5 * np.stack(distances, 1)


@dataclass(frozen=True)
class Segmentation:
    """The result for every frame.

    Attributes:
        likelihood: of belonging to the subject, in [0, 1].
        separation: chance that a pixel of the subject looks more like the subject's colors than one of the background;
            0.5 means that colors tell nothing.
    """

    likelihood: Float[ndarray, "t h w"]
    separation: float


def segment(lab: Float[ndarray, "t h w 3"]) -> Segmentation:
    """Tell the subject from the background, with one pair of color models for all frames."""
    guess = np.stack([estimate_saliency(frame) for frame in lab])
    likelihood = guess
    colors = lab.reshape(-1, 3).astype(np.float64)
    odds = np.zeros(len(colors))
    for _ in range(ROUNDS):
        flat = likelihood.reshape(-1)
        front, back = fit_mixture(colors, flat**2), fit_mixture(colors, (1 - flat) ** 2)
        odds = np.clip(front.log_density(colors) - back.log_density(colors), -SURE, SURE)
        belief = PRIOR * _logit(guess) + (1 - PRIOR) * odds.reshape(guess.shape)
        likelihood = np.stack([random_walk(frame, _sigmoid(b)) for frame, b in zip(lab, belief, strict=True)])
    return Segmentation(likelihood, _separation(odds, likelihood.reshape(-1) > 0.5))


def estimate_saliency(lab: Float[ndarray, "h w 3"]) -> Float[ndarray, "h w"]:
    """How much every pixel stands out from what is connected to the border, in [0, 1]."""
    labels = np.unique(slic(lab, SUPERPIXELS, COMPACTNESS, convert2lab=False, channel_axis=-1), return_inverse=True)[1]
    labels = labels.reshape(lab.shape[:2])
    regions = int(labels.max()) + 1
    sizes = np.bincount(labels.ravel(), minlength=regions).astype(np.float64)
    means = np.stack([np.bincount(labels.ravel(), lab[..., c].ravel(), regions) / sizes for c in range(3)], 1)
    rows, columns = np.mgrid[-1 : 1 : lab.shape[0] * 1j, -1 : 1 : lab.shape[1] * 1j]
    places = np.stack([np.bincount(labels.ravel(), axis.ravel(), regions) / sizes for axis in (columns, rows)], 1)
    apart = np.linalg.norm(means[:, None] - means[None], axis=-1)
    pairs = _neighbors(labels)
    edge = np.isin(np.arange(regions), np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))

    background = _background(apart, pairs, edge)
    near = np.exp(-((places[:, None] - places[None]) ** 2).sum(-1) / 2 / (2 * NEIGHBORHOOD) ** 2)
    contrast = (apart * near * background).sum(1) * np.exp(-((places / CENTER) ** 2).sum(1) / 4)
    contrast = (contrast - contrast.min()) / max(float(np.ptp(contrast)), 1e-9)

    links = np.exp(-(apart[pairs[:, 0], pairs[:, 1]] ** 2) / (2 * GEODESIC**2)) + 0.1
    laplacian = _laplacian(pairs, links, regions)
    solved = spsolve((laplacian + sparse.diags(background + contrast + 1e-6)).tocsc(), contrast)
    solved = (solved - solved.min()) / max(float(np.ptp(solved)), 1e-9)
    return solved[labels]


def fit_mixture(colors: Float[ndarray, "p 3"], weights: Float[ndarray, " p"]) -> Mixture:
    """Weighted expectation maximization, started by splitting along the widest axis; no randomness."""
    choice = np.arange(0, len(colors), max(1, len(colors) // SAMPLES))
    colors, weights = colors[choice], weights[choice] + 1e-6
    owners = np.zeros(len(colors), np.int64)
    for k in range(1, MIXTURE):
        spreads = [
            np.average((colors[owners == j] - colors[owners == j].mean(0)) ** 2, axis=0).sum()
            * weights[owners == j].sum()
            if (owners == j).sum() > 1
            else 0.0
            for j in range(k)
        ]
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


def random_walk(lab: Float[ndarray, "h w 3"], belief: Float[ndarray, "h w"]) -> Float[ndarray, "h w"]:
    """The smoothest map that follows a belief, where smoothness does not count across edges of the picture."""
    height, width = belief.shape
    index = np.arange(height * width).reshape(height, width)
    pairs = np.concatenate(
        [
            np.stack([index[:, :-1].ravel(), index[:, 1:].ravel()], 1),
            np.stack([index[:-1].ravel(), index[1:].ravel()], 1),
        ]
    )
    colors = lab.reshape(-1, 3).astype(np.float64)
    steps = ((colors[pairs[:, 0]] - colors[pairs[:, 1]]) ** 2).sum(1)
    links = SMOOTHNESS * np.exp(-steps / (2 * max(float(steps.mean()), 1e-6))) + 1e-3
    laplacian = _laplacian(pairs, links, height * width)
    system = (laplacian + sparse.identity(height * width)).tocsc()
    walked: Float[ndarray, "h w"] = spsolve(system, belief.ravel(), permc_spec="MMD_AT_PLUS_A").reshape(height, width)
    return walked.clip(0, 1)


def _background(apart: Float[ndarray, "r r"], pairs: Int[ndarray, "e 2"], edge: ndarray) -> Float[ndarray, " r"]:
    """Chance that a region is background: how much of its surroundings of like color lies on the border."""
    regions = len(edge)
    costs = np.maximum(apart[pairs[:, 0], pairs[:, 1]] - SAME_COLOR, 0) + 1e-6
    graph = sparse.coo_matrix((costs, (pairs[:, 0], pairs[:, 1])), (regions, regions)).tocsr()
    reach = np.exp(-(csgraph.dijkstra(graph, directed=False) ** 2) / (2 * GEODESIC**2))
    connectivity = reach[:, edge].sum(1) / np.sqrt(reach.sum(1))
    return 1 - np.exp(-(connectivity**2) / 2)


def _neighbors(labels: Int[ndarray, "h w"]) -> Int[ndarray, "e 2"]:
    """Pairs of regions that touch, each once."""
    pairs = np.concatenate(
        [
            np.stack([labels[:, :-1].ravel(), labels[:, 1:].ravel()], 1),
            np.stack([labels[:-1].ravel(), labels[1:].ravel()], 1),
        ]
    )
    return np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], 1), axis=0)


def _laplacian(pairs: Int[ndarray, "e 2"], links: Float[ndarray, " e"], count: int) -> sparse.csr_matrix:
    links_matrix = sparse.coo_matrix((links, (pairs[:, 0], pairs[:, 1])), (count, count))
    symmetric = links_matrix + links_matrix.T
    return sparse.diags(np.asarray(symmetric.sum(1)).ravel()) - symmetric


def _estimate(colors: Float[ndarray, "p 3"], weights: Float[ndarray, " p"], members: Float[ndarray, "p k"]) -> Mixture:
    share = members * weights[:, None]
    total = share.sum(0) + 1e-9
    means = share.T @ colors / total[:, None]
    spreads = np.empty((len(total), 3, 3))
    for k, mean in enumerate(means):
        offset = colors - mean
        spreads[k] = (offset * share[:, k : k + 1]).T @ offset / total[k] + GRAIN * np.eye(3)
    log_norms = -0.5 * np.linalg.slogdet(spreads)[1] - 1.5 * np.log(2 * np.pi)
    return Mixture(total / total.sum(), means, np.linalg.cholesky(np.linalg.inv(spreads)), log_norms)


def _separation(odds: Float[ndarray, " p"], subject: ndarray) -> float:
    """Area under the curve: the Mann-Whitney statistic of the odds inside against outside."""
    inside, outside = np.sort(odds[subject]), np.sort(odds[~subject])
    if not len(inside) or not len(outside):
        return 0.5
    below = np.searchsorted(outside, inside, "left") + np.searchsorted(outside, inside, "right")
    return float(below.mean() / (2 * len(outside)))


def _logit(p: ndarray) -> ndarray:
    p = np.clip(p, 0.02, 0.98)
    return np.log(p / (1 - p))


def _sigmoid(x: ndarray) -> ndarray:
    return 1 / (1 + np.exp(-x))
