"""Birds, insects and other small animals with many or no legs."""

import math

import numpy as np

from training.shape_prior.chance import Chance
from training.shape_prior.families.parts import curve, eyes, limb, taper, wing
from training.shape_prior.solids import Shape, rotation, turned
from training.shape_prior.texture import ACCENT, DARK, MAIN, SECOND, WHITE


def bird(chance: Chance, shape: Shape) -> None:
    """Add a bird: standing or flying, small or long-necked, owl or penguin."""
    size = chance.between(0.12, 0.22)
    length = size * chance.between(1.1, 2.2)
    flying = chance.happens(0.4)
    pitch = chance.between(-0.1, 0.3) if flying else chance.between(0.1, 1.35)
    turn = rotation(0, -pitch)
    shape.ellipsoid((0, 0, 0), (size, size * chance.between(0.9, 1.15), length), turn.T)
    if chance.happens(0.4):
        shape.ellipsoid(
            turn @ np.array([0, -0.25 * size, 0.25 * length]),
            (size * 0.85, size * 0.9, length * 0.7),
            turn.T,
            SECOND,
            blend=0.01,
        )
    neck = size * chance.pick((0.2, 0.6, 2.5), (4, 3, 1))
    base = turn @ np.array([0, 0.3 * size, 0.75 * length])
    rise = chance.between(0.2, 1.3)
    head = base + (neck + 0.35 * size) * np.array([0, math.sin(rise), math.cos(rise)])
    radius = size * chance.between(0.5, 0.95)
    shape.cone(base, head, size * 0.55, radius * 0.75)
    look = rotation(chance.normal(0.6) if chance.happens(0.4) else 0.0, chance.normal(0.15))
    radii = radius * np.array([0.95, 0.95, 1.05])
    shape.ellipsoid(head, radii, look.T)
    beak = radius * chance.between(0.5, 2.0)
    droop = chance.between(-0.4, 0.05) * beak
    shape.cone(
        head + look @ np.array([0, -0.1 * radius, 0.7 * radius]),
        head + look @ np.array([0, -0.15 * radius + droop, 0.8 * radius + beak]),
        radius * chance.between(0.25, 0.5),
        0.012,
        ACCENT,
        chance.between(0.5, 1.0),
        side=(0, 1, 0),
        blend=0.01,
    )
    eyes(chance, shape, head, radii, look, chance.between(0.2, 0.9), 0.22)
    if chance.happens(0.2):
        for i in range(3):
            shape.cone(
                head + [0, 0.8 * radius, 0],
                head + [0, (1.3 + 0.3 * i) * radius, (-0.2 - 0.4 * i) * radius],
                0.25 * radius,
                0.02,
                ACCENT,
            )
    start = len(shape.solids)
    if flying or chance.happens(0.2):
        root = turn @ np.array([size * 0.7, 0.3 * size, 0.3 * length])
        wing(
            chance,
            shape,
            root,
            chance.between(0.45, 0.95),
            chance.between(0.16, 0.34),
            chance.between(-0.7, 1.2),
            chance.normal(0.3),
            chance.pick((MAIN, SECOND)),
        )
    else:
        droop = chance.between(-0.1, 0.25)
        shape.ellipsoid(
            turn @ np.array([size * 0.92, 0.05 * size, -0.25 * length]),
            (0.05, size * 0.65, length * 0.95),
            turned(-0.1, 0, droop) @ turn.T,
            chance.pick((MAIN, SECOND)),
            blend=0.01,
        )
    shape.mirror(start)
    fan = size * chance.between(0.3, 1.0)
    corners = [(-0.3 * size, 0.0), (0.3 * size, 0.0), (fan, length * chance.between(0.4, 1.3)), (-fan, length * 0.9)]
    corners[3] = (-fan, corners[2][1])
    flat = np.stack([[1.0, 0, 0], rotation(0, chance.normal(0.2) - pitch) @ [0, 0, -1.0], [0, 1.0, 0]])
    flat[2] = np.cross(flat[0], flat[1])
    shape.plate(turn @ np.array([0, 0.1 * size, -0.85 * length]), corners, 0.016, flat, SECOND, blend=0.02)
    if not flying or chance.happens(0.4):
        leg = size * chance.pick((0.5, 1.2, 3.0), (3, 3, 1))
        swing = chance.normal(0.3)
        for sign in (-1.0, 1.0):
            tuck = -1.2 if flying else swing * sign
            limb(
                shape,
                (sign * size * 0.45, -0.7 * size, 0),
                [leg * 0.5, leg * 0.5],
                [0.035, 0.022, 0.02],
                [tuck + 0.3, tuck - 0.2],
                0,
                (MAIN, ACCENT),
                "claw",
                0.06,
                ACCENT,
            )


