"""Samples: a synthetic shape, seen as `prepare_subject` shows it, with the matter and colors behind every pixel."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64, UInt8, UInt16
from scipy import ndimage

from dg4d_lib.cameras.orbit import RADIUS
from dg4d_lib.shape_prior.frustum import BINS, FAR, NEAR, SIZE, TAN_HALF_FOV
from training.shape_prior.chance import Chance
from training.shape_prior.families import FAMILIES
from training.shape_prior.kernels import INTERVALS, MOST_SOLIDS, cross, fill, shade
from training.shape_prior.solids import Matrix, Shape, Solid, Vector, packed, rotation, scaled, thickened
from training.shape_prior.texture import lighting, palette
from training.shape_prior.warp import attach, random_warp, warped

THINNEST = 0.016  # half size of a solid, world units: a ray cannot step over it
DEEPEST = 0.82  # reach in depth from the plane z = 0, world units
CENTERED_SPAN = 0.8  # of the frame: `SubjectSettings.border` is 0.2
SMALLEST_SHARE, LARGEST_SHARE = 0.015, 0.62  # of the frame that the subject covers
ATTACHED, WARPED = 0.12, 0.6  # shares of the samples
TRIES = 20


@dataclass(frozen=True)
class Sample:
    """One training example.

    Attributes:
        picture: premultiplied color and alpha, row, column, channel.
        pixels: flat indices of the pixels whose middle ray meets matter.
        counts: crossings of those rays, even.
        depths: of the crossings, 0 at `NEAR`, 65535 at `FAR`; rays by 2 x INTERVALS.
        colors: of the crossings.
        plane: unit normal and offset of the mirror plane, world; zeros if unknown or if there is none.
        symmetric: 1 with a mirror plane, 0 without, 0.5 if every vertical plane is one.
        family: name of the recipe.
    """

    picture: UInt8[np.ndarray, "s s 4"]
    pixels: UInt16[np.ndarray, " n"]
    counts: UInt8[np.ndarray, " n"]
    depths: UInt16[np.ndarray, "n k"]
    colors: UInt8[np.ndarray, "n k 3"]
    plane: Float32[np.ndarray, " 4"]
    symmetric: float
    family: str


@dataclass(frozen=True)
class Pose:
    """Place of a shape in the world.

    Attributes:
        turn: object to world rotation.
        scale: world units per object unit.
        shift: world place of the object's origin.
    """

    turn: Matrix
    scale: float
    shift: Vector

    def place(self, solid: Solid) -> Solid:
        """Return the solid in world units."""
        grown = scaled(solid, self.scale)
        return replace(grown, center=self.turn @ grown.center + self.shift, axes=grown.axes @ self.turn.T)

    def inverse(self, extent: float) -> Float64[np.ndarray, "3 4"]:
        """Return the map from the world to object space in units of `extent`."""
        linear = self.turn.T / (self.scale * extent)
        return np.column_stack([linear, -linear @ self.shift])


def make_sample(seed: int, index: int, family: str | None = None, size: int = SIZE) -> Sample:
    """Make sample number `index` of a seed: the same numbers give the same sample.

    Args:
        seed: of the whole set.
        index: of the sample.
        family: a name in `FAMILIES`; drawn if it is None.
        size: pixels of a side.
    """
    chance = Chance([seed, index])
    scene, seen = _shown_scene(chance, family, size)
    colors, parts = seen.shaded(scene)
    picture = _picture(chance, colors[:, :, 0], seen.coverage, seen.depths[:, :, 0], parts)
    return _sample(scene, seen, colors, picture)


def make_views(
    seed: int, index: int, azimuths_deg: Sequence[float], size: int = SIZE
) -> tuple[Sample, Float32[np.ndarray, "v s s 4"]]:
    """Make a sample whose picture is a plain rendering, and renderings of it from other azimuths.

    Args:
        seed: of the whole set.
        index: of the sample.
        azimuths_deg: of the other cameras, at elevation 0.
        size: pixels of a side.

    Returns:
        The sample, and premultiplied color and alpha of the views.
    """
    scene, seen = _shown_scene(Chance([seed, index]), None, size)
    colors, _ = seen.shaded(scene)
    views = []
    for azimuth in azimuths_deg:
        around = scene.seen_from(azimuth)
        shown = _Seen.of(around, size)
        views.append(_premultiplied(shown.shaded(around)[0][:, :, 0], shown.coverage))
    picture = (_premultiplied(colors[:, :, 0], seen.coverage) * 255 + 0.5).astype(np.uint8)
    return _sample(scene, seen, colors, picture), np.stack(views)


@dataclass(frozen=True)
class _Scene:
    """Placed shape with its light.

    Attributes:
        shape: in object units.
        pose: of the shape.
        family: name of the recipe.
        materials: rows of `texture`.
        light: row of `texture`.
    """

    shape: Shape
    pose: Pose
    family: str
    materials: Float64[np.ndarray, "m n"]
    light: Float64[np.ndarray, " 10"]

    def packed(self) -> tuple[np.ndarray, np.ndarray]:
        """Return labels and numbers of the solids in world units."""
        solids = self.shape.solids[:MOST_SOLIDS]
        placed = [self.pose.place(solid) for solid in solids]
        return packed([thickened(solid, THINNEST) if solid.operation == 0 else solid for solid in placed])

    def to_object(self) -> Float64[np.ndarray, "3 4"]:
        """Return the map from the world to object space, in units of the shape's extent."""
        solids = [solid for solid in self.shape.solids[:MOST_SOLIDS] if solid.operation == 0]
        return self.pose.inverse(max(float(np.abs(solid.outline_points()).max()) for solid in solids))

    def seen_from(self, azimuth_deg: float) -> "_Scene":
        """Rotate the scene and its light so that the input camera shows the view from an azimuth."""
        turn = rotation(-math.radians(azimuth_deg))
        pose = Pose(turn @ self.pose.turn, self.pose.scale, turn @ self.pose.shift)
        return replace(self, pose=pose, light=np.concatenate([turn @ self.light[:3], self.light[3:]]))


