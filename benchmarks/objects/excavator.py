"""Digging excavator: rigid parts on a chain of hinges."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy import ndarray

from examples.shapes import Field, Skin, ellipsoid, mix, skin, smooth_chain, step, turn_about_z, union

PIVOT = np.array((-0.16, 0.0, 0.0))  # vertical axis of the house
BOOM = np.array((0.07, -0.19, -0.07))  # hinge at the house
STICK = np.array((0.50, 0.27, -0.07))  # hinge at the end of the boom
BUCKET = np.array((0.63, -0.09, -0.07))  # hinge at the end of the stick
TURN, LIFT, CRANE, SCOOP = 0.55, 0.20, 0.34, 0.55  # amplitudes, radians
RISE = np.array((0.0, 0.10, 0.0))  # centers it at the origin
SIZE = 0.92  # scale, so that it stays in the frame

YELLOW = np.array((0.960, 0.700, 0.060))
ORANGE = np.array((0.900, 0.380, 0.060))
COAL = np.array((0.110, 0.115, 0.130))
STEEL = np.array((0.520, 0.560, 0.600))
GLASS = np.array((0.360, 0.680, 0.830))
WHITE = np.array((0.950, 0.950, 0.930))


@dataclass(frozen=True)
class Excavator:
    """Excavator on its tracks."""

    @cached_property
    def parts(self) -> list[Skin]:
        """Return tracks, house, boom, stick and bucket at rest, each closed."""
        boxes = (
            (_tracks, (-0.62, -0.56, -0.36), (0.34, -0.28, 0.36)),
            (_house, (-0.62, -0.40, -0.30), (0.20, 0.28, 0.30)),
            (_boom, (-0.02, -0.30, -0.18), (0.62, 0.42, 0.04)),
            (_stick, (0.40, -0.20, -0.18), (0.75, 0.40, 0.04)),
            (_bucket, (0.44, -0.38, -0.25), (0.78, -0.02, 0.11)),
        )
        return [skin(field, low, high) for field, low, high in boxes]

    @cached_property
    def part(self) -> ndarray:
        """Return the part of every vertex, "v"."""
        return np.repeat(np.arange(len(self.parts)), [len(part.points) for part in self.parts])

    @cached_property
    def skin(self) -> Skin:
        """Return all parts at rest."""
        firsts = np.cumsum([0, *(len(part.points) for part in self.parts)])
        faces = [part.faces + first for part, first in zip(self.parts, firsts, strict=False)]
        points, openness = (
            np.concatenate([getattr(part, name) for part in self.parts]) for name in ("points", "openness")
        )
        return Skin(points, np.concatenate(faces), openness)

    @cached_property
    def features(self) -> ndarray:
        """Return the part number of every vertex, "v 1"; no triangle has two."""
        return self.part[:, None].astype(float)

    def at(self, time: float) -> ndarray:
        """Return the vertices at a time of the cycle; 0 and 1 are the same."""
        phase = 2 * np.pi * time
        house = _hinge(PIVOT, _turn_about_y(TURN * np.sin(phase)))
        boom = _chained(house, _hinge(BOOM, turn_about_z(LIFT * np.sin(phase + 1.3) - 0.05)))
        stick = _chained(boom, _hinge(STICK, turn_about_z(CRANE * np.cos(phase + 0.4))))
        bucket = _chained(stick, _hinge(BUCKET, turn_about_z(SCOOP * np.sin(phase) - 0.1)))
        moves: list[Callable[[ndarray], ndarray]] = [lambda p: p, house, boom, stick, bucket]
        placed = [move(part.points) for move, part in zip(moves, self.parts, strict=True)]
        return SIZE * (np.concatenate(placed) + RISE)

    def color(self, p: ndarray, features: ndarray) -> ndarray:
        """Return the paint at points of the skin at rest, "p 3"."""
        painters = (_paint_tracks, _paint_house, _paint_arm, _paint_arm, _paint_bucket)
        paint, part = np.zeros_like(p), features[:, 0].round()
        for number, painter in enumerate(painters):
            paint[part == number] = painter(p[part == number])
        return paint


def _turn_about_y(angle: float) -> ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def _hinge(center: ndarray, turn: ndarray) -> Callable[[ndarray], ndarray]:
    return lambda p: (p - center) @ turn.T + center


def _chained(outer: Callable[[ndarray], ndarray], inner: Callable[[ndarray], ndarray]) -> Callable[[ndarray], ndarray]:
    return lambda p: outer(inner(p))


def _block(center: tuple[float, float, float], half: tuple[float, float, float], radius: float) -> Field:
    """Return a box with rounded edges."""

    def field(p: ndarray) -> ndarray:
        q = np.abs(p - np.array(center)) - (np.array(half) - radius)
        return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0) - radius

    return field


_tracks = union(
    [
        *(_block((-0.14, -0.43, side * 0.22), (0.44, 0.105, 0.085), 0.084) for side in (1, -1)),
        _block((-0.16, -0.40, 0), (0.20, 0.07, 0.2), 0.03),
    ],
    0.01,
)
_house = union(
    [
        _block((-0.20, -0.23, 0), (0.34, 0.075, 0.25), 0.03),
        _block((-0.40, -0.10, 0), (0.17, 0.13, 0.23), 0.05),
        _block((-0.02, -0.01, 0.11), (0.13, 0.20, 0.115), 0.04),
        smooth_chain(((-0.44, 0.0, -0.12, 0.028), (-0.44, 0.17, -0.12, 0.028)), 4),
    ],
    0.012,
)
_boom = smooth_chain(((*BOOM, 0.070), (0.17, 0.10, -0.07, 0.078), (0.31, 0.29, -0.07, 0.072), (*STICK, 0.055)), 16)
_stick = smooth_chain(((0.45, 0.33, -0.07, 0.042), (*STICK, 0.058), (*BUCKET, 0.042)), 10)


_cup_outside = _block((0.61, -0.19, -0.07), (0.115, 0.115, 0.125), 0.05)
_cup_inside = _block((0.57, -0.21, -0.07), (0.125, 0.09, 0.095), 0.04)
_bucket = union(
    [
        lambda p: np.maximum(_cup_outside(p), -_cup_inside(p)),  # opens towards the house
        *(smooth_chain(((0.53, -0.29, z, 0.024), (0.475, -0.30, z, 0.016)), 3) for z in (-0.16, -0.07, 0.02)),
        ellipsoid(BUCKET, (0.05, 0.05, 0.05)),
    ],
    0.01,
)


def _paint_tracks(p: ndarray) -> ndarray:
    along = np.arctan2(p[:, 1] + 0.43, p[:, 0] + 0.14) * 0.02 + p[:, 0]
    paint = mix(COAL, STEEL, 0.75 * step(0.3, 0.3, np.cos(2 * np.pi * along / 0.085)))
    side = np.abs(p[:, 2]) - 0.275
    wheels = np.min([np.hypot(p[:, 0] - x, p[:, 1] + 0.43) for x in (-0.46, -0.25, -0.03, 0.18)], 0)
    paint = mix(paint, COAL, step(0.0, 0.01, side))
    paint = mix(paint, YELLOW, step(0.0, 0.01, side) * step(-0.068, 0.01, -wheels))
    return mix(paint, COAL, step(0.0, 0.01, side) * step(-0.026, 0.01, -wheels))


def _paint_house(p: ndarray) -> ndarray:
    x, y, z = p.T
    paint = mix(np.broadcast_to(YELLOW, p.shape), COAL, step(0.185, 0.01, -y))
    stripes = step(0.0, 0.25, np.cos(2 * np.pi * (x + y + z) / 0.11))
    paint = mix(paint, mix(COAL, WHITE, stripes), step(0.545, 0.008, -x) * step(-0.03, 0.01, -y))
    louvers = step(0.1, 0.5, np.cos(2 * np.pi * y / 0.05))
    grille = (
        step(-0.10, 0.008, -np.abs(x + 0.40)) * step(-0.075, 0.008, -np.abs(y + 0.09)) * step(0.215, 0.008, np.abs(z))
    )
    paint = mix(paint, mix(ORANGE, COAL, louvers), grille)
    cab = step(-0.17, 0.008, x) * step(-0.01, 0.008, z)
    side = step(-0.095, 0.008, -np.abs(x + 0.02)) * step(0.205, 0.006, z)
    ends = step(-0.08, 0.006, -np.abs(z - 0.11)) * step(0.12, 0.006, np.abs(x + 0.02))
    window = np.clip(side + ends, 0, 1) * step(-0.075, 0.008, -np.abs(y - 0.075)) * cab
    glare = step(0.3, 0.4, np.cos(2 * np.pi * (x + y) / 0.24))
    paint = mix(paint, mix(GLASS, WHITE, 0.5 * glare), window)
    paint = mix(paint, ORANGE, step(0.165, 0.008, y) * cab)
    pipe = step(-0.045, 0.01, -np.hypot(x + 0.44, z + 0.12)) * step(0.05, 0.02, y)
    return mix(paint, STEEL, pipe)


def _paint_arm(p: ndarray) -> ndarray:
    pins = np.min([np.hypot(p[:, 0] - pin[0], p[:, 1] - pin[1]) for pin in (BOOM, STICK, BUCKET)], 0)
    paint = mix(YELLOW, ORANGE, step(0.2, 0.4, np.cos(2 * np.pi * (p[:, 0] - p[:, 1]) / 0.30)))
    paint = mix(paint, COAL, step(-0.012, 0.006, -np.abs(p[:, 2] + 0.07)))
    return mix(paint, STEEL, step(-0.036, 0.008, -pins))


def _paint_bucket(p: ndarray) -> ndarray:
    paint = mix(STEEL, COAL, step(0.1, 0.4, np.cos(2 * np.pi * p[:, 2] / 0.085)))
    paint = mix(paint, ORANGE, step(0.10, 0.01, -p[:, 1]) * step(-0.125, 0.01, p[:, 1]))
    return mix(paint, WHITE, step(-0.535, 0.01, -p[:, 0]) * step(0.268, 0.01, -p[:, 1]))