def butterfly(chance: Chance, shape: Shape) -> None:
    """Add a butterfly, a bee, a dragonfly: two pairs of wings on a thin body."""
    shape.blend = 0.02
    radius = chance.between(0.025, 0.09)
    long = chance.between(0.2, 0.5)
    shape.cone(
        (0, 0, 0),
        (0, chance.normal(0.05), -long),
        radius * 1.2,
        radius * chance.between(0.5, 1.3),
        chance.pick((MAIN, DARK)),
    )
    shape.ellipsoid((0, 0, radius), radius * 1.3, material=MAIN)
    head = np.array([0, 0.2 * radius, radius * 2.6])
    shape.ellipsoid(head, radius * chance.between(0.7, 1.1), material=DARK)
    start = len(shape.solids)
    shape.tube(curve(head, 0.5, 0.6, chance.between(0.1, 0.3), [(0.2, -0.1)] * 2), [0.014, 0.012, 0.016], DARK)
    raise_, style = chance.between(-0.5, 1.5), chance.pick(("wide", "thin"), (3, 1))
    for i in range(2):
        span = chance.between(0.3, 0.75) * (1.0 - 0.2 * i)
        chord = span * (chance.between(0.5, 0.95) if style == "wide" else chance.between(0.15, 0.3))
        sweep = (-0.35 if i == 0 else 0.5) + chance.normal(0.15)
        root = np.array([radius * 0.5, radius * 0.4, -0.05 - 0.25 * i * long])
        lift = raise_ + chance.normal(0.1)
        if chance.happens(0.5):
            wing(chance, shape, root, span, chord, lift, sweep, (MAIN, SECOND)[i], "leaf")
            continue
        out = np.array([math.cos(lift) * math.cos(sweep), math.sin(lift), -math.cos(lift) * math.sin(sweep)])
        back = np.array([0, 0, -1.0]) - out * -out[2]
        back /= np.linalg.norm(back)
        corners = [
            (0.0, -0.05),
            (span, -0.45 * chord),
            (span * chance.between(0.7, 1.0), 0.6 * chord),
            (0.15 * span, 0.5 * chord),
        ]
        shape.plate(root, corners, 0.014, np.stack([out, back, np.cross(out, back)]), (MAIN, SECOND)[i], blend=0.0)
    shape.mirror(start)
    if chance.happens(0.6):
        _legs(chance, shape, 3, radius, chance.between(0.1, 0.25), 0.0, -0.15)


