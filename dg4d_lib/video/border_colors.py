"""Colors that the border of the frames lacks: parts that a segmentation misses, and evidence where it is unsure."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy import ndimage
from scipy.spatial import cKDTree

from dg4d_lib.video.backdrop import border_ring

RING = 0.05  # width of the ring whose colors count as background, as a share of the longest side
SAMPLES = 20000  # colors of the ring
NEIGHBOR = 4  # distances are those to the fourth nearest color: one speck in the ring is no evidence
TOLERANCE = 2.5, 12.0  # minimum and maximum distance from which a color is none of the ring's, Lab units
KNOWN_SHARE = 0.98  # share of one half of the ring's colors that lie within the tolerance of the other half
DISTANCE = 2.6  # minimum median distance of a part's colors, in tolerances
CONTRAST = 7.0  # minimum median gradient along a part's outline, Lab units per pixel; shadows and clouds are softer
OUTLINE = 2  # width of the band around the segmentation that is left to its refinement, pixels
MAX_ADDED = 2.0  # maximum area of all parts relative to the segmentation
LARGE = 0.25  # minimum area of a part relative to the largest one, where nothing was segmented
CONFIDENT = 0.05, 0.8  # probabilities below and above which a segmentation is sure of background and subject
FEWEST = 50  # minimum number of such pixels of each
RAREST = 0.1  # minimum likelihood of either kind of color, in both: U2-Netp is surer than it is right
LIKE_SHARE = 0.5  # weight of colors that the border has: subjects have patches of them
SQUARE = np.ones((3, 3), bool)  # a pixel and its neighbors


@dataclass(frozen=True)
class BorderDistances:
    """Distances of the colors of all frames to those along their border.

    Attributes:
        values: to the fourth nearest color of the border, Lab units.
        tolerance: distance from which a color is none of the border's.
    """

    values: Float[ndarray, "t h w"]
    tolerance: float

    @classmethod
    def of(cls, lab: Float[ndarray, "t h w 3"]) -> "BorderDistances":
        """Measure frames in CIE Lab; all of them share the colors of their border."""
        height, width = lab.shape[1:3]
        colors = lab[:, border_ring(height, width, RING)].reshape(-1, 3)
        colors = colors[:: max(1, len(colors) // SAMPLES)]
        to_other_half = _distance(_tree(colors[::2]), colors[1::2])
        tree, values = _tree(colors), np.empty(lab.shape[:3], np.float32)
        for frame, distances in zip(lab, values, strict=True):
            distances[:] = _distance(tree, frame.reshape(-1, 3)).reshape(height, width)
        return cls(values, float(np.clip(np.quantile(to_other_half, KNOWN_SHARE), *TOLERANCE)))

    def unlike(self, frame: int) -> Bool[ndarray, "h w"]:
        """Mark the pixels of a frame whose colors are none of the border's."""
        return np.asarray(self.values[frame] > self.tolerance)


def missing_parts(
    lab: Float[ndarray, "t h w 3"], border: BorderDistances, found: Bool[ndarray, "t h w"]
) -> Bool[ndarray, "t h w"]:
    """Mark parts of the subject that are missing in a segmentation.

    Args:
        lab: frames in CIE Lab.
        border: of these frames.
        found: segmentation.

    Returns:
        Pixels to add: parts that touch the segmentation, or the largest parts if it is empty in all frames. None in
        frames where they are more than twice its area.
    """
    seeded = bool(found.any())
    frames = zip(lab, border.values, found, strict=True)
    return np.stack([_missing(frame, values, mask, border.tolerance, seeded) for frame, values, mask in frames])


def color_evidence(border: BorderDistances, probability: Float[ndarray, "t h w"]) -> Float[ndarray, "t h w"]:
    """Return the log likelihood ratio of subject and background for every pixel, by whether the border has its color.

    Both likelihoods are estimated in every frame, from the pixels of which a segmentation is sure. Ratios are 0 where
    there are too few of these, and where the subject has colors of the border as often as the background.

    Args:
        border: of the frames.
        probability: of the subject.
    """
    evidence = np.zeros(probability.shape)
    for frame, known in enumerate(probability):
        mask = border.unlike(frame)
        unlike = ndimage.binary_opening(mask, SQUARE[:2, :2])
        subject, background = unlike[known > CONFIDENT[1]], unlike[known < CONFIDENT[0]]
        if min(len(subject), len(background)) < FEWEST:
            continue
        of_subject, of_background = np.clip([subject.mean(), background.mean()], RAREST, 1 - RAREST)
        if of_subject > of_background:
            like = ~ndimage.binary_dilation(mask, SQUARE)  # thin parts and outlines are neither
            against = LIKE_SHARE * np.log((1 - of_subject) / (1 - of_background))
            evidence[frame] = unlike * np.log(of_subject / of_background) + like * against
    return evidence


def _missing(
    lab: Float[ndarray, "h w 3"],
    distances: Float[ndarray, "h w"],
    found: Bool[ndarray, "h w"],
    tolerance: float,
    seeded: bool,
) -> Bool[ndarray, "h w"]:
    """Mark the missing parts of one frame.

    Args:
        lab: frame.
        distances: of its colors to those of the border.
        found: segmentation.
        tolerance: distance from which a color is none of the ring's.
        seeded: True to mark parts that touch the segmentation, False to mark the largest parts.
    """
    distance = np.where(found, 0, distances)
    unlike = ndimage.binary_opening(distance > tolerance, SQUARE[:2, :2])
    beside = unlike & ~ndimage.binary_dilation(found, iterations=OUTLINE)
    if seeded:
        joined, _ = ndimage.label(unlike | found, SQUARE)
        beside &= np.isin(joined, np.unique(joined[found]))
    parts, count = ndimage.label(beside, SQUARE)
    if not count:
        return beside
    numbers = np.arange(1, count + 1)
    outline = np.where(ndimage.binary_erosion(unlike | found, border_value=1), 0, parts)
    slope = np.linalg.norm([ndimage.gaussian_gradient_magnitude(lab[..., c], 0.7) for c in range(3)], axis=0)
    sharp = np.nan_to_num(ndimage.median(ndimage.maximum_filter(slope, 3), outline, numbers)) >= CONTRAST
    fitting = sharp & (ndimage.median(distance, parts, numbers) >= DISTANCE * tolerance)
    if not seeded:
        areas = ndimage.sum_labels(beside, parts, numbers) * fitting
        return np.isin(parts, numbers[fitting & (areas >= LARGE * areas.max())])
    kept = np.isin(parts, numbers[fitting])
    added = kept | (ndimage.binary_dilation(kept, iterations=OUTLINE + 1) & unlike)
    return added if added.sum() <= MAX_ADDED * found.sum() else np.zeros_like(found)


def _tree(colors: Float[ndarray, "p 3"]) -> cKDTree:
    """Return a tree of colors; of equal ones, which are slow to search, as many as count."""
    distinct, counts = np.unique(colors, axis=0, return_counts=True)
    return cKDTree(np.repeat(distinct, np.minimum(counts, NEIGHBOR), axis=0))


def _distance(tree: cKDTree, colors: Float[ndarray, "p 3"]) -> Float[ndarray, " p"]:
    """Return the distance of colors to the fourth nearest one of a tree, Lab units."""
    distances, _ = tree.query(colors, k=[NEIGHBOR])
    return np.asarray(distances)[:, 0]
