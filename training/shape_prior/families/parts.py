"""Parts that many families share: limbs, tails, faces, ears, hats, wings, held things."""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from training.shape_prior.chance import Chance
from training.shape_prior.solids import PAINT, UNION, Matrix, Point, Shape, Vector, rotation, turned
from training.shape_prior.texture import ACCENT, DARK, GLOW, IRIS, MAIN, METAL, SECOND, WHITE, WOOD

Foot = Literal["none", "paw", "boot", "hoof", "claw", "block"]


def curve(start: Point, yaw: float, pitch: float, length: float, bends: Sequence[tuple[float, float]]) -> list[Vector]:
    """Return points of a polyline that begins along +z turned by yaw and raised by pitch.

    Args:
        start: first point.
        yaw: radians, towards +x.
        pitch: radians, towards +y.
        length: of all segments together.
        bends: changes of yaw and pitch after every segment; as many segments as bends.
    """
    points = [np.asarray(start, float)]
    for more_yaw, more_pitch in bends:
        step = [math.cos(pitch) * math.sin(yaw), math.sin(pitch), math.cos(pitch) * math.cos(yaw)]
        points.append(points[-1] + length / len(bends) * np.array(step))
        yaw, pitch = yaw + more_yaw, pitch + more_pitch
    return points


def taper(first: float, last: float, count: int) -> list[float]:
    """Return `count` radii from the first to the last."""
    return [last + (first - last) * (1 - i / max(1, count - 1)) for i in range(count)]


def limb(
    shape: Shape, start: Point, lengths: Sequence[float], radii: Sequence[float], swings: Sequence[float],
    lean: float = 0.0, materials: Sequence[int] = (MAIN,), foot: Foot = "none", foot_size: float = 0.05,
    foot_material: int = SECOND,
) -> Vector:  # fmt: skip
    """Add a jointed limb and return its end.

    Args:
        shape: what to add to.
        start: the joint at the body.
        lengths: of the segments.
        radii: one more than segments.
        swings: angle of every segment in the plane of the walk, radians from straight down, forwards.
        lean: outward angle, radians; towards +x.
        materials: of the segments; the last one goes on.
        foot: shape of its end.
        foot_size: object units.
        foot_material: of the foot.
    """
    point = np.asarray(start, float)
    for i, (length, swing) in enumerate(zip(lengths, swings, strict=True)):
        out = lean * (1.0 if i == 0 else 0.75)
        step = [math.sin(out), -math.cos(out) * math.cos(swing), math.cos(out) * math.sin(swing)]
        following = point + length * np.array(step)
        material = materials[min(i, len(materials) - 1)]
        shape.cone(point, following, radii[i], radii[i + 1], material)
        point = following
    add_foot(shape, point, foot, foot_size, radii[-1], foot_material)
    return point


def add_foot(shape: Shape, ankle: Vector, foot: Foot, size: float, radius: float, material: int) -> None:
    """Add a foot that points forwards."""
    if foot == "paw":
        shape.ellipsoid(
            ankle + [0, -0.2 * radius, 0.4 * size], (radius * 1.2, radius * 0.8, size + radius * 0.5), material=material
        )
    elif foot == "boot":
        shape.cone(ankle, ankle + [0, -0.4 * radius, size * 1.5], radius * 1.15, radius * 0.9, material)
    elif foot == "hoof":
        shape.cylinder(ankle - [0, size * 0.4, 0], radius * 1.25, size * 0.5, material=material, taper=-0.2)
    elif foot == "claw":
        for side in (-0.5, 0.0, 0.5):
            tip = ankle + [math.sin(side) * size * 1.3, -radius, math.cos(side) * size * 1.3]
            shape.cone(ankle, tip, radius * 0.7, radius * 0.3, material)
    elif foot == "block":
        half = (radius * 1.4, size * 0.45, size + radius)
        shape.box(ankle + [0, -size * 0.3, size * 0.4], half, material=material, rounding=0.01)


