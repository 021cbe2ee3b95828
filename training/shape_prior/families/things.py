"""Things: vehicles, furniture, vessels, buildings, plants, tools, food, and free compositions."""

import math

import numpy as np

from training.shape_prior.chance import Chance
from training.shape_prior.families.parts import curve, eyes, held, points_between, taper, wing
from training.shape_prior.solids import CARVE, PAINT, Shape, turned
from training.shape_prior.texture import ACCENT, DARK, GLOW, LEAF, MAIN, METAL, SECOND, WHITE, WOOD

ACROSS = turned(0, 0, math.pi / 2)  # a cylinder's axis along x
FORWARD = turned(0, math.pi / 2)  # along z


def car(chance: Chance, shape: Shape) -> None:
    """Add a car, a truck, a bus or a cart."""
    shape.blend = 0.005
    long, wide, high = chance.between(0.35, 0.7), chance.between(0.16, 0.3), chance.between(0.08, 0.2)
    rounding = chance.pick((0.01, 0.04, 0.08))
    shape.box((0, 0, 0), (wide, high, long), material=MAIN, rounding=rounding)
    cabin = chance.between(0.08, 0.22)
    place, share = chance.between(-0.35, 0.5) * long, chance.between(0.25, 0.6)
    if chance.happens(0.85):
        shape.box(
            (0, high + cabin * 0.85, place),
            (wide * 0.9, cabin, long * share),
            material=MAIN,
            rounding=rounding,
            taper=-chance.between(0, 0.3),
        )
        window = chance.pick((DARK, GLOW, WHITE))
        shape.box(
            (0, high + cabin, place), (wide * 2, cabin * 0.55, long * share * 0.75), material=window, operation=PAINT
        )
        shape.box((0, high + cabin, place), (wide * 0.7, cabin * 0.55, long * 3), material=window, operation=PAINT)
    if chance.happens(0.3):
        shape.box(
            (0, high * 1.6, -0.35 * long),
            (wide * 1.02, high * chance.between(0.8, 2), long * 0.6),
            material=SECOND,
            rounding=0.01,
        )
    radius, axles = chance.between(0.07, 0.17), chance.pick((2, 2, 2, 3))
    for z in np.linspace(-0.68, 0.68, axles) * long:
        for sign in (-1, 1):
            hub = np.array([sign * wide * 0.98, -high, z])
            shape.cylinder(hub, radius, 0.05, ACROSS, DARK, 0.015)
            shape.cylinder(hub + [sign * 0.01, 0, 0], radius * 0.5, 0.05, ACROSS, METAL, operation=PAINT)
    for sign in (-1, 1):
        shape.ellipsoid((sign * wide * 0.7, 0.1 * high, long), 0.04, material=WHITE, operation=PAINT)
        shape.ellipsoid((sign * wide * 0.7, 0.1 * high, -long), 0.04, material=GLOW, operation=PAINT)
    if chance.happens(0.25):
        shape.box((0, -0.3 * high, long), (wide * 1.05, high * 0.3, 0.05), material=METAL)
    if chance.happens(0.12):
        shape.box((0, high + 0.1, -long * 0.9), (wide, 0.02, 0.08), material=ACCENT)