@dataclass(frozen=True)
class _Seen:
    """Rays of the input camera through a scene; see the kernels."""

    labels: np.ndarray
    numbers: np.ndarray
    field: Float32[np.ndarray, "s s d"]
    near: np.ndarray
    counts: UInt8[np.ndarray, "s s"]
    depths: Float32[np.ndarray, "s s k"]
    coverage: Float32[np.ndarray, "s s"]
    nearest: Float32[np.ndarray, "s s"]

    @classmethod
    def of(cls, scene: _Scene, size: int) -> "_Seen":
        """Trace the scene."""
        labels, numbers = scene.packed()
        field = np.empty((size, size, BINS), np.float32)
        near = np.empty((size, size, 2), np.uint64)
        fill(labels, numbers, field, near)
        counts, nearest = np.empty((size, size), np.uint8), np.empty((size, size), np.float32)
        depths, coverage = np.zeros((size, size, 2 * INTERVALS), np.float32), np.empty((size, size), np.float32)
        cross(field, counts, depths, coverage, nearest)
        return cls(labels, numbers, field, near, counts, depths, coverage, nearest)

    def shaded(self, scene: _Scene) -> tuple[Float32[np.ndarray, "s s k 3"], np.ndarray]:
        """Return the colors of all crossings, and the solid seen first at every pixel."""
        colors, parts = np.zeros((*self.depths.shape, 3), np.float32), np.empty(self.counts.shape, np.int16)
        shade(
            self.labels, self.numbers, scene.materials, scene.light, scene.to_object(), self.field, self.near,
            self.counts, self.depths, self.coverage, self.nearest, colors, parts,
        )  # fmt: skip
        return colors, parts