def eyes(
    chance: Chance, shape: Shape, center: Vector, radii: Vector, turn: Matrix, forward: float = 0.8, size: float = 0.2
) -> None:
    """Put two eyes on an ellipsoidal head; `turn` turns the head, `forward` is 0 for eyes at its sides."""
    side = math.acos(min(max(forward, 0.05), 0.97)) * chance.between(0.7, 1.0)
    height = chance.between(-0.1, 0.4)
    size *= float(radii.min()) * chance.between(0.6, 1.5)
    bulge = chance.pick((0.0, 0.5, 1.0), (0.5, 0.3, 0.2))
    white = chance.happens(0.55)
    for sign in (-1.0, 1.0):
        direction = np.array([sign * math.sin(side), height, math.cos(side)])
        direction /= np.linalg.norm(direction)
        on = direction * radii * (1 - 0.12 * bulge)
        place = center + turn @ on
        solid = UNION if bulge else PAINT
        if white:
            shape.ellipsoid(place, np.array([1, 1.1, 1]) * size * 1.35, turn.T, WHITE, blend=0.0, operation=solid)
            pupil = center + turn @ (on + direction * size * (1.2 if bulge else 0.1))
            shape.ellipsoid(pupil, np.array([0.8, 1.0, 0.8]) * size, turn.T, IRIS, operation=PAINT)
            shape.ellipsoid(pupil, size * 0.5, turn.T, DARK, operation=PAINT)
        else:
            shape.ellipsoid(place, np.array([0.9, 1.1, 0.9]) * size, turn.T, DARK, blend=0.0, operation=solid)


def mouth(chance: Chance, shape: Shape, center: Vector, radii: Vector, turn: Matrix) -> None:
    """Paint or carve a mouth at the front of an ellipsoid."""
    place = center + turn @ (np.array([0, chance.between(-0.55, -0.3), 0.85]) * radii)
    half = np.array([chance.between(0.2, 0.5), chance.between(0.03, 0.16), 0.35]) * radii
    shape.ellipsoid(place, half, turn.T, chance.pick((DARK, ACCENT)), operation=PAINT)


def ears(chance: Chance, shape: Shape, center: Vector, radius: float, turn: Matrix) -> None:
    """Add a pair of ears, horns or antlers to a head."""
    kind = chance.pick(("pointed", "round", "hanging", "long", "horns", "antlers", "none"), (5, 4, 3, 2, 2, 1, 2))
    start = len(shape.solids)
    h, inner = radius, chance.pick((MAIN, SECOND, ACCENT))

    def at(x: float, y: float, z: float) -> Vector:
        return center + turn @ (np.array([x, y, z]) * h)

    if kind == "pointed":
        size = chance.between(0.5, 1.1)
        corners = [(-0.3 * h, -0.3 * h), (0.35 * h, -0.3 * h), (0.1 * h, size * h), (0.0, size * h)]
        turn_ear = turned(chance.between(-0.2, 0.9), chance.between(-0.3, 0.1), chance.between(-0.6, -0.1)) @ turn.T
        shape.plate(at(0.5, 0.7, chance.between(-0.2, 0.2)), corners, 0.1 * h, turn_ear, inner, blend=0.02)
    elif kind == "round":
        size = chance.between(0.25, 0.5)
        shape.ellipsoid(at(0.7, 0.75, -0.1), (size * h, size * h, 0.35 * size * h), turn.T, inner, blend=0.02)
    elif kind == "hanging":
        length = chance.between(0.4, 1.1)
        shape.ellipsoid(at(0.95, 0.3 - 0.5 * length, -0.1), (0.15 * h, length * h * 0.6, 0.35 * h), turn.T, inner)
    elif kind == "long":
        tip = (chance.between(0.3, 0.9), chance.between(1.8, 2.8), chance.between(-0.8, 0.1))
        shape.cone(at(0.4, 0.8, 0), at(*tip), 0.22 * h, 0.16 * h, inner, flat=0.5)
    elif kind == "horns":
        points = curve(
            at(0.45, 0.75, 0.1), 1.0, 1.0, chance.between(0.6, 1.6) * h, [(chance.normal(0.7), chance.normal(0.5))] * 3
        )
        shape.tube(points, taper(0.2 * h, 0.04 * h, 4), chance.pick((WHITE, DARK, ACCENT)))
    elif kind == "antlers":
        points = curve(at(0.3, 0.85, 0), 0.9, 1.0, chance.between(1.2, 2.2) * h, [(0.3, 0.1)] * 3)
        shape.tube(points, taper(0.12 * h, 0.06 * h, 4), WOOD)
        for point in points[1:3]:
            shape.cone(point, point + turn @ (np.array([0.05, 0.6, 0.3]) * h), 0.08 * h, 0.05 * h, WOOD)
    for solid in shape.solids[start:]:
        local = turn.T @ (solid.center - center)
        mirrored = turn @ (local * [-1, 1, 1])
        axes = ((solid.axes @ turn) * [-1, 1, 1]) @ turn.T
        shape.solids.append(
            type(solid)(
                solid.kind,
                solid.operation,
                solid.material,
                center + mirrored,
                axes,
                solid.half,
                solid.parameters,
                solid.blend,
            )
        )


