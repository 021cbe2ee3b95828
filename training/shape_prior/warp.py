"""Random deformation of synthetic shapes by a smooth displacement field, and attachment of small things."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from training.shape_prior.chance import Chance
from training.shape_prior.solids import (
    BOX,
    CARVE,
    CONE,
    CYLINDER,
    MIRROR,
    PLATE,
    SHELL,
    TORUS,
    UNION,
    Matrix,
    Shape,
    Solid,
    Vector,
    frame_along,
    rotation,
    scaled,
)

LEAST, MOST = 0.45, 2.2  # stretch of a solid along any of its axes
STEP = 1e-3  # of numerical derivatives, object units


@dataclass(frozen=True)
class Warp:
    """Smooth map of object space: a stretch along the axes, then growth and turns around centers that fade out.

    Attributes:
        stretch: along x, y and z.
        centers: object units.
        reach: standard deviation of the fading around every center.
        growth: linear displacement around every center.
    """

    stretch: Vector
    centers: Float64[np.ndarray, "k 3"]
    reach: Float64[np.ndarray, " k"]
    growth: Float64[np.ndarray, "k 3 3"]

    def __call__(self, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Map points."""
        away = points[:, None] - self.centers
        fading = np.exp(-(away**2).sum(-1) / (2 * self.reach**2))
        return (points + np.einsum("nk,kij,nkj->ni", fading, self.growth, away)) * self.stretch

    def derivative(self, point: Vector) -> Matrix:
        """Return the derivative at a point; its columns belong to x, y and z."""
        ends = self(np.concatenate([point + STEP * np.eye(3), point - STEP * np.eye(3)]))
        return (ends[:3] - ends[3:]).T / (2 * STEP)


def random_warp(chance: Chance, shape: Shape) -> Warp:
    """Return a warp that keeps the symmetry that the shape is said to have."""
    extent = extent_of(shape.solids)
    stretch = np.exp([chance.normal(0.13), chance.normal(0.13), chance.normal(0.13)])
    bumps: list[tuple[Vector, float, Matrix]] = []  # center, reach, growth
    if shape.symmetric is None:  # about the vertical axis: wide in one place, slim in another
        stretch[2] = stretch[0]
        for _ in range(chance.integer(0, 2)):
            wide, height = chance.normal(0.2), np.array([0.0, chance.between(-1, 1) * extent, 0.0])
            bumps.append((height, chance.between(0.4, 0.9) * extent, np.diag([wide, chance.normal(0.15), wide])))
    else:
        for _ in range(chance.integer(1, 4)):
            center = chance.pick(shape.solids).center + 0.1 * extent * np.array([chance.normal(1) for _ in range(3)])
            turn = np.cross(np.eye(3), [chance.normal(0.18) for _ in range(3)])
            growth = np.diag([chance.normal(0.22) for _ in range(3)]) + turn
            reach = chance.between(0.25, 0.7) * extent
            bumps.append((center, reach, growth))
            if shape.symmetric:
                bumps.append((MIRROR * center, reach, MIRROR[:, None] * growth * MIRROR))
    centers, reaches, growths = zip(*bumps, strict=True) if bumps else ((), (), ())
    return Warp(stretch, np.reshape(centers, (-1, 3)), np.array(reaches, float), np.reshape(growths, (-1, 3, 3)))


def warped(solid: Solid, warp: Warp) -> Solid:
    """Return the solid moved, turned and stretched as the warp does around it.

    The ends of a cone are mapped each, so chains of cones stay joined.
    """
    if solid.kind == CONE:
        return _warped_cone(solid, warp)
    linear = warp.derivative(solid.center)
    left, _, right = np.linalg.svd(linear)
    turn = left @ right
    if np.linalg.det(linear) < 0:  # turned inside out by too much growth: stay upright
        turn, linear = np.eye(3), np.eye(3)
    grow = np.linalg.norm(solid.axes @ linear.T, axis=1).clip(LEAST, MOST)
    mean = float(np.prod(grow)) ** (1 / 3)
    old = solid.parameters
    new = old
    if solid.kind in (BOX, CYLINDER):
        new = (old[0] * float(grow.min()), old[1], *(np.array(old[2:5]) * grow))
    elif solid.kind == SHELL:
        new = (old[0] * mean, old[1], *(np.array(old[2:5]) * grow))
    elif solid.kind == TORUS:
        new, grow = (old[0] * mean, old[1] * mean), np.full(3, mean)
    elif solid.kind == PLATE:
        new = tuple((np.array(old).reshape(4, 2) * grow[:2]).ravel())
    return replace(
        solid, center=warp(solid.center[None])[0], axes=solid.axes @ turn.T, half=solid.half * grow,
        parameters=tuple(float(value) for value in new), blend=solid.blend * mean,
    )  # fmt: skip


def _warped_cone(solid: Solid, warp: Warp) -> Solid:
    length, first, second, flat = solid.parameters[:4]
    along = length * solid.axes[1]
    start, end = warp(np.stack([solid.center - along, solid.center + along]))
    middle = warp.derivative(solid.center)
    across = [
        np.linalg.norm(solid.axes[0::2] @ warp.derivative(place).T, axis=1).clip(LEAST, MOST)
        for place in (solid.center - along, solid.center, solid.center + along)
    ]
    half_length = max(float(np.linalg.norm(end - start)) / 2, 1e-4)
    direction = end - start if half_length > STEP else middle @ solid.axes[1]
    first, second = first * float(across[0][0]), second * float(across[2][0])
    flat *= float(across[1][1] / across[1][0])
    largest = max(first, second)
    return replace(
        solid, center=(start + end) / 2, axes=frame_along(direction, middle @ solid.axes[2]),
        half=np.array([largest, half_length + largest, largest * flat]), parameters=(half_length, first, second, flat),
        blend=solid.blend * float(across[1].mean()),
    )  # fmt: skip


def attach(chance: Chance, shape: Shape, recipe: Callable[[Chance, Shape], None], most: int) -> None:
    """Add a small thing of another family to the outside of a shape, which loses its mirror plane.

    Args:
        chance: of the place, the turn and the size.
        shape: changed; kept as it is where no solid may be added.
        recipe: of the thing.
        most: solids that the shape may have.
    """
    thing = Shape(blend=shape.blend)
    recipe(chance, thing)
    solids = [solid for solid in thing.solids if solid.operation != CARVE]
    if len(shape.solids) + len(solids) > most:
        return
    extent = extent_of(shape.solids)
    factor = chance.between(0.25, 0.55) * extent / extent_of(solids)
    host = chance.pick([solid for solid in shape.solids if solid.operation == UNION])
    points = host.outline_points()
    place = points[chance.integer(0, len(points) - 1)]
    outward = place - host.center
    outward = outward / max(float(np.linalg.norm(outward)), 1e-6)
    place = place + 0.5 * factor * extent_of(solids) * outward
    start = len(shape.solids)
    shape.solids += [scaled(solid, factor) for solid in solids]
    shape.move(start, rotation(chance.between(-math.pi, math.pi), chance.normal(0.3), chance.normal(0.3)), place)
    shape.symmetric = False


def extent_of(solids: list[Solid]) -> float:
    """Return the largest coordinate, in absolute value, of the solids that are matter."""
    return max(float(np.abs(solid.outline_points()).max()) for solid in solids if solid.operation == UNION)