def beetle(chance: Chance, shape: Shape) -> None:
    """Add a beetle, an ant, a spider, a scorpion or a crab."""
    kind = chance.pick(("beetle", "ant", "spider", "crab", "scorpion"))
    width = chance.between(0.12, 0.28) if kind in ("beetle", "crab") else chance.between(0.07, 0.16)
    long = (
        width
        * {"beetle": 1.4, "ant": 1.3, "spider": 1.2, "crab": 0.75, "scorpion": 2.0}[kind]
        * chance.between(0.8, 1.25)
    )
    height = width * chance.between(0.5, 1.0)
    shape.ellipsoid((0, 0, -long * 0.6), (width, height, long), material=MAIN)
    if kind in ("ant", "spider", "beetle"):
        shape.ellipsoid((0, -0.1 * height, long * 0.5), (width * 0.65, height * 0.6, width * 0.7), material=SECOND)
    head = np.array([0, 0, long * 0.4 if kind in ("crab", "scorpion") else long * 0.5 + width * 1.0])
    size = width * chance.between(0.35, 0.6)
    shape.ellipsoid(head, (size * 1.1, size * 0.9, size), material=chance.pick((SECOND, DARK)))
    eyes(chance, shape, head, np.full(3, size), np.eye(3), chance.between(0.4, 0.9), 0.3)
    start = len(shape.solids)
    if kind in ("crab", "scorpion"):
        points = curve(head + [width * 0.5, 0, 0], 0.9, 0.2, chance.between(0.3, 0.5), [(-0.5, chance.normal(0.3))] * 2)
        shape.tube(points, [0.045, 0.035, 0.05])
        for spread in (-0.35, 0.35):
            shape.cone(points[-1], points[-1] + np.array([spread * 0.2, 0.02, 0.17]), 0.055, 0.02, ACCENT)
    else:
        shape.tube(
            curve(
                head,
                0.5,
                chance.between(0.1, 0.9),
                chance.between(0.15, 0.45),
                [(chance.normal(0.4), chance.normal(0.3))] * 3,
            ),
            [0.022, 0.018, 0.016, 0.02],
            DARK,
        )
    shape.mirror(start)
    if kind == "beetle" and chance.happens(0.4):
        points = curve(
            head + [0, 0.5 * size, 0.5 * size], 0, 0.3, chance.between(0.15, 0.4), [(0, chance.normal(0.4, 0.2))] * 3
        )
        shape.tube(points, taper(0.06, 0.02, 4), chance.pick((WHITE, ACCENT, DARK)))
    if kind == "scorpion":
        shape.tube(curve((0, 0, -long * 1.4), math.pi, 0.3, 0.8, [(0, 0.55)] * 5), taper(width * 0.5, 0.03, 6))
    pairs = 3 if kind in ("beetle", "ant") else 4
    _legs(chance, shape, pairs, width, chance.between(0.2, 0.55), chance.between(0.3, 0.9), long)


def _legs(chance: Chance, shape: Shape, pairs: int, width: float, length: float, rise: float, long: float) -> None:
    """Add pairs of legs that go out, up and then down."""
    thick = chance.between(0.016, 0.035)
    for i in range(pairs):
        fan = (i / max(1, pairs - 1) - 0.5) * chance.between(1.0, 1.8)
        for sign in (-1.0, 1.0):
            jitter = chance.normal(0.12)
            root = np.array([sign * width * 0.6, -0.2 * width, -fan * abs(long) * 0.5])
            out = np.array([sign * math.cos(fan), 0.0, -math.sin(fan) + jitter])
            knee = root + length * 0.45 * (out + [0, rise, 0])
            foot = knee + length * 0.6 * (out * 0.55 + np.array([0, -1.0, 0]))
            shape.tube([root, knee, foot], [thick * 1.2, thick, thick * 0.7], chance.pick((DARK, SECOND)))


def crawler(chance: Chance, shape: Shape) -> None:
    """Add a snake, a caterpillar, a worm or a snail."""
    kind = chance.pick(("snake", "caterpillar", "snail"))
    if kind == "snail":
        radius = chance.between(0.14, 0.26)
        shape.tube(
            curve((0, 0, -0.4), 0, 0, 0.9, [(0, 0.0), (0, 0.1), (0, chance.between(0.5, 1.0))]),
            [0.03, 0.1, 0.1, 0.08],
            SECOND,
        )
        for i in range(4):
            shape.torus(
                (chance.normal(0.02), radius * 0.95, -0.1),
                radius * (1 - 0.25 * i),
                radius * 0.36,
                turned(0, 0, math.pi / 2),
                MAIN if i % 2 else ACCENT,
            )
        head = shape.solids[2].center + [0, 0.12, 0.12]
        for sign in (-1, 1):
            shape.cone(head, head + [sign * 0.08, 0.2, 0.1], 0.025, 0.03, SECOND)
        return
    count = chance.integer(6, 10)
    swing = chance.between(0.3, 1.1) * chance.sign()
    bends = [(swing * math.cos(1.3 * i), chance.normal(0.12)) for i in range(count)]
    points = curve((0, 0, -0.5), 0, 0, chance.between(1.2, 2.2), bends)
    radius = chance.between(0.05, 0.13)
    if kind == "caterpillar":
        shape.tube(points, [radius * 0.7] * (count + 1), SECOND)
        for i, point in enumerate(points):
            shape.ellipsoid(point, radius * chance.between(1.0, 1.2), material=(MAIN, SECOND)[i % 2])
    else:
        shape.tube(points, [0.02, *[radius] * (count - 1), radius * 0.8])
    shape.symmetric = False
    radii = radius * np.array([1.2, 0.9, 1.4])
    step = points[-1] - points[-2]
    turn = rotation(math.atan2(step[0], step[2]))
    shape.ellipsoid(points[-1], radii, turn.T)
    eyes(chance, shape, points[-1], radii, turn, 0.6, 0.3)


