"""Flapping macaw: wings with chains of bones, and a nodding tail."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy import ndarray

from examples.shapes import Bones, Field, Skin, ellipsoid, mix, skin, smooth_chain, step, turn_about_z, union

BODY = (  # x, y, z, radius from the crown to the root of the tail; the beak points to +z
    (0, 0.145, 0.225, 0.098),
    (0, 0.055, 0.150, 0.104),
    (0, -0.010, 0.030, 0.128),
    (0, -0.035, -0.110, 0.108),
    (0, -0.030, -0.240, 0.058),
)
BEAK = ((0, 0.135, 0.295, 0.052), (0, 0.115, 0.360, 0.036), (0, 0.055, 0.378, 0.014))
TAIL = ((0, -0.030, -0.220, 0.040), (0, -0.045, -0.420, 0.034), (0, -0.050, -0.640, 0.018))
WING = (  # center and radii of the flat parts of the right wing, from the shoulder outwards
    ((0.20, 0.030, 0.000), (0.20, 0.030, 0.135)),
    ((0.42, 0.030, -0.030), (0.19, 0.026, 0.150)),
    ((0.58, 0.030, -0.075), (0.15, 0.023, 0.120)),
)
FINGERS = (0.10, 0.02, -0.06, -0.14)  # z of the tips of the longest feathers
JOINTS = np.linspace(0.10, 0.72, 9)  # x of the bones of a wing
FLAP = 0.62  # amplitude at the wing tip, radians
LAG = 1.1  # phase lag of the tip behind the shoulder, radians
DIVE = 0.45  # pitch, radians; shows its back to the input camera
REACH = 0.055  # width of the transition between bones
EYE = np.array((0.078, 0.180, 0.262))

RED = np.array((0.860, 0.090, 0.080))
YELLOW = np.array((0.990, 0.800, 0.090))
GREEN = np.array((0.130, 0.560, 0.230))
BLUE = np.array((0.070, 0.220, 0.720))
WHITE = np.array((0.960, 0.940, 0.900))
COAL = np.array((0.080, 0.070, 0.090))


@dataclass(frozen=True)
class Parrot:
    """Macaw in flight."""

    @cached_property
    def skin(self) -> Skin:
        """Return the surface at rest, with spread wings."""
        body = union([smooth_chain(BODY, 24), smooth_chain(BEAK, 10)], 0.02)
        tail = union([_feather(TAIL, 0.05 * side) for side in (-1, 0, 1)], 0.02)
        whole = union([union([body, tail], 0.04), _wing(1), _wing(-1)], 0.035)
        return skin(whole, (-0.80, -0.20, -0.74), (0.80, 0.32, 0.46))

    @cached_property
    def features(self) -> ndarray:
        """Return the distance to the body without wings and tail at every vertex, "v 1"."""
        return smooth_chain(BODY, 24)(self.skin.points)[:, None]

    @cached_property
    def bones(self) -> Bones:
        """Return the bones of body, tail and both wings."""
        points = self.skin.points
        wing = np.array([(x, 0.03, 0.0) for x in JOINTS])
        rests = np.concatenate([[(0, 0, 0.05), (0, -0.03, -0.24)], wing, wing * (-1, 1, 1)])
        nearest = np.abs(np.abs(points[:, :1]) - JOINTS)
        pull = np.exp(-((nearest - nearest.min(1, keepdims=True)) / REACH))
        pull /= pull.sum(1, keepdims=True)
        on_wing = step(0.105, 0.06, np.abs(points[:, :1]))
        on_tail = step(-0.22, 0.10, -points[:, 2:] - 0.44) * (1 - on_wing)
        right = points[:, :1] > 0
        weights = [(1 - on_wing) * (1 - on_tail), on_tail, on_wing * pull * right, on_wing * pull * ~right]
        total = np.concatenate(weights, 1)
        return Bones(total / total.sum(1, keepdims=True), rests)

    def at(self, time: float) -> ndarray:
        """Return the vertices at a time of the wing beat; 0 and 1 are the same."""
        phase = 2 * np.pi * time
        along = np.linspace(0, 1, len(JOINTS))
        angles = FLAP * (0.55 + 0.45 * along) * np.sin(phase - LAG * along) + 0.10
        steps = np.diff(JOINTS, prepend=JOINTS[0])
        wing = np.stack([np.cumsum(steps * np.cos(angles)), np.cumsum(steps * np.sin(angles)), 0 * steps], 1)
        wing += (JOINTS[0], 0.03, 0)
        nod = _about_x(0.30 * np.sin(phase + 0.6))
        places = np.concatenate([self.bones.rests[:2], wing, wing * (-1, 1, 1)])
        turns = np.concatenate([[np.eye(3), nod], turn_about_z(angles), turn_about_z(-angles)])
        middle = np.array((0, -0.06 * np.sin(phase - 0.4), 0.13))
        return (self.bones.pose(self.skin.points, places, turns) + middle) @ _about_x(DIVE).T

    def color(self, p: ndarray, features: ndarray) -> ndarray:
        """Return the paint at points of the skin at rest, "p 3"."""
        beyond = features[:, 0]
        x, y, z = np.abs(p[:, 0]), p[:, 1], p[:, 2]
        back = 0.06 - 0.16 * x - z  # distance behind a line along the wing
        wing = mix(RED, YELLOW, step(0.03, 0.02, back))
        wing = mix(wing, GREEN, step(0.075, 0.02, back))
        wing = mix(wing, BLUE, step(0.11, 0.02, back))
        quills = step(0.55, 0.25, np.cos(2 * np.pi * 14 * (x + 0.25 * z)))
        wing = mix(wing, 0.45 * BLUE, 0.8 * quills * step(0.10, 0.03, back))
        wing = mix(wing, YELLOW, 0.85 * step(-0.025, 0.01, -y) * step(0.13, 0.03, back) * step(0.2, 0.1, x))
        paint = mix(np.broadcast_to(RED, p.shape), wing, step(0.125, 0.03, x))
        tail = mix(RED, BLUE, step(0.46, 0.06, -z))
        tail = mix(tail, YELLOW, step(0.5, 0.2, np.cos(2 * np.pi * 9 * z)) * step(0.40, 0.05, -z))
        paint = mix(paint, tail, step(0.26, 0.05, -z) * step(0.2, 0.05, 0.4 - x))
        paint = mix(paint, BLUE, step(0.02, 0.05, -z - 0.05) * step(0.02, 0.03, y) * step(0.0, 0.02, 0.02 - beyond))
        cheek = np.linalg.norm(np.stack([x, y, z], 1) - (0.085, 0.125, 0.262), axis=1)
        paint = mix(paint, WHITE, step(-0.075, 0.012, -cheek))
        paint = mix(paint, COAL, step(0.318, 0.012, z))
        eye = np.linalg.norm(np.stack([x, y, z], 1) - EYE, axis=1)
        paint = mix(paint, YELLOW, step(-0.030, 0.008, -eye))
        return mix(paint, COAL, step(-0.017, 0.006, -eye))


def _about_x(angle: float) -> ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def _wing(side: int) -> Field:
    flat = [ellipsoid(np.array(center) * (side, 1, 1), radii) for center, radii in WING]
    tips = [
        smooth_chain(((side * 0.52, 0.03, 0.6 * z - 0.03, 0.030), (side * (0.76 - 1.2 * abs(z)), 0.03, z, 0.018)), 4)
        for z in FINGERS
    ]
    return union([*flat, *tips], 0.03)


def _feather(joints: tuple[tuple[float, float, float, float], ...], spread: float) -> Field:
    fan = [(x + spread * i, y - 0.01 * abs(i), z, r) for i, (x, y, z, r) in enumerate(joints)]
    return smooth_chain(fan, 10)