def _shown_scene(chance: Chance, family: str | None, size: int) -> tuple[_Scene, _Seen]:
    """Return a random scene whose picture is neither nearly empty nor full, and its rays."""
    for _ in range(TRIES):
        name = family or chance.pick(list(FAMILIES), [weight for _, weight, _ in FAMILIES.values()])
        shape = Shape(blend=chance.pick((0.01, 0.03, 0.05)))
        recipe, _, style = FAMILIES[name]
        recipe(chance, shape)
        if chance.happens(ATTACHED):
            other = chance.pick(list(FAMILIES), [weight for _, weight, _ in FAMILIES.values()])
            attach(chance, shape, FAMILIES[other][0], MOST_SOLIDS)
        if chance.happens(WARPED):
            warp = random_warp(chance, shape)
            shape.solids = [warped(solid, warp) for solid in shape.solids]
        pose = _pose(chance, [solid for solid in shape.solids[:MOST_SOLIDS] if solid.operation == 0])
        scene = _Scene(shape, pose, name, np.empty((0, 0)), np.empty(10))
        seen = _Seen.of(scene, size)
        if SMALLEST_SHARE < (seen.counts > 0).mean() < LARGEST_SHARE:
            return replace(scene, materials=palette(chance, style), light=lighting(chance)), seen
    raise RuntimeError(f"no sample after {TRIES} tries: family {family}")


def _sample(
    scene: _Scene, seen: _Seen, colors: Float32[np.ndarray, "s s k 3"], picture: UInt8[np.ndarray, "s s 4"]
) -> Sample:
    """Return the rays that meet matter, quantized."""
    pixels = np.flatnonzero(seen.counts)
    normal = scene.pose.turn[:, 0]
    symmetric = scene.shape.symmetric
    unit = (seen.depths.reshape(-1, 2 * INTERVALS)[pixels] - NEAR) / (FAR - NEAR)
    return Sample(
        picture=picture,
        pixels=pixels.astype(np.uint16),
        counts=seen.counts.reshape(-1)[pixels],
        depths=(unit.clip(0, 1) * 65535 + 0.5).astype(np.uint16),
        colors=(colors.reshape(-1, 2 * INTERVALS, 3)[pixels] * 255 + 0.5).astype(np.uint8),
        plane=np.array([*normal, normal @ scene.pose.shift], np.float32) * (symmetric is True),
        symmetric=0.5 if symmetric is None else float(symmetric),
        family=scene.family,
    )


def _premultiplied(
    color: Float32[np.ndarray, "s s 3"], coverage: Float32[np.ndarray, "s s"]
) -> Float32[np.ndarray, "s s 4"]:
    return np.concatenate([color.clip(0, 1) * coverage[..., None], coverage[..., None]], -1)


def _pose(chance: Chance, solids: list[Solid]) -> Pose:
    """Return a view as users and our data have it: any yaw, a small tilt, framed as `prepare_subject` frames."""
    view = chance.pick(("front", "side", "oblique", "any"), (0.28, 0.27, 0.25, 0.2))
    if view == "front":
        yaw = chance.normal(0.3)
    elif view == "side":
        yaw = chance.sign() * math.pi / 2 + chance.normal(0.25)
    elif view == "oblique":
        yaw = chance.sign() * chance.between(0.35, 1.2)
    else:
        yaw = chance.between(-math.pi, math.pi)
    level = chance.happens(0.45)
    pitch = chance.normal(0.02) if level else chance.normal(0.13, 0.06)
    turn = rotation(0, pitch, chance.normal(0.01 if level else 0.04)) @ rotation(yaw)
    points = np.concatenate([solid.outline_points() for solid in solids]) @ turn.T
    middle = (points.max(0) + points.min(0)) / 2
    points = points - middle
    framing = chance.pick(("center", "orbit", "keep", "cropped"), (0.45, 0.37, 0.15, 0.03))
    deep = DEEPEST / float(np.abs(points[:, 2]).max())
    if framing == "orbit":
        scale = min(deep, chance.between(0.5, 0.82) / float(np.linalg.norm(points, axis=1).max()))
        shift = np.array([chance.normal(0.05), chance.normal(0.08), chance.normal(0.05)])
        return Pose(turn, scale, shift - scale * middle)
    span = {"center": CENTERED_SPAN, "keep": chance.between(0.4, 0.95), "cropped": chance.between(1.0, 1.3)}[framing]
    scale, shift = framed(points, span, deep)
    shift[2] += chance.normal(0.02)
    if framing == "keep":
        room = max(0.0, 0.96 - span) * RADIUS * TAN_HALF_FOV
        shift[:2] += room * np.array([chance.normal(0.35), chance.normal(0.35)])
    elif framing == "cropped":
        shift[1] -= (span - 0.9) * RADIUS * TAN_HALF_FOV
    return Pose(turn, scale, shift - scale * middle)