def aircraft(chance: Chance, shape: Shape) -> None:
    """Add a plane, a helicopter, a rocket or a spaceship."""
    shape.blend = 0.02
    long, radius = chance.between(0.4, 0.7), chance.between(0.08, 0.16)
    kind = chance.pick(("plane", "rocket", "helicopter"))
    turn = FORWARD if kind != "rocket" else np.eye(3)
    axis = turn[1]
    shape.cone(-axis * long, axis * long * 0.6, radius * chance.between(0.4, 1.0), radius, MAIN)
    shape.cone(
        axis * long * 0.5,
        axis * long * chance.between(0.8, 1.2),
        radius,
        radius * chance.between(0.1, 0.6),
        chance.pick((MAIN, ACCENT)),
    )
    start = len(shape.solids)
    if kind == "rocket":
        for i in range(chance.integer(3, 4)):
            corners = [(0.0, 0.0), (radius * 2.4, -0.25 * long), (radius * 2.4, -0.5 * long), (0.0, -0.25 * long)]
            shape.plate((0, -0.7 * long, 0), corners, 0.02, turned(math.pi / 2 * i + 0.4), ACCENT)
        shape.cylinder((0, -long - radius * 0.7, 0), radius * 0.6, radius * 0.5, material=DARK, taper=-0.3)
        shape.ellipsoid((0, long * 0.3, radius), radius * 0.5, material=WHITE, operation=PAINT)
        return
    if kind == "plane":
        span, chord = chance.between(0.4, 0.8), chance.between(0.15, 0.3)
        wing_at = np.array([0, chance.normal(0.5) * radius, chance.between(-0.1, 0.2)])
        sweep = chance.between(0, 0.4)
        level = np.stack([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
        shape.plate(wing_at, [(0, 0), (span, sweep), (span, sweep + chord * 0.5), (0, chord)], 0.018, level, SECOND)
        shape.plate(
            (0, 0, -long * 0.8), [(0, 0), (span * 0.4, 0.1), (span * 0.4, 0.2), (0, 0.18)], 0.016, level, SECOND
        )
        if chance.happens(0.4):
            shape.cone(wing_at + [span * 0.4, -0.05, 0.1], wing_at + [span * 0.4, -0.05, -0.15], 0.05, 0.04, METAL)
        shape.mirror(start)
    else:
        for i in range(chance.pick((2, 3, 4))):
            yaw = 2 * math.pi * i / 3
            way = np.array([math.cos(yaw), 0, math.sin(yaw)])
            shape.cone([0, radius * 1.7, 0], way * long + [0, radius * 1.7, 0], 0.025, 0.025, DARK)
        shape.cone((0, 0, 0), (0, radius * 1.7, 0), 0.03, 0.03, METAL)
        shape.cone((0.6 * radius, -1.4 * radius, -0.3), (0.6 * radius, -1.4 * radius, 0.3), 0.02, 0.02, METAL)
        shape.mirror(len(shape.solids) - 1)
    shape.plate(
        (0, radius * 0.6, -long * 0.75),
        [(0, 0), (0.0, 0.25), (0.14, 0.28), (0.2, 0.0)],
        0.016,
        turned(math.pi / 2),
        ACCENT,
    )
    shape.ellipsoid(
        (0, radius * 0.8, long * 0.35),
        (radius * 0.6, radius * 0.5, radius * 1.2),
        material=chance.pick((GLOW, DARK, WHITE)),
    )


def boat(chance: Chance, shape: Shape) -> None:
    """Add a boat with a mast, a sail, a cabin or a funnel."""
    long, wide, high = chance.between(0.4, 0.65), chance.between(0.13, 0.25), chance.between(0.1, 0.2)
    shape.shell((0, 0, 0), (wide, high, long), 0.025, 0.0, turned(0, math.pi), chance.pick((WOOD, MAIN)), blend=0.005)
    shape.ellipsoid((0, 0, 0), (wide * 0.95, 0.03, long * 0.95), material=WOOD)
    if chance.happens(0.6):
        top = chance.between(0.4, 0.8)
        shape.cone((0, 0, 0), (0, top, 0), 0.022, 0.018, WOOD)
        turn = turned(math.pi / 2 + chance.normal(0.4))
        shape.plate(
            (0, 0.12, 0),
            [(0, 0), (0.35, 0.02), (0.05, top - 0.15), (0, top - 0.15)],
            0.014,
            turn,
            chance.pick((WHITE, ACCENT)),
        )
    else:
        shape.box((0, 0.1, -0.1), (wide * 0.6, 0.1, long * 0.35), material=SECOND)
        shape.cylinder((0, 0.25, -0.1), 0.05, 0.12, material=ACCENT)


def seat(chance: Chance, shape: Shape) -> None:
    """Add a chair, a stool, a table, a sofa or a bed."""
    shape.blend = 0.0
    wide, deep, leg = chance.between(0.2, 0.6), chance.between(0.2, 0.4), chance.between(0.1, 0.45)
    slab = chance.between(0.02, 0.12)
    material, thick = chance.pick((WOOD, MAIN, METAL)), chance.between(0.018, 0.05)
    if chance.happens(0.15):
        shape.cylinder((0, leg, 0), wide * 0.8, slab, material=MAIN, rounding=0.02)
    else:
        shape.box((0, leg, 0), (wide, slab, deep), material=MAIN, rounding=chance.pick((0.01, 0.05)))
    if chance.happens(0.1):
        shape.cone((0, leg, 0), (0, 0, 0), thick * 2, thick * 2, material)
        shape.cylinder((0, 0, 0), wide * 0.6, 0.02, material=material)
    else:
        splay = chance.between(0, 0.12)
        for x in (-1, 1):
            for z in (-1, 1):
                shape.cone(
                    (x * (wide - thick), leg, z * (deep - thick)),
                    (x * (wide - thick + splay), 0, z * (deep - thick + splay)),
                    thick,
                    thick * 0.8,
                    material,
                )
    if chance.happens(0.6):
        tall = chance.between(0.15, 0.5)
        if chance.happens(0.5):
            shape.box(
                (0, leg + tall, -deep + slab),
                (wide, tall, max(slab * 0.8, 0.02)),
                turned(0, -chance.between(0, 0.2)),
                SECOND,
                chance.pick((0.01, 0.05)),
            )
        else:
            for x in np.linspace(-0.9, 0.9, chance.integer(2, 5)) * wide:
                shape.cone((x, leg, -deep * 0.9), (x, leg + 2 * tall, -deep), 0.022, 0.022, material)
            shape.box((0, leg + 2 * tall, -deep), (wide, 0.05, 0.025), material=material)
        if chance.happens(0.5):
            for sign in (-1, 1):
                shape.box((sign * wide, leg + 0.12, 0), (max(slab, 0.03), 0.12, deep), material=MAIN, rounding=0.03)
    if chance.happens(0.15):
        shape.ellipsoid((wide * 0.4 * chance.sign(), leg + slab + 0.08, 0), (0.12, 0.08, 0.05), material=ACCENT)


def chest(chance: Chance, shape: Shape) -> None:
    """Add a chest, a cabinet, a barrel, a crate, a lantern or a radio."""
    shape.blend = 0.0
    wide, high, deep = chance.between(0.2, 0.5), chance.between(0.12, 0.5), chance.between(0.15, 0.4)
    material, trim = chance.pick((WOOD, MAIN, METAL)), chance.pick((METAL, DARK, ACCENT))
    if chance.happens(0.2):
        shape.cylinder((0, 0, 0), deep, high, material=material, taper=0.0)
        shape.ellipsoid((0, 0, 0), (deep * 1.12, high * 1.1, deep * 1.12), material=material)
        shape.box((0, high + 0.2, 0), (1, 0.2, 1), operation=CARVE, material=material)
        shape.box((0, -high - 0.2, 0), (1, 0.2, 1), operation=CARVE, material=material)
        for y in (-0.6, 0.6):
            shape.box((0, y * high, 0), (1, 0.035, 1), material=trim, operation=PAINT)
        shape.symmetric = None
        return
    shape.box((0, 0, 0), (wide, high, deep), material=material, rounding=chance.pick((0.01, 0.04)))
    if chance.happens(0.5):
        shape.cylinder((0, high, 0), deep, wide, ACROSS, material, 0.01, flat=chance.between(0.8, 1.0))
    elif chance.happens(0.4):
        shape.box((0, high + 0.03, 0), (wide * 1.06, 0.035, deep * 1.06), material=trim, rounding=0.01)
    edge = chance.between(0.025, 0.06)
    if chance.happens(0.6):
        for sign in (-1, 1):
            shape.box(
                (sign * wide * chance.between(0.6, 0.95), 0, 0),
                (edge, high * 1.04, deep * 1.04),
                material=trim,
                rounding=0.01,
            )
        shape.box((0, high * 0.9, 0), (wide * 1.03, edge, deep * 1.03), material=trim, rounding=0.01)
    for _ in range(chance.integer(0, 3)):
        y, half = chance.between(-0.6, 0.6) * high, chance.between(0.05, 0.3) * high
        shape.box(
            (0, y, deep),
            (wide * 0.85, half, 0.02),
            material=chance.pick((SECOND, DARK)),
            operation=chance.pick((0, PAINT)),
        )
        shape.ellipsoid((0, y, deep + 0.02), 0.03, material=trim)
    if chance.happens(0.4):
        shape.box((0, high * 0.8, deep), (0.06, 0.08, 0.04), material=ACCENT)
    if chance.happens(0.3):
        for x in (-1, 1):
            for z in (-1, 1):
                shape.cone(
                    (x * wide * 0.85, -high, z * deep * 0.85),
                    (x * wide * 0.85, -high - 0.1, z * deep * 0.85),
                    0.04,
                    0.03,
                    trim,
                )
    if chance.happens(0.15):
        shape.torus((0, high + 0.1, 0), wide * 0.5, 0.025, FORWARD, trim)


def vessel(chance: Chance, shape: Shape) -> None:
    """Add something turned on a lathe: bottle, vase, cup, teapot, lamp, candle, chess piece."""
    shape.blend = chance.pick((0.0, 0.02))
    shape.symmetric = None
    y = 0.0
    for _ in range(chance.integer(2, 5)):
        half, radius = chance.between(0.03, 0.2), chance.between(0.06, 0.34)
        material = chance.pick((MAIN, SECOND, ACCENT, METAL))
        kind = chance.pick(("cylinder", "ball", "cone", "ring"))
        if kind == "cylinder":
            shape.cylinder((0, y + half, 0), radius, half, material=material, taper=chance.normal(0.25))
        elif kind == "ball":
            shape.ellipsoid((0, y + half, 0), (radius, half * 1.2, radius), material=material)
        elif kind == "cone":
            shape.cone((0, y, 0), (0, y + 2 * half, 0), radius, radius * chance.between(0.2, 0.8), material)
        else:
            shape.torus((0, y + half, 0), radius, min(half, 0.05), material=material)
        y += 2 * half * chance.between(0.75, 1.0)
    if chance.happens(0.35):
        shape.cone(
            (0, y + 0.05, 0),
            (0, y - chance.between(0.05, 0.3), 0),
            chance.between(0.05, 0.2),
            0.04,
            DARK,
            operation=CARVE,
        )
    if chance.happens(0.35):
        shape.symmetric = True
        radius = chance.between(0.08, 0.16)
        shape.torus((0, y * 0.5, -0.2 - radius * 0.5), radius, 0.028, turned(0, 0, math.pi / 2), MAIN)
        if chance.happens(0.5):
            shape.tube(
                curve((0, y * 0.4, 0.15), 0, 0.6, chance.between(0.2, 0.4), [(0, 0.4)] * 2), [0.06, 0.045, 0.03], MAIN
            )
    if chance.happens(0.2):
        shape.shell((0, y + 0.1, 0), (0.3, 0.3, 0.3), 0.02, 0.1, material=GLOW)


def building(chance: Chance, shape: Shape) -> None:
    """Add a house, a tower, a tent or a windmill."""
    shape.blend = 0.0
    wide, high, deep = chance.between(0.15, 0.45), chance.between(0.15, 0.5), chance.between(0.15, 0.45)
    if chance.happens(0.3):
        shape.cylinder((0, 0, 0), wide, high, material=MAIN, taper=-chance.between(0, 0.25))
        shape.cone((0, high + 0.05, 0), (0, high + chance.between(0.3, 0.6), 0), wide * 1.05, 0.03, SECOND)
    else:
        shape.box((0, 0, 0), (wide, high, deep), material=MAIN, rounding=0.01)
        rise, eave = chance.between(0.15, 0.4), chance.between(1.05, 1.25)
        corners = [(-wide * eave, 0.0), (wide * eave, 0.0), (0.02, rise), (-0.02, rise)]
        shape.plate((0, high, 0), corners, deep * eave, np.eye(3), SECOND)
    shape.box((chance.normal(0.2) * wide, -high * 0.6, deep), (0.06, high * 0.4, 0.3), material=DARK, operation=PAINT)
    for x in (-0.55, 0.55):
        shape.box(
            (x * wide, high * 0.3, 0), (0.06, 0.07, 2), material=chance.pick((GLOW, WHITE, DARK)), operation=PAINT
        )
        shape.box((0, high * 0.3, x * deep), (2, 0.07, 0.06), material=chance.pick((GLOW, DARK)), operation=PAINT)
    if chance.happens(0.4):
        shape.box((wide * 0.5, high + 0.3, 0), (0.06, 0.18, 0.06), material=ACCENT)
    if chance.happens(0.15):
        hub, roll = np.array([0, high, max(deep, wide) + 0.08]), chance.between(0, 1.5)
        for i in range(4):
            turn = turned(0, 0, roll + i * math.pi / 2)
            shape.plate(hub, [(-0.05, 0.05), (0.05, 0.05), (0.07, 0.5), (-0.02, 0.5)], 0.014, turn, WHITE)
    if chance.happens(0.3):
        shape.box((0, -high - 0.02, 0), (wide * 1.5, 0.025, deep * 1.5), material=LEAF)


def plant(chance: Chance, shape: Shape) -> None:
    """Add a tree, a bush, a flower, a cactus, a mushroom or a potted plant."""
    kind = chance.pick(("tree", "fir", "flower", "cactus", "mushroom", "potted"))
    shape.symmetric = False if kind in ("tree", "potted", "flower") else None
    high = chance.between(0.3, 0.8)
    if kind == "potted":
        shape.cylinder((0, -0.12, 0), 0.16, 0.13, material=MAIN, taper=0.2)
        shape.cylinder((0, 0.0, 0), 0.2, 0.03, material=MAIN)
    if kind in ("tree", "potted"):
        trunk = curve((0, 0, 0), 0, math.pi / 2, high, [(0, chance.normal(0.15))] * 3)
        if kind == "tree":
            shape.tube(trunk, taper(chance.between(0.05, 0.1), 0.03, 4), WOOD)
        if chance.happens(0.6):
            for _ in range(chance.integer(3, 7)):
                shape.ellipsoid(
                    trunk[-1] + chance.generator.normal(0, 0.14, 3), chance.between(0.1, 0.26), material=LEAF
                )
        else:
            for _ in range(chance.integer(6, 12)):
                yaw, rise = chance.between(0, 6.3), chance.between(0.0, 1.3)
                start = len(shape.solids)
                wing(
                    chance,
                    shape,
                    np.zeros(3),
                    chance.between(0.25, 0.5),
                    chance.between(0.08, 0.16),
                    rise,
                    0,
                    LEAF,
                    "leaf",
                )
                shape.move(start, turned(yaw).T, trunk[-1] if kind == "tree" else (0, 0, 0))
    elif kind == "fir":
        shape.cone((0, 0, 0), (0, high, 0), 0.06, 0.03, WOOD)
        levels = chance.integer(2, 4)
        for i in range(levels):
            y = high * (0.3 + 0.7 * i / levels)
            shape.cone(
                (0, y, 0), (0, y + 0.4 * high, 0), 0.3 * high * (1.25 - i / levels) + 0.04, 0.03, LEAF, blend=0.0
            )
    elif kind == "flower":
        stem = curve((0, 0, 0), 0, math.pi / 2, high, [(0, chance.normal(0.12))] * 3)
        shape.tube(stem, [0.025] * 4, LEAF)
        tilt, petals = turned(0, chance.between(0.3, 1.5)), chance.integer(5, 9)
        size = chance.between(0.12, 0.22)
        for i in range(petals):
            yaw = 2 * math.pi * i / petals
            way = np.array([math.cos(yaw), 0, math.sin(yaw)])
            frame = np.stack([way, [0, 1.0, 0], np.cross(way, [0, 1.0, 0])]) @ tilt
            shape.ellipsoid(stem[-1] + way @ tilt * size, (size * 0.7, 0.018, size * 0.4), frame, MAIN, blend=0.0)
        shape.ellipsoid(stem[-1], size * 0.45, material=ACCENT)
        for side in (0.5, 3.5):
            start = len(shape.solids)
            wing(chance, shape, np.zeros(3), 0.25, 0.1, 0.6, 0, LEAF, "leaf")
            shape.move(start, turned(side).T, stem[1])
    elif kind == "cactus":
        shape.cone((0, 0, 0), (0, high, 0), 0.12, 0.11, LEAF)
        for sign in (-1, 1):
            y = high * chance.between(0.3, 0.6)
            shape.tube(
                [(0, y, 0), (sign * 0.24, y, 0), (sign * 0.26, y + chance.between(0.1, 0.3), 0)],
                [0.06, 0.06, 0.055],
                LEAF,
            )
        shape.symmetric = True
    else:
        shape.cone((0, 0, 0), (0, high * 0.6, 0), chance.between(0.06, 0.12), 0.06, WHITE)
        shape.shell(
            (0, high * 0.5, 0),
            (chance.between(0.2, 0.4), chance.between(0.15, 0.35), chance.between(0.2, 0.4)),
            0.05,
            0.05,
            material=MAIN,
        )


def tool(chance: Chance, shape: Shape) -> None:
    """Add a tool, a weapon, a guitar, an umbrella, an anchor: upright, its plane of symmetry through the handle."""
    kind = chance.pick(("held", "hammer", "guitar", "umbrella", "key", "fan"))
    shape.blend = 0.005
    if kind == "held":
        held(chance, shape, np.zeros(3), chance.between(0.5, 0.8))
        shape.symmetric = False
    elif kind == "hammer":
        shape.cone((0, -0.5, 0), (0, 0.3, 0), 0.035, 0.03, WOOD)
        size = chance.between(0.06, 0.15)
        shape.box((0, 0.35, 0), (size, size, chance.between(0.15, 0.3)), material=METAL, rounding=0.02)
    elif kind == "guitar":
        for y, radius in ((-0.3, 0.24), (0.0, 0.18)):
            shape.cylinder((0, y, 0), radius, 0.05, FORWARD, chance.pick((WOOD, MAIN)), blend=0.05)
        shape.cylinder((0, -0.12, 0.05), 0.07, 0.03, FORWARD, DARK, operation=PAINT)
        shape.box((0, 0.4, 0.03), (0.03, 0.4, 0.02), material=DARK)
        shape.box((0, 0.82, 0.03), (0.05, 0.08, 0.02), material=WOOD)
    elif kind == "umbrella":
        shape.shell((0, 0.1, 0), (0.5, chance.between(0.25, 0.5), 0.5), 0.02, 0.05, material=MAIN)
        shape.cone((0, -0.6, 0), (0, 0.4, 0), 0.02, 0.02, WOOD)
        shape.tube(curve((0, -0.6, 0), 0, -1.2, 0.25, [(0, 1.2)] * 3), [0.025] * 4, WOOD)
        shape.symmetric = None
    elif kind == "key":
        shape.torus((0, 0.4, 0), 0.16, 0.045, FORWARD, METAL)
        shape.cone((0, 0.25, 0), (0, -0.4, 0), 0.04, 0.035, METAL)
        for y in (-0.35, -0.2):
            shape.box((0.09, y, 0), (0.07, 0.03, 0.025), material=METAL)
        shape.symmetric = False
    else:
        for i in range(chance.integer(3, 5)):
            angle = 2 * math.pi * i / 4 + 0.3
            way = np.array([math.cos(angle), math.sin(angle), 0])
            shape.ellipsoid(way * 0.2, (0.18, 0.09, 0.02), turned(0, 0, angle), ACCENT)
        shape.torus((0, 0, 0), 0.42, 0.025, FORWARD, MAIN)
        shape.cone((0, -0.4, -0.1), (0, -0.75, -0.1), 0.04, 0.04, MAIN)
        shape.cylinder((0, -0.78, -0.1), 0.2, 0.03, material=MAIN)


def food(chance: Chance, shape: Shape) -> None:
    """Add a burger, a cake, an ice cream, a fruit, a sweet; sometimes with a face."""
    kind = chance.pick(("layers", "fruit", "cone", "donut"))
    shape.symmetric = None
    radius = chance.between(0.25, 0.4)
    if kind == "layers":
        y = 0.0
        for i in range(chance.integer(2, 6)):
            half = chance.between(0.03, 0.12)
            shape.cylinder(
                (0, y + half, 0),
                radius * chance.between(0.85, 1.1),
                half,
                material=(MAIN, SECOND, ACCENT, WHITE)[i % 4],
                rounding=0.03,
            )
            y += 2 * half
        shape.ellipsoid((0, y, 0), (radius, chance.between(0.05, 0.25), radius), material=MAIN)
    elif kind == "fruit":
        shape.ellipsoid((0, 0, 0), radius * np.array([1, chance.between(0.7, 1.4), 1]))
        shape.cone((0, radius * 0.9, 0), (0.03, radius * 1.4, 0), 0.03, 0.025, WOOD)
        shape.plate(
            (0, radius * 1.2, 0),
            [(0, 0), (0.12, 0.08), (0.25, 0.05), (0.12, -0.06)],
            0.014,
            turned(chance.between(0, 6)),
            LEAF,
        )
    elif kind == "cone":
        shape.cone((0, 0, 0), (0, -0.6, 0), 0.2, 0.03, WOOD)
        for i in range(chance.integer(1, 3)):
            shape.ellipsoid(
                (chance.normal(0.02), 0.1 + 0.2 * i, 0), 0.22 - 0.04 * i, material=(MAIN, SECOND, ACCENT)[i]
            )
    else:
        shape.torus(
            (0, 0, 0), radius, radius * chance.between(0.3, 0.5), turned(0, chance.pick((0.0, math.pi / 2))), MAIN
        )
    if chance.happens(0.25):
        shape.symmetric = True
        eyes(chance, shape, np.array([0, 0.1, 0]), np.full(3, radius), np.eye(3), 0.9, 0.18)


def composition(chance: Chance, shape: Shape) -> None:
    """Add a random heap of solids, most often with a mirror plane, sometimes with a face."""
    shape.blend = chance.pick((0.0, 0.03, 0.1))
    shape.symmetric = chance.happens(0.8)
    for _ in range(chance.integer(2, 7)):
        start = len(shape.solids)
        size = np.exp(chance.generator.normal(-1.8, 0.55, 3)).clip(0.03, 0.5)
        place = chance.generator.normal(0, 0.28, 3)
        alone = chance.happens(0.4) or not shape.symmetric
        if alone and shape.symmetric:
            place[0] = 0.0
        turn = (
            turned(0, chance.normal(0.7))
            if alone
            else turned(chance.normal(0.8), chance.normal(0.8), chance.normal(0.8))
        )
        material = chance.pick((MAIN, SECOND, ACCENT, METAL))
        kind = chance.pick(("solid", "limb", "wheel"))
        if kind == "solid":
            if chance.happens(0.5):
                shape.ellipsoid(place, size, turn, material)
            else:
                shape.box(place, size, turn, material)
        elif kind == "limb":
            end = place + chance.generator.normal(0, 0.35, 3) * [0 if alone and shape.symmetric else 1, 1, 1]
            shape.tube(points_between(place, end, 3), [float(size[0]), float(size[1]), float(size[2]) * 0.6], material)
        else:
            shape.cylinder(place, float(size[0]), float(size[1]) * 0.6, turn if alone else ACROSS, material)
        if not alone:
            shape.mirror(start)
    if chance.happens(0.4):
        first = shape.solids[0]
        eyes(chance, shape, first.center * [0, 1, 1], first.half, np.eye(3), 0.8, 0.2)