def tail(chance: Chance, shape: Shape, start: Point, thickness: float, longest: float) -> None:
    """Add a tail that points backwards: a curved tube, a tuft, a brush or a stub."""
    kind = chance.pick(("tube", "brush", "tuft", "stub", "none"), (5, 3, 2, 2, 1))
    if kind == "none":
        return
    if kind == "stub":
        shape.ellipsoid(
            np.asarray(start) + [0, 0.3 * thickness, -0.5 * thickness],
            thickness * chance.between(0.5, 1.0),
            material=SECOND,
        )
        return
    count = chance.integer(3, 5)
    wag = chance.normal(0.35) if chance.happens(0.6) else 0.0
    bends = [(wag / count, chance.normal(0.3))] * count
    points = curve(start, math.pi + wag, chance.between(-1.1, 1.2), chance.between(0.25, 1.0) * longest, bends)
    if kind == "brush":
        radii = [thickness * value for value in (0.5, *([1.1] * (count - 1)), 0.3)]
    else:
        radii = taper(thickness * chance.between(0.4, 1.0), thickness * chance.between(0.1, 0.5), count + 1)
    shape.tube(points, radii, MAIN)
    shape.solids[-1] = type(shape.solids[-1])(**{**shape.solids[-1].__dict__, "material": chance.pick((MAIN, SECOND))})
    if kind == "tuft":
        shape.ellipsoid(points[-1], thickness * chance.between(0.5, 1.0), material=SECOND)