def fish(chance: Chance, shape: Shape) -> None:
    """Add a fish, a shark or a whale."""
    long = chance.between(0.35, 0.6)
    high, wide = long * chance.between(0.22, 0.75), long * chance.between(0.12, 0.4)
    bend = chance.normal(0.35)
    shape.ellipsoid((0, 0, 0.1 * long), (wide, high, long * 0.9))
    points = curve((0, 0, -0.3 * long), math.pi + bend, 0, 0.9 * long, [(bend, 0)] * 2)
    shape.tube(points, [high * 0.7, high * 0.35, high * 0.18], MAIN, min(1.0, wide / high * 1.1), side=(1, 0, 0))
    end, fork = points[-1], high * chance.between(0.6, 1.3)
    fin = long * chance.between(0.25, 0.55)
    upright = chance.happens(0.85)
    turn = turned(math.pi / 2 + bend * 2)
    if not upright:
        turn = np.stack([turn[0], turn[2], -turn[1]])
    notch = fin * chance.between(0.3, 0.9)
    shape.plate(
        end,
        [(-0.05, 0.0), (fin, fork), (notch, 0.0), (fin, -fork * chance.between(0.6, 1.0))],
        0.016,
        turn,
        SECOND,
        blend=0.02,
    )
    side = turned(math.pi / 2)
    tall = high * chance.between(0.4, 1.1)
    shape.plate(
        (0, high * 0.85, 0),
        [(-0.35 * long, -0.1), (0.35 * long, -0.1), (chance.between(0.1, 0.5) * long, tall), (-0.1 * long, tall)],
        0.016,
        side,
        SECOND,
        blend=0.02,
    )
    if chance.happens(0.6):
        shape.plate(
            (0, -high * 0.85, -0.2 * long),
            [(-0.2 * long, 0.1), (0.2 * long, 0.1), (0.3 * long, -0.6 * tall), (0, -0.6 * tall)],
            0.016,
            side,
            SECOND,
            blend=0.02,
        )
    start = len(shape.solids)
    wing(
        chance,
        shape,
        np.array([wide * 0.85, -0.3 * high, 0.3 * long]),
        chance.between(0.12, 0.45),
        chance.between(0.1, 0.2),
        chance.between(-1.0, 0.4),
        chance.between(0.1, 0.9),
        SECOND,
        "leaf",
    )
    shape.mirror(start)
    radii = np.array([wide, high, long * 0.9])
    eyes(chance, shape, np.array([0, 0.05 * high, 0.45 * long]), radii * [0.85, 0.5, 0.4], np.eye(3), 0.3, 0.3)
    if chance.happens(0.35):
        shape.cone(
            (0, 0, 0.75 * long), (0, chance.normal(0.05), long * chance.between(1.1, 1.5)), wide * 0.6, wide * 0.25
        )


def octopus(chance: Chance, shape: Shape) -> None:
    """Add an octopus, a jellyfish or a starfish."""
    size, count = chance.between(0.18, 0.32), chance.integer(5, 8)
    shape.ellipsoid((0, size * 0.8, 0), (size, size * chance.between(0.6, 1.5), size))
    eyes(chance, shape, np.array([0, size * 0.6, 0]), np.full(3, size), np.eye(3), 0.8, 0.2)
    drop, curl = chance.between(-1.3, 0.2), chance.normal(0.5)
    for i in range(count):
        yaw = 2 * math.pi * (i + 0.5) / count
        root = np.array([math.sin(yaw), 0, math.cos(yaw)]) * size * 0.6
        points = curve(
            root, yaw, drop, chance.between(0.4, 0.7), [(chance.normal(0.3), curl + chance.normal(0.15))] * 3
        )
        shape.tube(points, taper(size * 0.3, size * 0.08, 4), chance.pick((MAIN, SECOND), (3, 1)))
