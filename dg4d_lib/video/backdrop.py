"""Segmentation in front of a plain backdrop: a smooth color model for all frames, and a flood fill from the border.

The backdrop's color is a low-degree polynomial in x and y, fitted robustly to the border, so gradients and vignettes
count as plain and the subject may touch the border. Pixels that the flood fill reaches are backdrop, including soft
shadows.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy import ndimage
from scipy.spatial import cKDTree

BORDER = 0.02  # width of the ring that the model is fitted to, as a share of the longest side
BORDER_DEGREE = 2  # degree of the polynomial fitted to the ring
FLOODED_DEGREE = 4  # degree of the polynomial fitted to the whole backdrop
PLAIN_SHARE = 0.6  # minimum share of the ring that agrees with the model of a plain backdrop
PLAIN_SPREAD = 6.0  # maximum spread of a plain backdrop, Lab units
EVEN_SPREAD = 2.4  # Lab units; studio backdrops with camera and JPEG noise are below, skies can be above
EVEN_SHARE = 0.9  # share of agreement from which a backdrop counts as even at any spread
TOLERANCE = (5.0, 14.0)  # minimum and maximum color tolerance, Lab units
SPREADS = 4.0  # tolerance in units of the spread
SHADOW_DROP = 35.0  # maximum darkening by a shadow, L* units
SHADOW_SLOPE = 1.6  # maximum lightness gradient of a shadow, L* per pixel; outlines are steeper
MAX_SHADOW = 0.4  # maximum share of the foreground that may be shadow; beyond, it is a pale subject
HOLE = 0.0006  # share of the subject; smaller spots of the backdrop's color are highlights, not gaps between limbs
SPOTS = 8  # minimum number of small parts, in every frame, that are a pattern
SPOTTED = 0.05  # their minimum area relative to the subject
SAMPLES = 20000  # pixels per fit


@dataclass(frozen=True)
class Backdrop:
    """Polynomial color model of a backdrop.

    Attributes:
        weights: of the monomials x^i y^j, i + j <= degree, per Lab channel; x and y in [-1, 1].
        degree: of the polynomial.
        spread: robust standard deviation of the residual, Lab units.
        share: share of the border that agrees with the model.
    """

    weights: Float[ndarray, "k 3"]
    degree: int
    spread: float
    share: float

    @property
    def is_plain(self) -> bool:
        """True if the border is plain enough for segmentation by color."""
        return self.share >= PLAIN_SHARE and self.spread <= PLAIN_SPREAD

    @property
    def is_even(self) -> bool:
        """True if the border is so even that the segmentation is reliable."""
        return self.is_plain and (self.spread <= EVEN_SPREAD or self.share >= EVEN_SHARE)

    @property
    def is_uniform(self) -> bool:
        """True if the border has no texture but noise."""
        return self.is_plain and self.spread <= EVEN_SPREAD

    @property
    def tolerance(self) -> float:
        """Color difference in Lab units below which a pixel is backdrop."""
        return float(np.clip(SPREADS * self.spread, *TOLERANCE))

    def color(self, height: int, width: int) -> Float[ndarray, "h w 3"]:
        """Evaluate the model at all pixels, Lab."""
        powers = np.arange(self.degree + 1)
        x, y = (np.linspace(-1, 1, side)[:, None] ** powers for side in (width, height))
        terms = np.zeros((self.degree + 1, self.degree + 1, 3))  # power of y, power of x
        for weight, (i, j) in zip(self.weights, _exponents(self.degree), strict=True):
            terms[j, i] = weight
        return np.einsum("hj,wi,jic->hwc", y, x, terms, optimize=True).astype(np.float32)


def fit_backdrop(lab: Float[ndarray, "t h w 3"]) -> Backdrop:
    """Fit a common backdrop to the borders of all frames."""
    ring = border_ring(*lab.shape[1:3])
    border = np.broadcast_to(ring, lab.shape[:3])
    first = _fit(lab, border, BORDER_DEGREE, border)
    if not first.is_plain:
        return first
    color = first.color(*lab.shape[1:3])
    flooded = np.stack([_flood(frame - color, first) for frame in lab])
    if flooded.mean() < 0.3:
        return first
    refined = _fit(lab, flooded, FLOODED_DEGREE, border)
    return refined if refined.is_plain and refined.share >= first.share - 0.05 else first


def cut_out(
    lab: Float[ndarray, "t h w 3"], backdrop: Backdrop, pattern: Bool[ndarray, "t h w"] | None = None
) -> Bool[ndarray, "t h w"]:
    """Segment the subject: pixels that the flood fill does not reach, without shadows, small holes filled.

    Args:
        lab: frames.
        backdrop: of them.
        pattern: pixels in colors of a pattern on the backdrop; the flood fill passes them.
    """
    color = backdrop.color(*lab.shape[1:3])
    differences = (frame - color for frame in lab)
    if pattern is not None:
        differences = (np.where(known[..., None], 0, one) for one, known in zip(differences, pattern, strict=True))
    return np.stack([_subject(difference, backdrop) for difference in differences])


def has_pattern(subject: Bool[ndarray, "t h w"], spots: Bool[ndarray, "t h w"]) -> bool:
    """Return True if small parts beside a subject are so many that they are a pattern of the backdrop."""
    counts = [ndimage.label(frame)[1] for frame in spots]
    return min(counts) >= SPOTS and bool(spots.sum() >= SPOTTED * subject.sum())


def colored_alike(lab: Float[ndarray, "t h w 3"], where: Bool[ndarray, "t h w"]) -> Bool[ndarray, "t h w"]:
    """Mark all pixels that have the color of a marked one."""
    colors = lab[where]
    tree = cKDTree(np.unique(colors[:: max(1, len(colors) // SAMPLES)], axis=0))
    distances = (tree.query(frame, distance_upper_bound=TOLERANCE[0])[0] for frame in lab)
    return np.stack([np.isfinite(distance) for distance in distances])


def border_ring(height: int, width: int, share: float = BORDER) -> Bool[ndarray, "h w"]:
    """Mark the pixels along the edge of a frame, in a ring whose width is a share of the longest side."""
    margin = max(2, round(share * max(height, width)))
    ring = np.ones((height, width), bool)
    ring[margin : height - margin, margin : width - margin] = False
    return ring


def _subject(difference: Float[ndarray, "h w 3"], backdrop: Backdrop) -> Bool[ndarray, "h w"]:
    tight = ~_flood(difference, backdrop)
    loose = ~_flood(difference, backdrop, shadows=True)
    subject = loose if loose.sum() > (1 - MAX_SHADOW) * tight.sum() else tight
    filled = ndimage.binary_fill_holes(subject)
    like_backdrop = np.linalg.norm(difference, axis=-1) < 0.7 * backdrop.tolerance
    enclosed, count = ndimage.label(filled & (like_backdrop | ~subject))
    areas = ndimage.sum_labels(np.ones_like(enclosed), enclosed, np.arange(1, count + 1))
    holes = 1 + np.flatnonzero(areas >= HOLE * subject.sum())
    return np.asarray(filled & ~np.isin(enclosed, holes))


def _flood(difference: Float[ndarray, "h w 3"], backdrop: Backdrop, shadows: bool = False) -> Bool[ndarray, "h w"]:
    """Mark pixels of the backdrop's color that connect to the border through gaps of at least three pixels."""
    like = np.linalg.norm(difference, axis=-1) < backdrop.tolerance
    if shadows:
        slope = ndimage.gaussian_gradient_magnitude(difference[..., 0], 1.0)
        chroma = np.linalg.norm(difference[..., 1:], axis=-1)
        drop = -difference[..., 0]
        like |= (chroma < 0.8 * backdrop.tolerance) & (drop > 0) & (drop < SHADOW_DROP) & (slope < SHADOW_SLOPE)
    square = np.ones((3, 3), bool)
    labels, _ = ndimage.label(ndimage.binary_erosion(like, square, border_value=1))
    edge = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    reached = np.isin(labels, np.unique(edge[edge > 0]))
    return np.asarray(ndimage.binary_dilation(reached, square) & like)