def hat(chance: Chance, shape: Shape, top: Vector, radius: float, turn: Matrix) -> None:
    """Put something on a head: a hat, a helmet, a crown, a bow."""
    kind = chance.pick(("witch", "cap", "cylinder", "helmet", "crown", "straw", "beanie", "bow"))
    m, r = chance.pick((MAIN, SECOND, ACCENT, DARK)), radius

    def at(x: float, y: float, z: float) -> Vector:
        return top + turn @ (np.array([x, y, z]) * r)

    if kind in ("witch", "straw", "cylinder"):
        brim = chance.between(1.3, 2.2)
        shape.cylinder(at(0, -0.3, 0), brim * r, 0.05 * r, turn.T, m, flat=chance.between(0.85, 1.0))
        if kind == "witch":
            middle = at(chance.normal(0.1), chance.between(0.6, 1.0), chance.normal(0.15))
            shape.cone(at(0, -0.2, 0), middle, 0.85 * r, 0.4 * r, m)
            shape.cone(
                middle, at(chance.normal(0.4), chance.between(1.2, 2.0), chance.normal(0.5)), 0.4 * r, 0.05 * r, m
            )
        else:
            shape.cylinder(
                at(0, 0.15, 0),
                0.85 * r,
                (0.8 if kind == "cylinder" else 0.4) * r,
                turn.T,
                m,
                taper=chance.between(-0.2, 0.15),
            )
        shape.cylinder(at(0, -0.1, 0), 0.9 * r, 0.14 * r, turn.T, chance.pick((ACCENT, SECOND, DARK)), blend=0.0)
    elif kind == "cap":
        shape.shell(at(0, -0.45, 0), 1.08 * r, 0.05 * r, 0.35, turn.T, m)
        shape.ellipsoid(at(0, -0.05, 0.95), (0.65 * r, 0.06 * r, 0.6 * r), turn.T, m)
    elif kind == "helmet":
        shape.shell(
            at(0, -0.55, -0.05),
            np.array([1.12, 1.15, 1.15]) * r,
            0.06 * r,
            chance.between(-0.3, 0.3),
            turn.T,
            chance.pick((METAL, m)),
        )
        if chance.happens(0.5):
            corners = [(-0.9 * r, 0.0), (0.9 * r, 0.0), (0.5 * r, 0.6 * r), (-0.8 * r, 0.5 * r)]
            shape.plate(at(0, 0.3, 0), corners, 0.06 * r, turned(math.pi / 2) @ turn.T, ACCENT)
    elif kind == "crown":
        for i in range(6):
            angle = math.pi / 3 * i
            base = at(0.75 * math.sin(angle), -0.1, 0.75 * math.cos(angle))
            shape.cone(base, base + turn @ np.array([0, 0.45 * r, 0]), 0.16 * r, 0.05 * r, chance.pick((METAL, GLOW)))
        shape.torus(at(0, -0.15, 0), 0.78 * r, 0.1 * r, turn.T, METAL)
    elif kind == "beanie":
        shape.shell(at(0, -0.4, 0), np.array([1.08, chance.between(1.0, 1.4), 1.08]) * r, 0.07 * r, 0.3, turn.T, m)
        shape.ellipsoid(at(0, 0.75, 0), 0.25 * r, material=ACCENT)
    else:
        for sign in (-1, 1):
            shape.ellipsoid(
                at(0.4 * sign, 0.1, 0.1), (0.4 * r, 0.28 * r, 0.12 * r), turned(0, 0, 0.4 * sign) @ turn.T, ACCENT
            )


def hair(chance: Chance, shape: Shape, center: Vector, radii: Vector, turn: Matrix, material: int) -> None:
    """Put hair on a head."""
    r = float(radii.mean())

    def at(x: float, y: float, z: float) -> Vector:
        return center + turn @ (np.array([x, y, z]) * radii)

    style = chance.pick(("short", "long", "bun", "tails", "spiky", "mohawk", "afro"), (5, 3, 2, 2, 2, 1, 1))
    cap = chance.between(0.05, 0.35)
    shape.shell(at(0, 0.03, -0.08), radii * 1.07, 0.07 * r, cap, turn.T, material, blend=0.01)
    shape.ellipsoid(at(0, 0.1, -0.35), radii * [1.0, 0.9, 0.75], turn.T, material, blend=0.01)
    if chance.happens(0.5):
        for sign in (-1, 1):
            shape.ellipsoid(
                at(0.5 * sign, 0.65, 0.62),
                radii * [0.5, 0.22, 0.3],
                turned(0, 0, -0.5 * sign) @ turn.T,
                material,
                blend=0.01,
            )
    if style == "long":
        length = chance.between(0.5, 1.8)
        shape.ellipsoid(at(0, -0.4 * length, -0.6), radii * [0.95, 0.8 + 0.5 * length, 0.4], turn.T, material)
    elif style == "bun":
        shape.ellipsoid(at(0, chance.between(0.4, 1.1), -0.9), 0.4 * r, material=material)
    elif style == "tails":
        for sign in (-1, 1):
            shape.cone(
                at(sign, 0.3, -0.3), at(1.3 * sign, chance.between(-1.6, -0.3), -0.4), 0.3 * r, 0.12 * r, material
            )
    elif style == "spiky":
        for _ in range(7):
            way = np.array([chance.normal(0.6), chance.between(0.4, 1.0), chance.normal(0.6, -0.2)])
            way /= np.linalg.norm(way)
            shape.cone(at(*(0.8 * way)), at(*(chance.between(1.25, 1.7) * way)), 0.3 * r, 0.03 * r, material)
    elif style == "mohawk":
        for i in range(5):
            angle = -0.5 + 0.45 * i
            shape.ellipsoid(
                at(0, 1.05 * math.cos(angle), -1.05 * math.sin(angle)), (0.12 * r, 0.3 * r, 0.3 * r), turn.T, material
            )
    elif style == "afro":
        shape.ellipsoid(at(0, 0.4, -0.25), radii * chance.between(1.15, 1.4), turn.T, material, blend=0.0)


