"""Upright mirror plane of a subject, from points on its surface."""

import math

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

POINTS = 1500  # that are compared, at most
STEP_DEG, FINE_DEG = 4.0, 1.0  # steps of the search of the azimuth, coarse and fine
OFFSETS = np.linspace(-0.1, 0.1, 13)  # of the plane from the median, in units of the extent
FAR = 0.04  # of the extent: distance from which a mirrored point has no partner
SYMMETRIC = 0.9  # of the median error over all azimuths, below which there is a mirror plane
APART_DEG, CLEARLY = 30.0, 1.05  # angle from which a plane is another one, and by how much it must be worse


def mirror_normal(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " 3"] | None:
    """Return the normal of the upright plane that mirrors points best, or None if none does clearly better than others.

    Args:
        points: on the surface of a subject, y up.

    Returns:
        Horizontal unit vector, its z not negative.
    """
    chosen = points[:: max(1, -(-len(points) // POINTS))]
    coarse = np.arange(0.0, 180.0, STEP_DEG) - 90
    errors = mirror_errors(chosen, coarse)
    fine = coarse[int(errors.argmin())] + np.arange(-STEP_DEG, STEP_DEG, FINE_DEG)
    finer = mirror_errors(chosen, fine)
    turn = np.abs(coarse - coarse[int(errors.argmin())])
    others = errors[np.minimum(turn, 180 - turn) >= APART_DEG]
    if finer.min() >= min(SYMMETRIC * float(np.median(errors)), float(others.min()) / CLEARLY):
        return None
    normal = _horizontal(float(fine[int(finer.argmin())]))
    return -normal if normal[2] < 0 else normal


def mirror_errors(points: Float[np.ndarray, "n 3"], azimuths_deg: Float[np.ndarray, " a"]) -> Float[np.ndarray, " a"]:
    """Return how badly upright planes mirror points, at their best offsets.

    Args:
        points: on the surface of a subject, y up.
        azimuths_deg: of the normals of the planes, 0 on +z and 90 on +x.

    Returns:
        Mean distance of mirrored points to the nearest ones, in units of `FAR`, in [0, 1].
    """
    tree, extent = cKDTree(points), float(np.linalg.norm(np.ptp(points, axis=0))) + 1e-12
    errors = np.empty(len(azimuths_deg))
    for number, azimuth in enumerate(azimuths_deg):
        normal = _horizontal(float(azimuth))
        places = points @ normal
        offsets = np.median(places) + OFFSETS * extent
        mirrored = points - 2 * (places - offsets[:, None])[..., None] * normal
        distances = tree.query(mirrored)[0] / (FAR * extent)
        errors[number] = np.minimum(distances, 1).mean(1).min()
    return errors


def _horizontal(azimuth_deg: float) -> Float[np.ndarray, " 3"]:
    return np.array([math.sin(math.radians(azimuth_deg)), 0.0, math.cos(math.radians(azimuth_deg))])
