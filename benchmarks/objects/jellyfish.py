"""Swimming jellyfish: a contracting bell, and tentacles that follow in waves."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy import ndarray

from examples.shapes import Field, Skin, ellipsoid, mix, skin, smooth_chain, step, union

APEX = 0.62  # height of the top, object units
RIM = 0.20  # height of the rim of the bell
WALL = 0.05  # thickness
TENTACLES = 8
ARMS = 4  # number of thick arms in the middle

ROSE = np.array((0.930, 0.300, 0.480))
PLUM = np.array((0.420, 0.110, 0.520))
CREAM = np.array((0.990, 0.900, 0.760))
TEAL = np.array((0.100, 0.620, 0.640))
GOLD = np.array((0.980, 0.690, 0.180))


@dataclass(frozen=True)
class Jellyfish:
    """Jellyfish without rigid parts."""

    @cached_property
    def skin(self) -> Skin:
        """Return the surface at rest."""
        return skin(
            union([_bell, union([_tentacles(), _arms()], 0.02)], 0.03), (-0.56, -0.76, -0.56), (0.56, 0.66, 0.56)
        )

    @cached_property
    def features(self) -> ndarray:
        """Return the distances to bell, tentacles and arms at every vertex, "v 3"."""
        points = self.skin.points
        return np.stack([_bell(points), _tentacles()(points), _arms()(points)], 1)

    def at(self, time: float) -> ndarray:
        """Return the vertices at a time of the stroke; 0 and 1 are the same."""
        phase = 2 * np.pi * time
        x, y, z = self.skin.points.T
        below = APEX - y
        inside = step(0.30, 0.55, below)  # 0 at the top, 1 from the rim down
        close = 1 - 0.26 * inside * (0.5 + 0.5 * np.sin(phase - 3.0 * np.minimum(below, 0.6)))
        hanging = step(0.42, 0.30, below)
        twist = 0.50 * hanging * np.sin(phase - 4.0 * below) * below
        sway = 0.09 * hanging * np.sin(phase - 5.0 * below)
        c, s = np.cos(twist), np.sin(twist)
        rise = 0.06 * np.cos(phase) + 0.05 * (1 - inside) * np.sin(phase - 1.2)
        lean = 0.05 * np.sin(phase + 0.8)
        return np.stack([close * (c * x + s * z) + sway + lean * y, y + rise, close * (c * z - s * x) + 0.7 * sway], 1)

    def color(self, p: ndarray, features: ndarray) -> ndarray:
        """Return the paint at points of the skin at rest, "p 3"."""
        bell, tentacle, arm = features.T
        around, height = np.arctan2(p[:, 0], p[:, 2]), p[:, 1]
        out = np.hypot(p[:, 0], p[:, 2])
        paint = mix(ROSE, PLUM, step(0.42, 0.30, height - 0.05 * np.cos(3 * around)))
        rays = np.cos(16 * around)
        paint = mix(paint, CREAM, 0.85 * step(0.75, 0.3, rays) * step(0.56, 0.06, 1.14 - height) * step(0.1, 0.06, out))
        dots = np.cos(10 * around + 0.6) * np.cos(2 * np.pi * (height - 0.02) / 0.17)
        paint = mix(paint, GOLD, step(0.62, 0.2, dots) * step(0.12, 0.05, out))
        front = step(0.0, 0.25, np.cos(around) - 0.55) * step(0.36, 0.04, height) * step(-0.52, 0.04, -height)
        paint = mix(paint, TEAL, 0.9 * front * step(0.2, 0.2, np.cos(24 * height)))
        paint = mix(paint, TEAL, step(-0.235, 0.02, -height) * step(-0.02, 0.02, 0.01 - bell))
        hair = mix(GOLD, PLUM, step(0.0, 0.5, np.cos(2 * np.pi * height / 0.16)))
        paint = mix(paint, hair, step(0.0, 0.012, 0.006 - tentacle) * step(-0.20, 0.03, -height))
        frill = mix(CREAM, ROSE, step(0.0, 0.6, np.cos(2 * np.pi * height / 0.11 + 2 * around)))
        return mix(paint, frill, step(0.0, 0.012, 0.006 - arm) * step(-0.30, 0.03, -height))


def _bell(p: ndarray) -> ndarray:
    """Return a dome, hollow from below."""
    outer = ellipsoid((0, RIM, 0), (0.46, APEX - RIM, 0.46))(p)
    inner = ellipsoid((0, RIM, 0), (0.46 - WALL, APEX - RIM - 1.6 * WALL, 0.46 - WALL))(p)
    return np.maximum(np.maximum(outer, -inner), RIM - 0.03 * np.cos(8 * np.arctan2(p[:, 0], p[:, 2])) - p[:, 1])


def _tentacles() -> Field:
    chains: list[Field] = []
    for i in range(TENTACLES):
        c, s = np.cos(2 * np.pi * (i + 0.5) / TENTACLES), np.sin(2 * np.pi * (i + 0.5) / TENTACLES)
        length = 0.62 + 0.16 * (i % 2)
        joints = [(r * s, RIM + 0.03 - length * t, r * c, 0.036 - 0.014 * t) for t, r in zip(
            (0, 0.35, 0.7, 1.0), (0.42, 0.44, 0.36, 0.40), strict=True)]  # fmt: skip
        chains.append(smooth_chain(joints, 9))
    return union(chains, 0.005)


def _arms() -> Field:
    chains: list[Field] = []
    for i in range(ARMS):
        c, s = np.cos(2 * np.pi * i / ARMS), np.sin(2 * np.pi * i / ARMS)
        joints = [(r * s, y, r * c, w) for y, r, w in (
            (0.42, 0.05, 0.070), (0.10, 0.10, 0.066), (-0.22, 0.15, 0.050), (-0.52, 0.11, 0.026))]  # fmt: skip
        chains.append(smooth_chain(joints, 9))
    return union(chains, 0.02)