def framed(points: Float64[np.ndarray, "n 3"], span: float, most: float) -> tuple[float, Vector]:
    """Return scale and shift by which points appear centered and span a share of the frame.

    Args:
        points: of the turned shape, its middle in the origin.
        span: of the longer side, as a share of the frame.
        most: greatest scale allowed.
    """
    scale, shift = 0.5, np.zeros(3)
    for _ in range(6):
        world = points * scale + shift
        seen = world[:, :2] / (RADIUS - world[:, 2:]).clip(0.3) / TAN_HALF_FOV
        low, high = seen.min(0), seen.max(0)
        shift[:2] -= (low + high) / 2 * RADIUS * TAN_HALF_FOV * 0.9
        scale = min(most, scale * 2 * span / float((high - low).max()))
    return scale, shift


def _picture(
    chance: Chance,
    color: Float32[np.ndarray, "s s 3"],
    coverage: Float32[np.ndarray, "s s"],
    depth: Float32[np.ndarray, "s s"],
    parts: np.ndarray,
) -> UInt8[np.ndarray, "s s 4"]:
    """Return the premultiplied picture: rendered, or like a drawing, or like a badly cut-out photograph."""
    style = chance.pick(("render", "drawing", "rough"), (0.72, 0.13, 0.15))
    color, alpha = color.astype(np.float64), coverage.astype(np.float64)
    if style == "drawing":
        color = _as_drawing(chance, color, alpha, depth, parts)
    elif style == "rough":
        color = color + chance.generator.normal(0, chance.between(0, 0.06), color.shape)
        color = (color - 0.5) * chance.between(0.6, 1.2) + 0.5 + chance.normal(0.06)
        if chance.happens(0.4):
            alpha = ndimage.gaussian_filter(alpha, chance.between(0.3, 0.8))
        elif chance.happens(0.4):
            alpha = (alpha > 0.5).astype(float)
    if chance.happens(0.35):
        sigma = chance.between(0.3, 0.9)
        weight = ndimage.gaussian_filter(alpha, sigma) + 1e-4
        color = ndimage.gaussian_filter(color * alpha[..., None], (sigma, sigma, 0)) / weight[..., None]
    premultiplied = np.concatenate([color.clip(0, 1) * alpha[..., None], alpha[..., None]], -1)
    return (premultiplied * 255 + 0.5).astype(np.uint8)


def _as_drawing(
    chance: Chance, color: Float64[np.ndarray, "s s 3"], alpha: Float64[np.ndarray, "s s"],
    depth: Float32[np.ndarray, "s s"], parts: np.ndarray,
) -> Float64[np.ndarray, "s s 3"]:  # fmt: skip
    """Stylize the colors as a drawing: dark lines along outlines and between parts, painted or on bare paper."""
    inside = np.where(alpha > 0.4, depth, 9.0)
    reach = chance.pick((1, 1, 2))
    edge = np.zeros_like(alpha)
    for axis in (0, 1):
        jump = np.abs(inside - np.roll(inside, 1, axis)) > chance.pick((0.06, 0.15))
        if chance.happens(0.4):
            jump |= parts != np.roll(parts, 1, axis)
        edge = np.maximum(edge, jump)
    edge = np.maximum(edge, ndimage.binary_dilation(edge > 0, iterations=reach) * 1.0) if reach > 1 else edge
    edge = ndimage.gaussian_filter(edge, 0.5).clip(0, 1)
    line = np.array([chance.between(0, 0.35), chance.between(0, 0.3), chance.between(0, 0.35)])
    if chance.happens(0.35):
        paper = chance.between(0.65, 1.0)
        color = paper + (color - paper) * chance.pick((0.0, 0.15, 0.5))
        color = color + ndimage.gaussian_filter(chance.generator.normal(0, 0.05, color.shape), (1, 1, 0))
    return color + (line - color) * edge[..., None]
