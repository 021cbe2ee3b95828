"""Figures out of painted solids, seen from a turned camera. World units, y up."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy import ndarray

from examples.shapes import Field, Skin, mix, skin, smooth_chain, step, union

EDGE = 0.006  # width of the border between two paints
REACH = 0.78  # half the side of the box that holds a figure

Color = tuple[float, float, float]


@dataclass(frozen=True)
class Part:
    """Solid with a paint.

    Attributes:
        shape: signed distance.
        color: of its surface.
        marks: colors of the regions of its surface that lie inside a distance; later ones cover earlier ones.
    """

    shape: Field
    color: Color
    marks: Sequence[tuple[Field, Color]] = ()

    def paint(self, p: ndarray) -> ndarray:
        """Return the colors of points near the surface, "p 3"."""
        color = np.broadcast_to(np.array(self.color), p.shape)
        for region, over in self.marks:
            color = mix(color, np.array(over), step(0, EDGE, -region(p)))
        return color


@dataclass(frozen=True)
class Figure:
    """Solids in one skin that stands still.

    Attributes:
        parts: solids; fillets lie between all of them.
        softness: width of the fillets.
        yaw_deg: rotation about the vertical axis, counter-clockwise from above.
        pitch_deg: rotation towards the camera after that.
    """

    parts: Sequence[Part]
    softness: float = 0.02
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0

    @cached_property
    def skin(self) -> Skin:
        """Surface of the union of all parts."""
        whole = union([part.shape for part in self.parts], self.softness)
        return skin(whole, (-REACH,) * 3, (REACH,) * 3)

    @cached_property
    def features(self) -> ndarray:
        """Return nothing: the paint depends on the place alone."""
        return np.zeros((len(self.skin.points), 0))

    def at(self, moment: float) -> ndarray:
        """Return the turned vertices, the same at every moment."""
        return self.skin.points @ _turn(self.yaw_deg, self.pitch_deg).T

    def color(self, p: ndarray, features: ndarray) -> ndarray:
        """Return the paint of the nearest part at points of the skin, "p 3" in [0, 1]."""
        distances = np.stack([part.shape(p) for part in self.parts])
        weights = np.exp(-(distances - distances.min(0)) / EDGE * 3)
        weights /= weights.sum(0)
        paints = np.stack([part.paint(p) for part in self.parts])
        return (weights[..., None] * paints).sum(0)


def _turn(yaw_deg: float, pitch_deg: float) -> ndarray:
    yaw, pitch = math.radians(yaw_deg), math.radians(pitch_deg)
    about_y = np.array([[math.cos(yaw), 0, math.sin(yaw)], [0, 1, 0], [-math.sin(yaw), 0, math.cos(yaw)]])
    about_x = np.array([[1, 0, 0], [0, math.cos(pitch), -math.sin(pitch)], [0, math.sin(pitch), math.cos(pitch)]])
    return about_x @ about_y


def tube(*joints: tuple[float, float, float, float]) -> Field:
    """Return the distance to a splined tube through (x, y, z, radius)."""
    return smooth_chain(joints, 6 * len(joints))


def both_sides(near: Field) -> Field:
    """Return the distance to a solid at z > 0 and its mirror image."""
    return lambda p: near(np.stack([p[:, 0], p[:, 1], np.abs(p[:, 2])], 1))


def left_right(near: Field) -> Field:
    """Return the distance to a solid at x > 0 and its mirror image."""
    return lambda p: near(np.stack([np.abs(p[:, 0]), p[:, 1], p[:, 2]], 1))


def box(center: Sequence[float], half: Sequence[float], rounding: float = 0.03, lean: float = 0.0) -> Field:
    """Return the distance to a rounded box that leans by radians in the picture plane."""
    middle, size = np.array(center), np.array(half) - rounding
    turn = np.array([[math.cos(lean), -math.sin(lean), 0], [math.sin(lean), math.cos(lean), 0], [0, 0, 1]])

    def distance(p: ndarray) -> ndarray:
        outside = np.abs((p - middle) @ turn) - size
        return np.linalg.norm(outside.clip(0), axis=1) + outside.max(1).clip(None, 0) - rounding

    return distance


def disk(center: Sequence[float], radius: float, half_length: float, axis: int, rounding: float = 0.02) -> Field:
    """Return the distance to a rounded cylinder along an axis (0, 1 or 2)."""
    middle = np.array(center)
    across = [k for k in range(3) if k != axis]

    def distance(p: ndarray) -> ndarray:
        offset = p - middle
        outside = np.stack(
            [
                np.linalg.norm(offset[:, across], axis=1) - radius + rounding,
                np.abs(offset[:, axis]) - half_length + rounding,
            ],
            1,
        )
        return np.linalg.norm(outside.clip(0), axis=1) + outside.max(1).clip(None, 0) - rounding

    return distance


def ring(center: Sequence[float], radius: float, thickness: float, axis: int) -> Field:
    """Return the distance to a torus around an axis (0, 1 or 2)."""
    middle = np.array(center)
    across = [k for k in range(3) if k != axis]

    def distance(p: ndarray) -> ndarray:
        offset = p - middle
        return np.hypot(np.linalg.norm(offset[:, across], axis=1) - radius, offset[:, axis]) - thickness

    return distance


def slab(axis: int, low: float, high: float) -> Field:
    """Return the distance to all between two planes across an axis."""
    return lambda p: np.abs(p[:, axis] - (low + high) / 2) - (high - low) / 2


def only(region: Field, *others: Field) -> Field:
    """Return the distance to the intersection of regions."""
    return lambda p: np.max([region(p), *(other(p) for other in others)], axis=0)
