"""Upright mirror plane of a subject, from points on its surface."""

import math

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

POINTS = 1000  # largest number of mirrored points
STEP_DEG, FINE_DEG = 4.0, 1.0  # steps of the search of the azimuth, coarse and fine
OFFSETS = np.linspace(-0.1, 0.1, 13)  # of the plane from the median, in units of the extent
FAR = 0.04  # distance from which a mirrored point counts as unmatched, share of the extent
SYMMETRIC = 0.9  # error relative to the median over all azimuths, below which there is a mirror plane
APART_DEG, CLEARLY = 30.0, 1.1  # angle from which planes are distinct, and the least ratio of their errors


def mirror_normal(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " 3"] | None:
    """Return the normal of the upright plane that mirrors points best, or None if none does clearly better than others.

    Args:
        points: on the surface of a subject, y up.

    Returns:
        Horizontal unit vector, its z not negative.
    """
    coarse = np.arange(0.0, 180.0, STEP_DEG) - 90
    errors = mirror_errors(points, coarse)
    best = coarse[int(errors.argmin())]
    turn = np.abs(coarse - best)
    others = np.where(np.minimum(turn, 180 - turn) >= APART_DEG, errors, np.inf)
    azimuth, error = _refine_azimuth(points, best)
    _, other = _refine_azimuth(points, coarse[int(others.argmin())])
    if error >= min(SYMMETRIC * float(np.median(errors)), other / CLEARLY):
        return None
    normal = _horizontal(azimuth)
    return -normal if normal[2] < 0 else normal


def mirror_errors(points: Float[np.ndarray, "n 3"], azimuths_deg: Float[np.ndarray, " a"]) -> Float[np.ndarray, " a"]:
    """Return how badly upright planes mirror points, at their best offsets.

    Args:
        points: on the surface of a subject, y up.
        azimuths_deg: of the normals of the planes, 0 on +z and 90 on +x.

    Returns:
        Mean distance of some mirrored points to the nearest of all points, in units of `FAR`, in [0, 1].
    """
    tree, extent = cKDTree(points), float(np.linalg.norm(np.ptp(points, axis=0))) + 1e-12
    points = points[:: max(1, -(-len(points) // POINTS))]
    errors = np.empty(len(azimuths_deg))
    for number, azimuth in enumerate(azimuths_deg):
        normal = _horizontal(float(azimuth))
        places = points @ normal
        offsets = np.median(places) + OFFSETS * extent
        mirrored = points - 2 * (places - offsets[:, None])[..., None] * normal
        distances = tree.query(mirrored, distance_upper_bound=FAR * extent)[0] / (FAR * extent)  # infinite if farther
        errors[number] = np.minimum(distances, 1).mean(1).min()
    return errors


def _refine_azimuth(points: Float[np.ndarray, "n 3"], azimuth_deg: float) -> tuple[float, float]:
    """Return the best azimuth near one of the coarse search, and its error."""
    azimuths = azimuth_deg + np.arange(-STEP_DEG, STEP_DEG, FINE_DEG)
    errors = mirror_errors(points, azimuths)
    return float(azimuths[int(errors.argmin())]), float(errors.min())


def _horizontal(azimuth_deg: float) -> Float[np.ndarray, " 3"]:
    return np.array([math.sin(math.radians(azimuth_deg)), 0.0, math.cos(math.radians(azimuth_deg))])
