"""A crested newt that walks: spine, crest, four legs with toes, and a skin with spots."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy import ndarray
from scipy.spatial.distance import cdist

from examples.shapes import Bones, Chain, Field, Skin, ellipsoid, mix, skin, smooth_chain, step, turn_about_z, union

SPINE = (  # x, y, z, radius from the snout to the tip of the tail
    (0.665, 0.175, 0, 0.085),
    (0.565, 0.215, 0, 0.140),
    (0.440, 0.225, 0, 0.168),
    (0.300, 0.130, 0, 0.138),
    (0.160, 0.030, 0, 0.165),
    (-0.020, -0.030, 0, 0.195),
    (-0.200, -0.030, 0, 0.178),
    (-0.350, 0.000, 0, 0.125),
    (-0.490, 0.075, 0, 0.090),
    (-0.595, 0.200, 0, 0.072),
    (-0.625, 0.350, 0, 0.058),
    (-0.565, 0.475, 0, 0.044),
    (-0.455, 0.515, 0, 0.030),
    (-0.385, 0.470, 0, 0.016),
)
JOINTS = 64
HIP = 0.55  # share of the spine where the tail begins
EYE = (0.520, 0.318, 0.108)
EYE_RADIUS = 0.066
LOOK = np.array((0.38, 0.10, 0.92))  # where the pupil points
GLINT = np.array((0.20, 0.42, 0.88))
NOSTRIL = np.array((0.735, 0.205, 0.045))
MIDDLE = np.array((0.0, 0.080, 0.0))  # of the animal, goes to the origin
LEGS = (  # shoulder, knee, foot of the near side; which half of the step it begins with
    ("front near", (0.190, -0.030, 0.105), (0.235, -0.190, 0.175), (0.215, -0.345, 0.170), 0.0),
    ("hind near", (-0.230, -0.050, 0.110), (-0.300, -0.190, 0.180), (-0.255, -0.345, 0.170), 0.5),
    ("front far", (0.190, -0.030, -0.105), (0.235, -0.190, -0.175), (0.215, -0.345, -0.170), 0.5),
    ("hind far", (-0.230, -0.050, -0.110), (-0.300, -0.190, -0.180), (-0.255, -0.345, -0.170), 0.0),
)
LEG_JOINTS = 9
SWING = 0.46  # radians, of a leg to either side
TAIL_BEND = 0.020  # radians a joint
NOD = 0.004
TOES = ((0.095, 0.045), (0.110, 0.0), (0.085, -0.050))  # forward and sideways

BACK = np.array((0.045, 0.300, 0.330))
FLANK = np.array((0.130, 0.560, 0.500))
BELLY = np.array((0.980, 0.560, 0.170))
CREST = np.array((0.960, 0.760, 0.230))
CREST_EDGE = np.array((0.860, 0.330, 0.130))
SPOT = np.array((0.030, 0.115, 0.190))
SPECK = np.array((0.780, 0.930, 0.620))


@dataclass(frozen=True)
class Newt:
    """The animal at rest, and its pose at a moment of its walk."""

    seed: int = 7

    @cached_property
    def spine(self) -> Chain:
        """From the snout to the tip of the tail."""
        return smooth_chain(SPINE, JOINTS)

    @cached_property
    def legs(self) -> list[Chain]:
        """Shoulder to foot, in the order of LEGS."""
        return [
            smooth_chain([(*shoulder, 0.078), (*knee, 0.056), (*foot, 0.048)], LEG_JOINTS)
            for _, shoulder, knee, foot, _ in LEGS
        ]

    @cached_property
    def up(self) -> ndarray:
        """Unit vectors from the spine to the back, "j 3"."""
        along = np.gradient(self.spine.points, axis=0)
        across = np.stack([along[:, 1], -along[:, 0], np.zeros(JOINTS)], 1)  # the spine runs towards -x
        return across / np.linalg.norm(across, axis=1, keepdims=True)

    @cached_property
    def crest(self) -> Chain:
        """The edge of the fin along back and tail; its joints are those of the spine."""
        share = np.linspace(0, 1, JOINTS)
        wave = 0.72 + 0.28 * np.cos(2 * np.pi * 11 * share)
        height = 0.105 * step(0.30, 0.20, share) * step(0.02, 0.16, 1 - share) * wave
        return Chain(self.spine.points + (self.spine.radii + height)[:, None] * self.up, np.full(JOINTS, 0.014))

    def field(self) -> Field:
        """Signed distance to the skin at rest."""
        fins: list[Field] = [
            Chain(np.stack([base, edge]), np.array((0.034, 0.014)))
            for base, edge in zip(self.spine.points[16:-2], self.crest.points[16:-2], strict=True)
        ]
        fin = union([*fins], 0.012)
        feet: list[Field] = []
        for leg in self.legs:
            foot, side = leg.points[-1], np.sign(leg.points[-1, 2])
            for forward, outward in TOES:
                tip = foot + np.array((forward, -0.028, side * outward))
                feet.append(Chain(np.stack([foot + np.array((0, -0.012, 0)), tip]), np.array((0.036, 0.024))))
        eyes = [ellipsoid((EYE[0], EYE[1], side * EYE[2]), (EYE_RADIUS,) * 3) for side in (1, -1)]
        body = union([self.spine, ellipsoid((0.47, 0.20, 0), (0.19, 0.135, 0.175))], 0.06)
        limbs = union([*self.legs, *feet], 0.03)
        return union([union([union([body, limbs], 0.07), fin], 0.03), union([*eyes], 0.001)], 0.012)

    @cached_property
    def skin(self) -> Skin:
        """The surface at rest."""
        return skin(self.field(), (-0.76, -0.46, -0.30), (0.80, 0.66, 0.30))

    @cached_property
    def bones(self) -> Bones:
        """Every joint of the spine and of the legs pulls at what is near it."""
        points = self.skin.points
        joints = np.concatenate([self.spine.points, *(leg.points for leg in self.legs)])
        radii = np.concatenate([self.spine.radii, *(leg.radii for leg in self.legs)])
        apart = cdist(points, joints)
        gaps = np.maximum(apart - 0.8 * radii, 0) + 0.25 * apart
        pull = np.exp(-((gaps - gaps.min(1, keepdims=True)) / 0.035))
        return Bones(pull / pull.sum(1, keepdims=True), joints)

    def at(self, moment: float) -> ndarray:
        """Vertices at a moment of the walk; 0 and 1 are the same."""
        phase = 2 * np.pi * moment
        share = np.linspace(0, 1, JOINTS)
        tail = step(HIP, 0.10, share) * np.cos(phase - 2.6 * (share - HIP)) * TAIL_BEND
        neck = step(-0.25, 0.20, -share) * np.sin(2 * phase) * NOD
        bend = np.cumsum(tail) - np.cumsum(neck[::-1])[::-1]
        pieces = np.diff(self.spine.points, axis=0)
        hip = int(HIP * JOINTS)
        turned = np.einsum("jab,jb->ja", turn_about_z(bend[:-1]), pieces)
        chain = np.concatenate([np.zeros((1, 3)), np.cumsum(turned, 0)])
        places = chain - chain[hip] + self.spine.points[hip]
        places[:, 1] += 0.012 * np.cos(2 * phase)
        places[:, 2] += 0.030 * np.sin(phase - 5.0 * share) * step(0.45, 0.3, np.abs(share - 0.4) + 0.2)
        turns = turn_about_z(bend)
        all_places, all_turns = [places], [turns]
        for leg, (_, _, _, _, start) in zip(self.legs, LEGS, strict=True):
            stride = phase + 2 * np.pi * start
            swing, lift = SWING * np.cos(stride), 0.55 * max(0.0, -np.sin(stride))
            knee = np.linspace(0, 1, LEG_JOINTS) > 0.5
            angles = swing + np.where(knee, -0.75 * swing - lift, 0.3 * lift)
            links = np.einsum("jab,jb->ja", turn_about_z(angles[1:]), np.diff(leg.points, axis=0))
            nearest = np.linalg.norm(self.spine.points - leg.points[0] * (1, 1, 0), axis=1).argmin()
            anchor = turns[nearest] @ (leg.points[0] - self.spine.points[nearest]) + places[nearest]
            all_places.append(np.concatenate([anchor[None], anchor + np.cumsum(links, 0)]))
            all_turns.append(turn_about_z(angles))
        return self.bones.pose(self.skin.points, np.concatenate(all_places), np.concatenate(all_turns)) - MIDDLE

    @cached_property
    def spots(self) -> ndarray:
        """Centers and radii of the dark spots, "s 4"; darts thrown at the skin, none near another."""
        random = np.random.default_rng(self.seed)
        points, chosen = self.skin.points, np.zeros((0, 4))
        heights = self._around(points)[1]
        for index in random.permutation(len(points))[:4000]:
            p, radius = points[index], 0.020 + 0.024 * random.random()
            clear = np.linalg.norm(chosen[:, :3] - p, axis=1) > chosen[:, 3] + radius + 0.030
            if clear.all() and heights[index] > -0.25 and p[0] < 0.36:
                chosen = np.concatenate([chosen, [[*p, radius]]])
        return chosen

    @cached_property
    def features(self) -> ndarray:
        """Inputs of the paint at every vertex, "v 7"; smooth, so that pixels may interpolate it.

        Share of the spine, height on the body, distance beyond the body, the legs, the spots, their specks, and 1 where
        the crest may be.
        """
        points = self.skin.points
        share, height, beyond = self._around(points)
        leg = np.minimum.reduce([chain(points) for chain in self.legs])
        spot = _nearest(points, self.spots[:, :3], self.spots[:, 3])
        speck = _nearest(points, self.spots[::3, :3] + (0.012, 0.012, 0), 0.28 * self.spots[::3, 3])
        middle = step(-0.055, 0.02, -np.abs(points[:, 2]))
        return np.stack([share, height, beyond, leg, spot, speck, middle], 1)

    def color(self, p: ndarray, features: ndarray) -> ndarray:
        """Paint at points of the skin at rest, "p 3"."""
        share, height, beyond, leg, spot, speck, middle = features.T
        paint = mix(BACK, FLANK, step(0.42, 0.7, 0.35 - height))
        paint = mix(paint, BELLY, step(0.42, 0.22, -height))
        paint = mix(paint, 0.85 * FLANK + 0.15 * CREST, step(-0.10, 0.08, -p[:, 1]) * step(-0.05, 0.05, -leg))
        paint = mix(paint, BELLY, step(0.315, 0.04, -p[:, 1]))
        paint = mix(paint, SPOT, 0.92 * step(0, 0.012, -spot))
        paint = mix(paint, SPECK, step(0, 0.008, -speck))
        stripes = step(0.5, 0.35, 0.5 + 0.5 * np.cos(2 * np.pi * 22 * share))
        on_crest = step(0.028, 0.016, beyond) * step(0.25, 0.04, share) * step(0.5, 0.2, height) * middle
        paint = mix(paint, mix(CREST, CREST_EDGE, stripes), on_crest)
        return self._face(p, paint)

    def _face(self, p: ndarray, paint: ndarray) -> ndarray:
        """Mouth, nostrils and eyes on top of the paint; the same on both sides."""
        q = p * (1, 1, 0) + np.abs(p) * (0, 0, 1)
        smile = 0.118 + 0.55 * (q[:, 0] - 0.60) ** 2 + 0.22 * np.maximum(0.50 - q[:, 0], 0)
        mouth = step(-0.0075, 0.006, -np.abs(q[:, 1] - smile)) * step(0.455, 0.02, q[:, 0])
        chin = step(0.0, 0.012, smile - 0.012 - q[:, 1]) * step(0.40, 0.16, q[:, 0])
        paint = mix(paint, BELLY, chin * (1 - mouth))
        paint = mix(paint, SPOT, 0.9 * mouth)
        paint = mix(paint, SPOT, step(-0.013, 0.006, -np.linalg.norm(q - NOSTRIL, axis=1)))
        offset = q - EYE
        distance = np.linalg.norm(offset, axis=1)
        facing = 0.6 * offset[:, 1] + offset[:, 2]
        ball = step(-EYE_RADIUS - 0.004, 0.004, -distance) * step(-0.01, 0.01, facing)
        direction = offset / np.maximum(distance, 1e-9)[:, None]
        look, glint = (np.arccos(np.clip(direction @ towards, -1, 1)) for towards in (LOOK, GLINT))
        iris = mix(np.array((0.99, 0.80, 0.16)), np.array((0.74, 0.60, 0.12)), step(0.75, 0.3, look))
        iris = mix(iris, np.array((0.02, 0.03, 0.05)), step(-0.56, 0.08, -look))
        iris = mix(iris, np.array((0.05, 0.12, 0.14)), step(1.12, 0.10, look))
        return mix(paint, mix(iris, np.ones(3), step(-0.20, 0.06, -glint)), ball)

    def _around(self, p: ndarray) -> tuple[ndarray, ndarray, ndarray]:
        """Share of the spine, height between belly (-1) and back (1), and distance beyond the body's tube."""
        gaps = cdist(p, self.spine.points) - self.spine.radii
        weight = np.exp(-(gaps - gaps.min(1, keepdims=True)) / 0.012)
        weight /= weight.sum(1, keepdims=True)
        share = weight @ np.linspace(0, 1, JOINTS)
        offset = p - weight @ self.spine.points
        height = (offset * (weight @ self.up)).sum(1) / (weight @ self.spine.radii)
        return share, height, (weight * gaps).sum(1)


def _nearest(points: ndarray, centers: ndarray, radii: ndarray) -> ndarray:
    """Distance to the nearest of some balls, negative inside."""
    return (cdist(points, centers) - radii).min(1)
