"""Removal of handles that no view shows: tunnels through the body of a density field are filled.

The Gaussians of a fit leave gaps where parts of a body meet, such as a leg and the belly, and the surface gets a handle
around every gap. Silhouettes hide these tunnels, light shows them.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.kernels.compiling import njit
from dg4d_lib.mesh.extraction.density import DensityField
from dg4d_lib.mesh.extraction.extract import surrounding_silhouettes
from dg4d_lib.mesh.extraction.solid import ambiguous, cavities
from dg4d_lib.mesh.shifts import shifted
from dg4d_lib.rasterizer.interface import Rasterizer

RADII = (1, 2, 3, 4)  # cells; tunnels narrower than twice the last are filled, the narrowest first
INSIDE = 1.3  # density of filled samples, of the level: the surface over them lies between the samples
COVERED = 0.75  # smallest share of a filled tunnel that every view sees covered

View = tuple[OrbitCamera, Bool[np.ndarray, "h w"]]  # with the silhouette that it shows


def fill_tunnels(field: DensityField, level: float, gaussians: Gaussians, rasterize: Rasterizer) -> DensityField:
    """Return the field with narrow tunnels filled, except those that are open in some view.

    A morphological closing (dilation by a ball, then erosion) gives the candidates; those that lower the genus are
    filled. So are cavities, which hide tunnels, and `ambiguous` samples, of which the interpolation makes handles.

    Args:
        field: the density of these Gaussians.
        level: density of the surface.
        gaussians: one state; their silhouettes tell which tunnels are seen.
        rasterize: the splatting backend.
    """
    inside = field.values.numpy() >= level
    if not inside.any():
        return field
    (body,), margin = ndimage.find_objects(inside.astype(np.int8)), RADII[-1] + 2
    origin = field.origin.double().numpy() + (np.array([side.start for side in body]) - margin) * field.cell
    padded = np.pad(field.values.numpy()[body], margin)
    cameras, silhouettes = surrounding_silhouettes(gaussians, rasterize)
    views = list(zip(cameras, silhouettes.numpy(), strict=True))
    fillings = (
        lambda: _hidden_tunnels(padded >= level, origin, field.cell, views),
        lambda: cavities(padded >= level),
        lambda: ambiguous(padded, level),
    )
    changed = True
    while changed:
        changed = False
        for find in fillings:
            filled = find()
            padded[filled] = INSIDE * level
            changed |= bool(filled.any())
    values = field.values.clone()
    values[body] = torch.from_numpy(padded[(slice(margin, -margin),) * 3])
    return replace(field, values=values)


def _hidden_tunnels(
    solid: Bool[np.ndarray, "i j k"], origin: Float[np.ndarray, " 3"], cell: float, views: Sequence[View]
) -> Bool[np.ndarray, "i j k"]:
    """Mark narrow tunnels that are covered in all views."""
    filled = solid.copy()
    for radius in RADII:
        candidates, _ = ndimage.label(_closed(filled, radius) & ~filled)
        for number, place in enumerate(ndimage.find_objects(candidates), 1):
            samples = np.argwhere(candidates[place] == number) + [side.start for side in place]
            if euler_gain(filled, candidates, samples) <= 0:
                continue
            if _least_covered(origin + samples * cell, views) >= COVERED:
                filled[tuple(samples.T)] = True
    return filled & ~solid


def _closed(solid: Bool[np.ndarray, "i j k"], radius: int) -> Bool[np.ndarray, "i j k"]:
    return ~dilated(~dilated(solid, radius), radius)


def dilated(solid: Bool[np.ndarray, "i j k"], radius: int) -> Bool[np.ndarray, "i j k"]:
    """Mark the samples within a distance, in cells, of solid ones: faster than scipy's distances for small radii."""
    lines = {0: solid}  # by reach along the last axis
    for reach in range(1, radius + 1):
        lines[reach] = lines[reach - 1].copy()
        for step in (-reach, reach):
            onto, source = shifted((0, 0, step))
            lines[reach][onto] |= solid[source]
    ball, steps = np.zeros_like(solid), range(-radius, radius + 1)
    for i, j in itertools.product(steps, steps):
        if i * i + j * j <= radius * radius:
            onto, source = shifted((i, j, 0))
            ball[onto] |= lines[math.isqrt(radius * radius - i * i - j * j)][source]
    return ball


@njit(cache=True, nogil=True)
@no_type_check
def euler_gain(solid, labels, samples):
    """Return by how much the Euler characteristic grows when one part of the samples becomes solid.

    Samples are closed cubes, so those that share a corner are connected. New corners and faces count 1, new edges and
    cubes -1.

    Args:
        solid: whether a sample is solid: "i j k"; its border is not.
        labels: number of the part that a sample belongs to: "i j k".
        samples: those of one part, in the order of the array: "p 3".
    """
    gain, part = 0, labels[samples[0, 0], samples[0, 1], samples[0, 2]]
    for i, j, k in samples:
        for a in range(-1, 2):
            for b in range(-1, 2):
                for c in range(-1, 2):
                    if _is_new(solid, labels, part, i, j, k, a, b, c):
                        gain += 1 - 2 * ((a == 0) ^ (b == 0) ^ (c == 0))
    return gain


@njit(cache=True, nogil=True)
@no_type_check
def _is_new(solid, labels, part, i, j, k, a, b, c):
    """Return whether the corner, edge, face or cube of a sample towards (a, b, c) is of no solid or earlier sample."""
    for x in range(min(a, 0), max(a, 0) + 1):
        for y in range(min(b, 0), max(b, 0) + 1):
            for z in range(min(c, 0), max(c, 0) + 1):
                if solid[i + x, j + y, k + z]:
                    return False
                earlier = x < 0 or (x == 0 and (y < 0 or (y == 0 and z < 0)))
                if earlier and labels[i + x, j + y, k + z] == part:
                    return False
    return True


def _least_covered(positions: Float[np.ndarray, "p 3"], views: Sequence[View]) -> float:
    """Return the share of the positions that lie within a silhouette, in the view where fewest do."""
    shares = []
    for camera, mask in views:
        matrix = camera.viewmat().numpy()
        seen = positions @ matrix[:3, :3].T + matrix[:3, 3]
        pixels = np.floor(seen[:, :2] / seen[:, 2:] * camera.focal + 0.5 * np.array([camera.width, camera.height]))
        columns, rows = pixels.astype(int).clip(0, np.array(mask.shape)[::-1] - 1).T
        shares.append(float(mask[rows, columns].mean()))
    return min(shares)
