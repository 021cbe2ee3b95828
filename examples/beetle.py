"""A horned beetle that stands: glossy wing cases, a horn, six jointed legs."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy import ndarray

from examples.shapes import Field, Skin, ellipsoid, mix, skin, smooth_chain, step, union

SHELL = ((-0.16, 0.05, 0.0), (0.46, 0.34, 0.33))  # center and radii
COLLAR = ((0.27, 0.00, 0.0), (0.20, 0.24, 0.25))
HEAD = ((0.47, -0.06, 0.0), (0.145, 0.135, 0.15))
HORN = ((0.50, 0.00, 0.0, 0.065), (0.62, 0.12, 0.0, 0.052), (0.66, 0.28, 0.0, 0.038), (0.59, 0.42, 0.0, 0.020))
CREST = ((0.33, 0.17, 0.0, 0.060), (0.42, 0.30, 0.0, 0.040), (0.47, 0.40, 0.0, 0.018))
LEGS = (  # hip, knee, ankle, claw on the near side
    ((0.30, -0.14, 0.16), (0.44, -0.20, 0.30), (0.49, -0.36, 0.30), (0.58, -0.40, 0.30)),
    ((0.05, -0.16, 0.20), (0.06, -0.22, 0.38), (0.04, -0.36, 0.38), (0.12, -0.41, 0.38)),
    ((-0.22, -0.14, 0.20), (-0.40, -0.20, 0.34), (-0.45, -0.36, 0.34), (-0.36, -0.41, 0.34)),
)
FAR_SHIFT = (0.09, 0.0, 0.0)  # the far legs stand a little ahead, so that all six are seen
FEELER = ((0.55, -0.02, 0.09, 0.020), (0.65, -0.03, 0.16, 0.016), (0.73, 0.03, 0.19, 0.030))
EYE = ((0.545, -0.005, 0.105), 0.048)
BELLY_LINE = -0.10  # height at which the wing cases end

VIOLET = np.array((0.330, 0.130, 0.520))
ROSE = np.array((0.800, 0.200, 0.420))
GOLD = np.array((0.990, 0.720, 0.180))
COAL = np.array((0.130, 0.085, 0.170))
RUST = np.array((0.620, 0.270, 0.120))
BONE = np.array((0.960, 0.900, 0.760))


@dataclass(frozen=True)
class Beetle:
    """The animal, standing still."""

    def field(self) -> Field:
        """Signed distance to its skin."""
        feelers = [smooth_chain([(x, y, side * z, r) for x, y, z, r in FEELER], 8) for side in (1, -1)]
        eyes = [ellipsoid((EYE[0][0], EYE[0][1], side * EYE[0][2]), (EYE[1],) * 3) for side in (1, -1)]
        body = union([ellipsoid(*SHELL), ellipsoid(*COLLAR), ellipsoid(*HEAD)], 0.035)
        horns = union([smooth_chain(HORN, 14), smooth_chain(CREST, 8)], 0.02)
        return union([union([body, horns], 0.05), self._legs(), union([*feelers, *eyes], 0.004)], 0.015)

    @cached_property
    def skin(self) -> Skin:
        """The surface."""
        return skin(self.field(), (-0.68, -0.48, -0.46), (0.80, 0.48, 0.46))

    @cached_property
    def features(self) -> ndarray:
        """Distances to legs, horns and wing cases at every vertex, "v 3"."""
        points = self.skin.points
        horns = np.minimum(smooth_chain(HORN, 14)(points), smooth_chain(CREST, 8)(points))
        return np.stack([self._legs()(points), horns, ellipsoid(*SHELL)(points)], 1)

    def at(self, moment: float) -> ndarray:
        """Return the vertices at rest: it stands still at every moment."""
        return self.skin.points

    def color(self, p: ndarray, features: ndarray) -> ndarray:
        """Paint, "p 3"."""
        leg, horn, shell = features.T
        q = p * (1, 1, 0) + np.abs(p) * (0, 0, 1)
        paint = mix(VIOLET, ROSE, step(0.0, 0.5, 0.12 - q[:, 1] + 0.35 * q[:, 0]))
        bands = np.cos(2 * np.pi * (2.6 * q[:, 0] + 0.10 * np.cos(9 * q[:, 1]) + 0.35))
        on_shell = step(0.0, 0.02, 0.016 - shell) * step(0.12, 0.02, 0.235 - q[:, 0])
        paint = mix(paint, GOLD, step(0.55, 0.10, bands) * on_shell * step(0.02, 0.015, q[:, 2]))
        paint = mix(paint, COAL, step(-0.010, 0.008, -q[:, 2]) * on_shell)
        paint = mix(paint, COAL, step(-0.014, 0.010, -np.abs(q[:, 0] - 0.118)) * step(-0.02, 0.02, 0.03 - shell))
        paint = mix(paint, RUST, step(BELLY_LINE, 0.03, -q[:, 1] + 2 * BELLY_LINE))
        paint = mix(paint, COAL, step(0.36, 0.03, q[:, 0]) * step(-0.30, 0.10, 0.2 - q[:, 1]))
        paint = mix(paint, BONE, step(0.0, 0.01, 0.006 - horn) * step(0.08, 0.25, q[:, 1]))
        paint = mix(paint, COAL, step(0.0, 0.006, 0.004 - leg) * step(-0.02, 0.03, shell))
        paint = mix(paint, GOLD, step(0.335, 0.02, -q[:, 1]))
        return self._eye(q, paint)

    def _eye(self, q: ndarray, paint: ndarray) -> ndarray:
        offset = q - EYE[0]
        distance = np.linalg.norm(offset, axis=1)
        direction = offset / np.maximum(distance, 1e-9)[:, None]
        shine = np.arccos(np.clip(direction @ np.array((0.15, 0.45, 0.88)), -1, 1))
        eye = mix(np.array((0.10, 0.35, 0.30)), np.ones(3), step(-0.35, 0.1, -shine))
        return mix(paint, eye, step(-EYE[1] - 0.004, 0.004, -distance))

    def _legs(self) -> Field:
        radii = (0.060, 0.042, 0.030, 0.018)
        chains: list[Field] = []
        for joints in LEGS:
            for side in (1, -1):
                shift = np.array(FAR_SHIFT) if side < 0 else np.zeros(3)
                placed = [(*(np.array(j) * (1, 1, side) + shift), r) for j, r in zip(joints, radii, strict=True)]
                chains.append(smooth_chain(placed, 16))
        return union(chains, 0.01)
