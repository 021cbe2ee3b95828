"""Solids of synthetic shapes: primitives with a frame of their own, joined, carved and painted.

Object space: right-handed, y up, the front looks along +z, x = 0 is the mirror plane.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np
from jaxtyping import Float64, Int64

Vector: TypeAlias = Float64[np.ndarray, "3"]
Matrix: TypeAlias = Float64[np.ndarray, "3 3"]
Point: TypeAlias = Sequence[float] | Vector

ELLIPSOID, CONE, BOX, CYLINDER, TORUS, PLATE, SHELL = range(7)
UNION, CARVE, PAINT = range(3)
PARAMETERS = 8  # numbers of a primitive beside its frame and half sizes
COLUMNS = 3 + 9 + 3 + PARAMETERS + 1  # center, axes, half sizes, parameters, blend radius

MIRROR = np.array([-1.0, 1.0, 1.0])
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
_SPREAD = np.concatenate([_CORNERS / math.sqrt(3), np.eye(3), -np.eye(3)])


@dataclass(frozen=True)
class Solid:
    """One primitive.

    Attributes:
        kind: `ELLIPSOID` and so on.
        operation: `UNION`, `CARVE` (takes away) or `PAINT` (changes the material of the surface inside it).
        material: index into the palette of the shape.
        center: object units.
        axes: unit vectors of the local frame as rows.
        half: half sizes of the box around it, along `axes`.
        parameters: of the kind; see `Shape`.
        blend: radius of the smooth union with earlier solids; 0 is a hard edge.
    """

    kind: int
    operation: int
    material: int
    center: Vector
    axes: Matrix
    half: Vector
    parameters: tuple[float, ...]
    blend: float

    def mirrored(self) -> "Solid":
        """Return the mirror image in the plane x = 0."""
        return replace(self, center=self.center * MIRROR, axes=self.axes * MIRROR)

    def outline_points(self) -> Float64[np.ndarray, "n 3"]:
        """Return points on the surface, or on the box around it, from which extents are measured."""
        if self.kind == CONE:
            length, first, second, flat = self.parameters[:4]
            ends = [
                _SPREAD * radius * [1, 1, flat] + [0, side * length, 0] for side, radius in ((-1, first), (1, second))
            ]
            local = np.concatenate(ends)
        elif self.kind in (ELLIPSOID, SHELL):
            local = _SPREAD * self.half
        else:
            local = _CORNERS * self.half
        return self.center + local @ self.axes


@dataclass
class Shape:
    """A list of solids that is written like a recipe.

    Attributes:
        solids: in the order in which they are joined; painting and carving follow all unions.
        blend: default radius of the smooth unions.
        symmetric: whether x = 0 is the mirror plane of the body; None where every vertical plane is one.
    """

    solids: list[Solid] = field(default_factory=list)
    blend: float = 0.04
    symmetric: bool | None = True

    def ellipsoid(
        self, center: Point, radii: Point | float, turn: Matrix | None = None, material: int = 0, **options: float | int
    ) -> None:
        """Add an ellipsoid with its radii along the rows of `turn`."""
        self._add(ELLIPSOID, center, np.broadcast_to(np.asarray(radii, float), 3), turn, material, (), options)

    def cone(
        self, start: Point, end: Point, first: float, second: float, material: int = 0, flat: float = 1.0,
        side: Point = (0.0, 0.0, 1.0), **options: float | int,
    ) -> None:  # fmt: skip
        """Add a round cone: a ball of radius `first` that becomes one of radius `second` along a segment.

        `flat` scales the thickness along `side`.
        """
        a, b = np.asarray(start, float), np.asarray(end, float)
        length = max(float(np.linalg.norm(b - a)) / 2, 1e-4)
        axes = frame_along(b - a, np.asarray(side, float))
        largest = max(first, second)
        half = np.array([largest, length + largest, largest * flat])
        self._add(CONE, (a + b) / 2, half, axes, material, (length, first, second, flat), options)

    def tube(
        self, points: Sequence[Point], radii: Sequence[float], material: int = 0, flat: float = 1.0,
        side: Point = (0.0, 0.0, 1.0), **options: float | int,
    ) -> None:  # fmt: skip
        """Add a chain of round cones through points."""
        for i in range(len(points) - 1):
            self.cone(points[i], points[i + 1], radii[i], radii[i + 1], material, flat, side, **options)

    def box(
        self, center: Point, half: Point, turn: Matrix | None = None, material: int = 0, rounding: float = 0.02,
        taper: float = 0.0, **options: float | int,
    ) -> None:  # fmt: skip
        """Add a rounded box; its cross-section grows by the share `taper` from the middle to the top."""
        size = np.asarray(half, float)
        rounding = min(rounding, 0.9 * float(size.min()))
        self._add(BOX, center, size * _tapered(taper), turn, material, (rounding, taper, *size), options)

    def cylinder(
        self, center: Point, radius: float, half: float, turn: Matrix | None = None, material: int = 0,
        rounding: float = 0.01, taper: float = 0.0, flat: float = 1.0, **options: float | int,
    ) -> None:  # fmt: skip
        """Add a cylinder along the local y axis; the radius grows by `taper`, z is scaled by `flat`."""
        size = np.array([radius, half, radius * flat])
        rounding = min(rounding, 0.9 * float(size.min()))
        self._add(CYLINDER, center, size * _tapered(taper), turn, material, (rounding, taper, *size), options)

    def torus(
        self, center: Point, ring: float, tube: float, turn: Matrix | None = None, material: int = 0,
        **options: float | int,
    ) -> None:  # fmt: skip
        """Add a torus around the local y axis."""
        half = np.array([ring + tube, tube, ring + tube])
        self._add(TORUS, center, half, turn, material, (ring, tube), options)

    def plate(
        self, center: Point, corners: Sequence[tuple[float, float]], thickness: float, turn: Matrix | None = None,
        material: int = 0, **options: float | int,
    ) -> None:  # fmt: skip
        """Add a plate: four corners in the local x-y plane (convex or not, any sense), half as thick as given."""
        flat = np.asarray(corners, float)
        middle = (flat.max(0) + flat.min(0)) / 2
        axes = np.eye(3) if turn is None else turn
        place = np.asarray(center, float) + middle @ axes[:2]
        half = np.array([*(np.ptp(flat, 0) / 2 + thickness), thickness])
        self._add(PLATE, place, half, axes, material, tuple((flat - middle).ravel()), options)

    def shell(
        self, center: Point, radii: Point | float, thickness: float, cut: float, turn: Matrix | None = None,
        material: int = 0, **options: float | int,
    ) -> None:  # fmt: skip
        """Add the hollow upper part of an ellipsoid: local y above `cut` times its radius."""
        size = np.broadcast_to(np.asarray(radii, float), 3)
        self._add(SHELL, center, size + thickness, turn, material, (thickness, cut, *size), options)

    def mirror(self, start: int) -> None:
        """Add the mirror images of all solids from an index on."""
        self.solids += [solid.mirrored() for solid in self.solids[start:]]

    def move(self, start: int, turn: Matrix, shift: Point) -> None:
        """Turn the solids from an index on about the origin, then shift them."""
        for i, solid in enumerate(self.solids[start:], start):
            center = solid.center @ turn.T + np.asarray(shift, float)
            self.solids[i] = replace(solid, center=center, axes=solid.axes @ turn.T)

    def scale(self, start: int, factor: float) -> None:
        """Scale the solids from an index on about the origin."""
        self.solids[start:] = [scaled(solid, factor) for solid in self.solids[start:]]

    def _add(
        self, kind: int, center: Point, half: Vector, turn: Matrix | None, material: int,
        parameters: tuple[float, ...], options: dict[str, float | int],
    ) -> None:  # fmt: skip
        axes = np.eye(3) if turn is None else turn
        blend = float(options.pop("blend", self.blend))
        operation = int(options.pop("operation", UNION))
        if options:
            raise TypeError(f"unknown options of a solid: {sorted(options)}; known: blend, operation")
        place = np.asarray(center, float)
        self.solids.append(Solid(kind, operation, material, place, axes, np.array(half), parameters, blend))


# parameters that are ratios, not lengths, per kind
_RATIOS = {CONE: (3,), BOX: (1,), CYLINDER: (1,), SHELL: (1,)}


def scaled(solid: Solid, factor: float) -> Solid:
    """Return the solid scaled about the origin."""
    ratios = _RATIOS.get(solid.kind, ())
    parameters = tuple(value if i in ratios else value * factor for i, value in enumerate(solid.parameters))
    return replace(
        solid,
        center=solid.center * factor,
        half=solid.half * factor,
        parameters=parameters,
        blend=solid.blend * factor,
    )


def thickened(solid: Solid, least: float) -> Solid:
    """Return the solid with no half size below `least`, so that no ray steps over it."""
    half = np.maximum(solid.half, least)
    parameters = list(solid.parameters)
    match solid.kind:
        case 1:  # CONE
            parameters[1:3] = [max(value, least) for value in parameters[1:3]]
            parameters[3] = max(parameters[3], least / max(parameters[1:3]))
            half[2] = max(half[2], max(parameters[1:3]) * parameters[3])
            half[:2] += max(0.0, max(parameters[1:3]) - half[0])
        case 2 | 3:  # BOX, CYLINDER
            parameters[2:5] = [max(value, least) for value in parameters[2:5]]
            half = np.maximum(half, np.array(parameters[2:5]) * _tapered(parameters[1]))
        case 4:  # TORUS
            parameters[1] = max(parameters[1], least)
            half = np.array([parameters[0] + parameters[1], parameters[1], parameters[0] + parameters[1]])
        case 6:  # SHELL
            parameters[0] = max(parameters[0], least)
            half = np.maximum(half, np.array(parameters[2:5]) + parameters[0])
    return replace(solid, half=half, parameters=tuple(parameters))


def packed(
    solids: Sequence[Solid],
) -> tuple[Int64[np.ndarray, "p 3"], Float64[np.ndarray, "p c"]]:
    """Return kind, operation and material, and the numbers, of solids; unions come first, painting comes last."""
    order = sorted(solids, key=lambda solid: solid.operation)
    labels = np.array([[solid.kind, solid.operation, solid.material] for solid in order], np.int64)
    numbers = np.zeros((len(order), COLUMNS))
    for row, solid in zip(numbers, order, strict=True):
        row[:3], row[3:12], row[12:15] = solid.center, solid.axes.ravel(), solid.half
        row[15 : 15 + len(solid.parameters)] = solid.parameters
        row[-1] = solid.blend
    return labels, numbers


def rotation(yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> Matrix:
    """Return the matrix that turns column vectors by roll (about z), then pitch (about x), then yaw (about y)."""
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    cr, sr = math.cos(roll), math.sin(roll)
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_x = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    about_z = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    return about_y @ about_x @ about_z


def turned(yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> Matrix:
    """Return the axes (rows) of a solid that is turned by `rotation`."""
    return rotation(yaw, pitch, roll).T


def frame_along(direction: Vector, side: Vector) -> Matrix:
    """Return axes whose second row points along a direction, and whose third is as near to `side` as can be."""
    along = direction / max(float(np.linalg.norm(direction)), 1e-9)
    third = side - along * (side @ along)
    if np.linalg.norm(third) < 1e-3:
        third = np.eye(3)[int(np.argmin(np.abs(along)))]
        third = third - along * (third @ along)
    third = third / np.linalg.norm(third)
    return np.stack([np.cross(along, third), along, third])


def _tapered(taper: float) -> Vector:
    widest = 1 + abs(taper)
    return np.array([widest, 1.0, widest])
