"""A part of a subject that turns about a hinge on another part, such as the lid of a chest.

A hull shows nothing of its inside. So where a lid opens, colors tell little, and outlines alone leave its motion open:
a lid that slides into its box looks nearly as one that falls behind it. With a hinge, one angle per frame is left.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from dg4d_lib.fitting.asset_fit import AssetFit
from dg4d_lib.fitting.rigid_parts import RigidMotion, of_one_part
from dg4d_lib.geometry.quaternion import quat_multiply, quat_to_rotmat, rotate

ANGLES = tuple(np.radians(np.arange(0.0, 211.0, 7.5)).tolist())  # trial angles at every frame, radians
SWING = 0.05  # loss per squared radian that the angle changes from frame to frame
PROMISING, CLEARLY = 0.8, 0.6  # largest loss relative to the second best hinge: before and after the search for a cut
ALIKE, FAR = 0.7, 0.2  # two hinges count as one from this cosine and up to this distance of their axes, world units
STEPS, ROUNDS = (0.04, 0.15, 0.15), 5  # search for a cut: steps along its normal and of two tilts; halved without gain
OPEN = 0.5  # radians: smallest opening of a hinge
DAMPING = 1e-3  # ridge weight of the separating plane


@dataclass(frozen=True)
class Hinge:
    """Axis of a turn, at rest.

    Attributes:
        point: on the axis, world units.
        axis: unit vector; positive angles open.
    """

    point: Float[Tensor, " 3"]
    axis: Float[Tensor, " 3"]

    def opened(self, motion: RigidMotion, angles: Float[Tensor, " t"]) -> RigidMotion:
        """Return a motion whose part 1 moves as part 0 does, opened by an angle at every frame, radians."""
        half = 0.5 * angles[:, None]
        turns = torch.cat([half.cos(), half.sin() * self.axis], -1)
        base, quats, places = motion.quats[:, 0], motion.quats.clone(), motion.places.clone()
        opened = rotate(quat_to_rotmat(turns), motion.centers[1] - self.point) + self.point
        quats[:, 1] = quat_multiply(base, turns)
        places[:, 1] = rotate(quat_to_rotmat(base), opened - motion.centers[0]) + motion.places[:, 0]
        return replace(motion, quats=quats, places=places)

    def is_near(self, other: "Hinge") -> bool:
        """Return True if both are about one axis and open the same way."""
        return float(self.axis @ other.axis) > ALIKE and float(self.distances(other.point[None])) < FAR

    def distances(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """Return the distances of points from the axis, world units."""
        return torch.linalg.cross(points - self.point, self.axis.expand_as(points)).norm(dim=-1)


@dataclass(frozen=True)
class Cut:
    """Plane that parts a subject in two.

    Attributes:
        normal: unit vector, towards part 1.
        offset: of the plane from the origin along its normal, world units.
    """

    normal: Float64[np.ndarray, " 3"]
    offset: float

    @classmethod
    def between(cls, nodes: Float[Tensor, "m 3"], parts: Int[Tensor, " m"]) -> "Cut":
        """Return the plane that separates parts 0 and 1, by least squares."""
        rows = np.c_[nodes.double().numpy(), np.ones(len(nodes))]
        sides = 2.0 * parts.numpy() - 1
        found = np.linalg.solve(rows.T @ rows + DAMPING * np.eye(4), rows.T @ sides)
        length = float(np.linalg.norm(found[:3]))
        return cls(found[:3] / length, -float(found[3]) / length)

    def changed(self, coordinate: int, step: float, middle: Float[Tensor, " 3"]) -> "Cut":
        """Return another plane.

        Args:
            coordinate: 0: moved along the normal; 1 or 2: tilted.
            step: world units, or tangent of the angle.
            middle: point that a tilted plane goes through.
        """
        if coordinate == 0:
            return Cut(self.normal, self.offset + step)
        normal = self.normal + step * np.linalg.svd(self.normal[None])[2][coordinate]
        normal = normal / np.linalg.norm(normal)
        return Cut(normal, float(normal @ middle.double().numpy()))

    def above(self, points: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        """Mark the points on the side of part 1."""
        return torch.from_numpy(points.double().numpy() @ self.normal > self.offset)

    def hinges(self, vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]) -> list[Hinge]:
        """Return the sides of the smallest rectangle around the outline of the cut, as hinges; none if there is none.

        Args:
            vertices: of the surface, at rest.
            faces: of the surface.
        """
        above = self.above(vertices)[faces]
        crossed = vertices[faces[above.any(1) & ~above.all(1)].unique()].double().numpy()
        outline = crossed - np.outer(crossed @ self.normal - self.offset, self.normal)
        plane = np.linalg.svd(self.normal[None])[2][1:]
        try:
            corners = outline[ConvexHull(outline @ plane.T).vertices] if len(outline) > 2 else outline[:0]
        except QhullError:  # all on one line
            return []
        if not len(corners):
            return []
        rectangles = map(partial(self._rectangle, corners), np.roll(corners, -1, 0) - corners)
        along, across, low, high = min(rectangles, key=lambda one: float(np.prod(one[3] - one[2])))
        center = self.offset * self.normal
        middle = 0.5 * (low + high)
        hinges = []
        for x, y, axis in (
            (middle[0], low[1], along),
            (middle[0], high[1], -along),
            (low[0], middle[1], -across),
            (high[0], middle[1], across),
        ):
            point = center + x * along + y * across
            hinges.append(Hinge(torch.from_numpy(point).float(), torch.from_numpy(axis).float()))
        return hinges

    def _rectangle(
        self, corners: Float64[np.ndarray, "c 3"], side: Float64[np.ndarray, " 3"]
    ) -> tuple[
        Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"], Float64[np.ndarray, " 2"], Float64[np.ndarray, " 2"]
    ]:
        """Return the axes and the bounds of the rectangle along a side around corners in the plane."""
        along = side / np.linalg.norm(side)
        across = np.cross(self.normal, along)
        places = corners @ np.stack([along, across], 1)
        return along, across, places.min(0), places.max(0)


@dataclass(frozen=True)
class Found:
    """Result of a hinge search: cut, hinge of the part above it, and opening angles.

    Attributes:
        loss: of the outlines, and of changes of the angles.
        cut: between both parts.
        hinge: a side of the outline of the cut.
        angles: at every frame, radians.
        parts: of the nodes.
    """

    loss: float
    cut: Cut
    hinge: Hinge
    angles: Float[Tensor, " t"]
    parts: Int[Tensor, " m"]


class HingeSearch:
    """Search of the cut and the hinge by which the outlines of a subject follow its video best."""

    def __init__(
        self, fit: AssetFit, motion: RigidMotion, vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]
    ) -> None:
        """Store the inputs.

        Args:
            fit: of the subject.
            motion: that of part 0 counts.
            vertices: of the subject's surface, at rest.
            faces: of the surface.
        """
        self._fit, self._motion, self._vertices, self._faces = fit, motion, vertices, faces

    @torch.no_grad()
    def best(self, start: Cut) -> Found | None:
        """Return the best cut near the start; None if none of its hinges stands out, or it hardly opens.
        Cuts are compared at some angles of one hinge, the hinges of the best cut at all.
        """
        found = self._hinges(start, ANGLES[::2])
        if len(found) < 2 or found[0].loss > PROMISING * found[1].loss:
            return None
        best: Found = found[0]
        steps: tuple[float, ...] = STEPS
        for _ in range(ROUNDS):
            last = best
            for axis, step in enumerate(steps):
                for sign in (1, -1):
                    others = self._hinges(
                        best.cut.changed(axis, sign * step, best.hinge.point), ANGLES[::2], best.hinge
                    )
                    if others and others[0].loss < best.loss:
                        best = others[0]
                        break
            if best is last:
                steps = tuple(0.5 * step for step in steps)
        found = self._hinges(best.cut, ANGLES)
        clear = found[0].loss <= CLEARLY * found[1].loss
        return found[0] if clear and float(found[0].angles.max()) >= OPEN else None

    def _hinges(self, cut: Cut, angles: Sequence[float], near: Hinge | None = None) -> list[Found]:
        """Return the hinges of a cut with their angles, the best first; of those near another one if it is given."""
        graph, frames = self._fit.graph, len(self._motion.quats)
        parts = cut.above(graph.nodes).long()
        if not 0 < int(parts.sum()) < len(parts):
            return []
        motion, found = replace(self._motion, parts=parts), []
        fit = self._fit.with_graph(of_one_part(graph, parts, cut.above(self._fit.cloud.means).long()))
        for hinge in cut.hinges(self._vertices, self._faces):
            if near is None or hinge.is_near(near):
                moved = [hinge.opened(motion, torch.full((frames,), angle)).of_nodes(graph) for angle in angles]
                errors = torch.stack([fit.outline_errors(one) for one in moved]).double().numpy()
                loss, path = smoothest(errors, np.array(angles))
                found.append(Found(loss, cut, hinge, torch.tensor([angles[step] for step in path]), parts))
        return sorted(found, key=lambda one: one.loss)


def smoothest(errors: Float64[np.ndarray, "a t"], angles: Float64[np.ndarray, " a"]) -> tuple[float, list[int]]:
    """Return the smallest sum of errors and of changes over the frames, and its angles (dynamic programming).

    Args:
        errors: of every angle at every frame.
        angles: radians, the first one 0, which is that of the first frame.
    """
    changes = SWING * np.square(angles[:, None] - angles)
    total, before = np.where(angles == 0, errors[:, 0], np.inf), []
    for error in errors.T[1:]:
        reached = total + changes
        before.append(reached.argmin(1))
        total = reached.min(1) + error
    path = list(itertools.accumulate(reversed(before), lambda step, row: int(row[step]), initial=int(total.argmin())))
    return float(total.min()), path[::-1]