def held(chance: Chance, shape: Shape, hand: Vector, reach: float) -> None:
    """Put a thing into a hand: staff, sword, shield, ball, bag, axe, flag, umbrella."""
    kind = chance.pick(("staff", "sword", "shield", "ball", "bag", "axe", "flag", "gun"))
    way = np.array([chance.normal(0.25), chance.normal(1.0), abs(chance.normal(0.5)) + 0.05])
    way /= np.linalg.norm(way)
    across = np.cross(way, [1.0, 0, 0])
    across /= max(1e-6, float(np.linalg.norm(across)))
    if kind == "staff":
        shape.cone(
            hand - way * reach * chance.between(0.2, 0.9),
            hand + way * reach * chance.between(0.4, 1.1),
            0.022,
            0.022,
            WOOD,
        )
        shape.ellipsoid(
            shape.solids[-1].center + way * float(shape.solids[-1].half[1]), chance.between(0.04, 0.12), material=GLOW
        )
    elif kind == "sword":
        frame = np.stack([across, way, np.cross(across, way)])
        length, width = reach * chance.between(0.4, 1.1), chance.between(0.03, 0.08)
        corners = [(-width, 0.0), (width, 0.0), (0.5 * width, length), (-0.3 * width, length)]
        shape.plate(hand + way * 0.05, corners, 0.012, frame, METAL, blend=0.0)
        shape.cone(hand - way * 0.08, hand + way * 0.06, 0.022, 0.022, WOOD)
        shape.cone(hand + way * 0.06 - across * 0.08, hand + way * 0.06 + across * 0.08, 0.02, 0.02, ACCENT)
    elif kind == "shield":
        turn = turned(chance.normal(0.4), math.pi / 2 + chance.normal(0.15))
        shape.cylinder(
            hand + [0, 0, 0.06],
            chance.between(0.12, 0.28),
            0.02,
            turn,
            chance.pick((METAL, SECOND, WOOD)),
            flat=chance.between(0.8, 1.3),
        )
        shape.ellipsoid(hand + [0, 0, 0.08], 0.06, material=ACCENT)
    elif kind == "ball":
        shape.ellipsoid(
            hand + [0, 0, 0.05], chance.between(0.05, 0.2), material=chance.pick((ACCENT, GLOW, SECOND)), blend=0.0
        )
    elif kind == "bag":
        size = np.array([chance.between(0.04, 0.1), chance.between(0.08, 0.16), chance.between(0.08, 0.18)])
        shape.box(hand - [0, size[1] + 0.08, 0], size, material=ACCENT, rounding=0.03, blend=0.0)
        shape.torus(hand - [0, 0.06, 0], 0.06, 0.012, turned(0, 0, math.pi / 2), ACCENT)
    elif kind == "axe":
        head = hand + way * reach * chance.between(0.3, 0.8)
        shape.cone(hand - way * 0.2 * reach, head, 0.02, 0.02, WOOD)
        frame = np.stack([across, way, np.cross(across, way)])
        w = chance.between(0.08, 0.2)
        shape.plate(head, [(0, -0.3 * w), (w, -w), (w, w), (0, 0.3 * w)], 0.018, frame, METAL, blend=0.0)
        if chance.happens(0.5):
            shape.plate(head, [(0, -0.3 * w), (-w, -w), (-w, w), (0, 0.3 * w)], 0.018, frame, METAL, blend=0.0)
    elif kind == "flag":
        top = hand + np.array([0, reach, 0])
        shape.cone(hand - [0, 0.4 * reach, 0], top, 0.016, 0.016, WOOD)
        w, h = chance.between(0.2, 0.5), chance.between(0.15, 0.3)
        shape.plate(
            top, [(0, 0), (w, -0.1 * h), (w, -h), (0, -h)], 0.012, turned(chance.between(-3, 3)), ACCENT, blend=0.0
        )
    else:
        shape.cone(hand, hand + [0, 0, reach * chance.between(0.3, 0.7)], 0.03, 0.025, METAL)
        shape.box(hand + [0, 0, 0.05], (0.025, 0.05, 0.1), material=DARK, rounding=0.01)


