"""Soft bodies out of bones: distances, smooth unions, a mesh, and a pose. World units, y up, front along +z."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy import ndarray
from scipy import ndimage
from scipy.interpolate import CubicSpline
from skimage.measure import marching_cubes

Field = Callable[[ndarray], ndarray]  # points "p 3" to signed distances "p", negative inside

CELL = 0.011  # of the grid that finds the surface
COARSE = 4  # cells between the points that tell where the surface cannot be


@dataclass(frozen=True)
class Chain:
    """A tube along joints.

    Attributes:
        points: "j 3".
        radii: "j".
    """

    points: ndarray
    radii: ndarray

    def __call__(self, p: ndarray) -> ndarray:
        """Distance to the nearest of its round cones."""
        best = np.full(len(p), np.inf, np.float32)
        for a, b, thick, thin in zip(self.points, self.points[1:], self.radii, self.radii[1:], strict=False):
            along = b - a
            offset = p - a
            t = np.clip(offset @ along / (along @ along), 0, 1)
            offset -= t[:, None] * along
            best = np.minimum(best, np.sqrt(np.einsum("ij,ij->i", offset, offset)) - thick - t * (thin - thick))
        return best


def smooth_chain(joints: Sequence[tuple[float, float, float, float]], count: int) -> Chain:
    """Join a tube through (x, y, z, radius), splined, with `count` joints at equal steps of length."""
    knots = np.array(joints)
    at = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(knots[:, :3], axis=0), axis=1))])
    values = CubicSpline(at, knots)(np.linspace(0, at[-1], count))
    return Chain(values[:, :3], values[:, 3].clip(0.004))


def ellipsoid(center: Sequence[float] | ndarray, radii: Sequence[float]) -> Field:
    """Return the distance to an ellipsoid, exact on its surface and nearly so around it."""
    middle, size = np.array(center), np.array(radii)

    def field(p: ndarray) -> ndarray:
        scaled = (p - middle) / size
        length = np.linalg.norm(scaled, axis=1)
        return length * (length - 1) / np.maximum(np.linalg.norm(scaled / size, axis=1), 1e-9)

    return field


def union(fields: Sequence[Field], softness: float) -> Field:
    """All of them, with fillets about `softness` wide."""

    def field(p: ndarray) -> ndarray:
        result = fields[0](p)
        for other in fields[1:]:
            distance = other(p)
            blend = np.maximum(softness - np.abs(result - distance), 0) / softness
            result = np.minimum(result, distance) - blend**2 * softness / 4
        return result

    return field


@dataclass(frozen=True)
class Skin:
    """A surface at rest.

    Attributes:
        points: "v 3".
        faces: "f 3", counter-clockwise outside.
        openness: "v", 1 under an open sky, less in folds.
    """

    points: ndarray
    faces: ndarray
    openness: ndarray


def skin(field: Field, low: Sequence[float], high: Sequence[float]) -> Skin:
    """Extract the zero level of a distance inside a box."""
    axes = [np.arange(a, b + CELL, CELL, dtype=np.float32) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    values = _near_surface(field, grid)
    points, faces, _, _ = marching_cubes(values, 0.0, spacing=(CELL,) * 3)
    points = points + np.array(low)
    outward = normals(points, faces)
    if (field(points + 0.01 * outward) < 0).mean() > 0.5:
        faces, outward = faces[:, ::-1].copy(), -outward
    hidden = np.zeros(len(points))
    for step in (0.02, 0.05, 0.09, 0.14):
        hidden += np.clip(step - field(points + step * outward), 0, step) / step / 4
    return Skin(points, faces, 1 - hidden)


def _near_surface(field: Field, grid: ndarray) -> ndarray:
    """Sample the field on a grid, exact within two coarse cells of the surface, interpolated elsewhere."""
    coarse = grid[::COARSE, ::COARSE, ::COARSE]
    rough = field(coarse.reshape(-1, 3)).reshape(coarse.shape[:3])
    places = [np.arange(n) / COARSE for n in grid.shape[:3]]
    values = ndimage.map_coordinates(rough, np.meshgrid(*places, indexing="ij"), order=1, mode="nearest")
    near = np.abs(values) < 2 * COARSE * CELL
    values[near] = field(grid[near])
    return values


def normals(points: ndarray, faces: ndarray) -> ndarray:
    """Return unit normals of the vertices, weighted by area."""
    corners = points[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(points)
    for corner in range(3):
        np.add.at(total, faces[:, corner], across)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)


@dataclass(frozen=True)
class Bones:
    """Rigid motions and who follows them.

    Attributes:
        weights: "v j", rows sum to 1.
        rests: "j 3", the point of each bone at rest.
    """

    weights: ndarray
    rests: ndarray

    def pose(self, points: ndarray, places: ndarray, turns: ndarray) -> ndarray:
        """Points after every bone moved to `places` ("j 3") and turned by the matrices `turns` ("j 3 3")."""
        moved = np.zeros_like(points)
        for weight, rest, place, turn in zip(self.weights.T, self.rests, places, turns, strict=True):
            near = weight > 1e-5
            moved[near] += weight[near, None] * ((points[near] - rest) @ turn.T + place)
        return moved


def turn_about_z(angle: ndarray | float) -> ndarray:
    """Rotations in the picture plane, "... 3 3", counter-clockwise, radians."""
    c, s = np.cos(angle), np.sin(angle)
    zero, one = np.zeros_like(c), np.ones_like(c)
    return np.stack([c, -s, zero, s, c, zero, zero, zero, one], -1).reshape(*np.shape(angle), 3, 3)


def step(edge: float, width: float, x: ndarray) -> ndarray:
    """0 below the edge, 1 above, smooth over `width`."""
    t = np.clip((x - edge) / width + 0.5, 0, 1)
    return t * t * (3 - 2 * t)


def mix(under: ndarray, over: ndarray, amount: ndarray) -> ndarray:
    """From one paint to another; each is "p 3" or a single color."""
    return under + (over - under) * amount[:, None]