def _fit(
    lab: Float[ndarray, "t h w 3"], where: Bool[ndarray, "t h w"], degree: int, border: Bool[ndarray, "t h w"]
) -> Backdrop:
    """Fit by iteratively reweighted least squares (Cauchy weights), raising the degree from 0 to resist outliers."""
    colors, design = _sample(lab, where, degree)
    weights = np.zeros((design.shape[1], 3))
    weights[0] = np.median(colors, axis=0)
    spread = 0.0
    for order in (0, 1, *(degree,) * 8):
        terms = (order + 1) * (order + 2) // 2
        residual = np.linalg.norm(colors - design @ weights, axis=1)
        # The median norm of three normal variables is 1.5382 sigma.
        spread = max(0.5, 1.4826 * float(np.median(residual)) / 1.5382)
        trust = 1 / (1 + (residual / (2 * spread)) ** 2)
        weights = np.zeros_like(weights)
        weighted = design[:, :terms] * trust[:, None]
        normal = weighted.T @ design[:, :terms] + 1e-6 * len(colors) * np.eye(terms)
        weights[:terms] = np.linalg.solve(normal, weighted.T @ colors)
    ring_colors, ring_design = _sample(lab, border, degree)
    residual = np.linalg.norm(ring_colors - ring_design @ weights, axis=1)
    share = float((residual < max(TOLERANCE[0], 3 * spread)).mean())
    return Backdrop(weights, degree, spread, share)


def _sample(
    lab: Float[ndarray, "t h w 3"], where: Bool[ndarray, "t h w"], degree: int
) -> tuple[Float[ndarray, "s 3"], Float[ndarray, "s k"]]:
    """Return colors and monomials at an evenly spaced subset of the marked pixels."""
    height, width = lab.shape[1:3]
    times, rows, columns = np.nonzero(where)
    subset = np.arange(0, len(times), max(1, len(times) // SAMPLES))
    times, rows, columns = times[subset], rows[subset], columns[subset]
    return lab[times, rows, columns].astype(np.float64), _monomials(rows, columns, height, width, degree)


def _monomials(rows: ndarray, columns: ndarray, height: int, width: int, degree: int) -> Float[ndarray, "p k"]:
    """Evaluate the monomials 1, x, y, x^2, xy, y^2, ... at pixels, lower degrees first; x and y in [-1, 1]."""
    x, y = (2 * places / max(1, side - 1) - 1 for places, side in ((columns, width), (rows, height)))
    return np.stack([x**i * y**j for i, j in _exponents(degree)], 1)


def _exponents(degree: int) -> list[tuple[int, int]]:
    """List the powers of x and y of every monomial, lower degrees first."""
    return [(order - j, j) for order in range(degree + 1) for j in range(order + 1)]