def wing(
    chance: Chance, shape: Shape, root: Vector, span: float, chord: float, raise_: float, sweep: float, material: int,
    style: str = "feather",
) -> None:  # fmt: skip
    """Add the right wing (towards +x) as plates.

    Args:
        chance: source of the draws.
        shape: what to add to.
        root: where it begins.
        span: its length.
        chord: its width along z at the root.
        raise_: radians above the horizontal; above pi / 2 it is folded over the back.
        sweep: radians by which it points backwards.
        material: index of the palette.
        style: "feather", "bat" or "leaf".
    """
    out = np.array([math.cos(raise_) * math.cos(sweep), math.sin(raise_), -math.cos(raise_) * math.sin(sweep)])
    back = np.array([0.0, 0.0, -1.0])
    back = back - out * (out @ back)
    back /= max(1e-6, float(np.linalg.norm(back)))
    frame = np.stack([out, back, np.cross(out, back)])
    thick = 0.014
    if style == "leaf":
        shape.ellipsoid(root + out * span * 0.5, (span * 0.55, chord * 0.5, 0.018), frame, material, blend=0.01)
        return
    bend = chance.between(-0.5, 0.3)
    elbow = root + out * span * 0.45 - back * chord * 0.15
    corners = [(0.0, -0.2 * chord), (span * 0.45, -0.35 * chord), (span * 0.45, 0.7 * chord), (0.0, 0.8 * chord)]
    shape.plate(root, corners, thick, frame, material, blend=0.01)
    tip_out = rotation(0, 0, bend) @ out
    tip_back = back - tip_out * (tip_out @ back)
    tip_back /= max(1e-6, float(np.linalg.norm(tip_back)))
    tip_frame = np.stack([tip_out, tip_back, np.cross(tip_out, tip_back)])
    joint = root + out * span * 0.45
    far, lag = span * 0.6, chance.between(0.1, 0.9) * chord
    corners = [(0.0, -0.35 * chord), (far, lag - 0.2 * chord), (far * 0.9, lag + 0.1 * chord), (0.0, 0.7 * chord)]
    shape.plate(joint, corners, thick, tip_frame, material if style == "feather" else SECOND, blend=0.01)
    shape.cone(root, elbow, 0.035, 0.028, MAIN)
    if style == "bat":
        for share in (0.1, 0.55, 0.9):
            shape.cone(
                elbow, joint + tip_out * far * (1 - share * 0.6) + tip_back * chord * share * 0.7, 0.02, 0.014, MAIN
            )


def plates_along(
    shape: Shape, points: Sequence[Vector], height: float, material: int, count: int, spiky: bool = True
) -> None:
    """Add a row of flat triangles or balls on top of a line of points, as of a dragon's back."""
    line = np.asarray(points)
    for i in range(count):
        at = (i + 0.5) / count * (len(line) - 1)
        low = min(int(at), len(line) - 2)
        place = line[low] + (at - low) * (line[low + 1] - line[low])
        size = height * (0.5 + math.sin(math.pi * (i + 0.5) / count) * 0.6)
        if spiky:
            corners = [(-0.5 * size, 0.0), (0.5 * size, 0.0), (0.55 * size, size), (0.45 * size, size)]
            shape.plate(place, corners, 0.016, turned(math.pi / 2), material, blend=0.0)
        else:
            shape.ellipsoid(place, size * 0.5, material=material)


def points_between(a: Point, b: Point, count: int) -> list[Vector]:
    """Return evenly spaced points of a segment."""
    first, last = np.asarray(a, float), np.asarray(b, float)
    return [first + (last - first) * i / (count - 1) for i in range(count)]
