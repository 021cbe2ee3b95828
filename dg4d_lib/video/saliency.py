"""Segmentation of the subject of photographs by saliency and color models, without learned weights.

The initial estimate uses boundary connectivity of superpixels and background-weighted contrast (Zhu, Liang, Wei and Sun
2014, "Saliency Optimization from Robust Background Detection"). It is refined as in GrabCut (Rother et al. 2004) by
Gaussian mixtures of foreground and background with an edge-aware smoothness term; the graph cut is relaxed to a random
walk with priors (Grady 2005), which is a linear system.
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
SAME_COLOR = 4.0  # color step that costs nothing on a path to the border, Lab units
GEODESIC = 10.0  # sigma_clr of the paper, the reach of a region along such paths, Lab units
NEIGHBORHOOD = 0.4  # sigma_spa of the paper, the reach of contrast, as a share of the frame
CENTER = 0.45  # standard deviation of the subject's position around the center, in half frames
MIXTURE = 5  # Gaussians per color model, as in GrabCut
ROUNDS = 3  # alternations of color models and segmentation
SMOOTHNESS = 6.0  # weight of the pixel grid's edges relative to the color models
PRIOR = 0.6  # weight of the initial estimate in the log odds; the rest is color
MAX_LOG_ODDS = 4.0  # bound of the color models' log odds
SAMPLES = 8000  # pixels per mixture fit
EM_STEPS = 12
MIN_VARIANCE = 2.0  # of a Gaussian, squared Lab units


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


@dataclass(frozen=True)
class Segmentation:
    """Segmentation of all frames.

    Attributes:
        likelihood: probability that a pixel belongs to the subject, in [0, 1].
        separation: area under the ROC curve of the color models; 0.5 means that colors carry no information.
    """

    likelihood: Float[ndarray, "t h w"]
    separation: float


def segment(lab: Float[ndarray, "t h w 3"]) -> Segmentation:
    """Segment subject and background, with one pair of color models for all frames."""
    initial = np.stack([estimate_saliency(frame) for frame in lab])
    likelihood = initial
    colors = lab.reshape(-1, 3).astype(np.float64)
    odds = np.zeros(len(colors))
    for _ in range(ROUNDS):
        flat = likelihood.reshape(-1)
        front, back = fit_mixture(colors, flat**2), fit_mixture(colors, (1 - flat) ** 2)
        odds = np.clip(front.log_density(colors) - back.log_density(colors), -MAX_LOG_ODDS, MAX_LOG_ODDS)
        logits = PRIOR * _logit(initial) + (1 - PRIOR) * odds.reshape(initial.shape)
        likelihood = np.stack([random_walk(frame, _sigmoid(x)) for frame, x in zip(lab, logits, strict=True)])
    return Segmentation(likelihood, _separation(odds, likelihood.reshape(-1) > 0.5))


def estimate_saliency(lab: Float[ndarray, "h w 3"]) -> Float[ndarray, "h w"]:
    """Estimate how much every pixel stands out from the regions connected to the border, in [0, 1]."""
    labels = np.unique(slic(lab, SUPERPIXELS, COMPACTNESS, convert2lab=False, channel_axis=-1), return_inverse=True)[1]
    labels = labels.reshape(lab.shape[:2])
    regions = int(labels.max()) + 1
    sizes = np.bincount(labels.ravel(), minlength=regions).astype(np.float64)
    means = np.stack([np.bincount(labels.ravel(), lab[..., c].ravel(), regions) / sizes for c in range(3)], 1)
    rows, columns = np.mgrid[-1 : 1 : lab.shape[0] * 1j, -1 : 1 : lab.shape[1] * 1j]
    positions = np.stack([np.bincount(labels.ravel(), axis.ravel(), regions) / sizes for axis in (columns, rows)], 1)
    distances = np.linalg.norm(means[:, None] - means[None], axis=-1)
    pairs = _neighbors(labels)
    edge = np.isin(np.arange(regions), np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))

    background = _background(distances, pairs, edge)
    near = np.exp(-((positions[:, None] - positions[None]) ** 2).sum(-1) / 2 / (2 * NEIGHBORHOOD) ** 2)
    contrast = (distances * near * background).sum(1) * np.exp(-((positions / CENTER) ** 2).sum(1) / 4)
    contrast = (contrast - contrast.min()) / max(float(np.ptp(contrast)), 1e-9)

    links = np.exp(-(distances[pairs[:, 0], pairs[:, 1]] ** 2) / (2 * GEODESIC**2)) + 0.1
    laplacian = _laplacian(pairs, links, regions)
    solved = spsolve((laplacian + sparse.diags(background + contrast + 1e-6)).tocsc(), contrast)
    solved = (solved - solved.min()) / max(float(np.ptp(solved)), 1e-9)
    return solved[labels]


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


def random_walk(lab: Float[ndarray, "h w 3"], prior: Float[ndarray, "h w"]) -> Float[ndarray, "h w"]:
    """Smooth a prior probability map within the edges of the image."""
    height, width = prior.shape
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
    smooth: Float[ndarray, "h w"] = spsolve(system, prior.ravel(), permc_spec="MMD_AT_PLUS_A").reshape(height, width)
    return smooth.clip(0, 1)


def _background(distances: Float[ndarray, "r r"], pairs: Int[ndarray, "e 2"], edge: ndarray) -> Float[ndarray, " r"]:
    """Return the probability that each region is background, from its boundary connectivity."""
    regions = len(edge)
    costs = np.maximum(distances[pairs[:, 0], pairs[:, 1]] - SAME_COLOR, 0) + 1e-6
    graph = sparse.coo_matrix((costs, (pairs[:, 0], pairs[:, 1])), (regions, regions)).tocsr()
    reach = np.exp(-(csgraph.dijkstra(graph, directed=False) ** 2) / (2 * GEODESIC**2))
    connectivity = reach[:, edge].sum(1) / np.sqrt(reach.sum(1))
    return 1 - np.exp(-(connectivity**2) / 2)


def _neighbors(labels: Int[ndarray, "h w"]) -> Int[ndarray, "e 2"]:
    """Return pairs of adjacent regions, each once."""
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
        spreads[k] = (offset * share[:, k : k + 1]).T @ offset / total[k] + MIN_VARIANCE * np.eye(3)
    log_norms = -0.5 * np.linalg.slogdet(spreads)[1] - 1.5 * np.log(2 * np.pi)
    return Mixture(total / total.sum(), means, np.linalg.cholesky(np.linalg.inv(spreads)), log_norms)


def _separation(odds: Float[ndarray, " p"], subject: ndarray) -> float:
    """Return the area under the ROC curve: the Mann-Whitney statistic of the odds inside against outside."""
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
