"""Animals on four legs: mammals, lizards, turtles, dragons."""

import math

import numpy as np

from training.shape_prior.chance import Chance
from training.shape_prior.families.parts import (
    Foot,
    curve,
    ears,
    eyes,
    limb,
    mouth,
    plates_along,
    points_between,
    tail,
    taper,
    wing,
)
from training.shape_prior.solids import PAINT, Shape, Vector, rotation, turned
from training.shape_prior.texture import ACCENT, DARK, MAIN, SECOND, WHITE


def mammal(chance: Chance, shape: Shape) -> None:
    """Add an animal like a dog, a horse, a bear, an elephant or a toy of one."""
    build = chance.pick(("cat", "horse", "bear", "toy", "elephant"), (4, 3, 3, 3, 1))
    length = chance.between(0.55, 1.0)
    width = (
        length
        * {"cat": 0.17, "horse": 0.2, "bear": 0.29, "toy": 0.3, "elephant": 0.3}[build]
        * chance.between(0.8, 1.2)
    )
    depth = width * chance.between(0.95, 1.35)
    leg = (
        length
        * {"cat": 0.42, "horse": 0.75, "bear": 0.4, "toy": 0.25, "elephant": 0.45}[build]
        * chance.between(0.7, 1.3)
    )
    thick = (
        width * {"cat": 0.3, "horse": 0.3, "bear": 0.48, "toy": 0.42, "elephant": 0.5}[build] * chance.between(0.8, 1.2)
    )
    hip, chest = np.array([0, 0, -length / 2]), np.array([0, chance.normal(0.04), length / 2])
    pose = chance.pick(("walk", "sit", "lie"), (9, 1, 1))
    _trunk(chance, shape, hip, chest, width, depth)
    _legs(chance, shape, hip, chest, width, depth, leg, thick, pose)
    head = _neck_and_head(chance, shape, chest, width, depth, build)
    tail(chance, shape, hip + [0, 0.4 * depth, -0.8 * width], width * 0.45, length * 0.8)
    if chance.happens(0.12):
        plates_along(
            shape,
            points_between(hip + [0, depth, 0], chest + [0, depth, 0], 3),
            width * 0.8,
            ACCENT,
            chance.integer(4, 8),
            chance.happens(0.7),
        )
    if chance.happens(0.08):
        for share in points_between(hip, chest, chance.integer(3, 4))[1:-1]:
            shape.ellipsoid(share + [0, depth, 0], (width * 0.6, depth * 0.6, width * 0.6))
    if chance.happens(0.1):
        start = len(shape.solids)
        wing(
            chance,
            shape,
            chest + [width * 0.7, depth * 0.6, -0.1],
            chance.between(0.4, 0.9),
            chance.between(0.2, 0.4),
            chance.between(0.1, 1.3),
            chance.between(0, 0.6),
            SECOND,
            chance.pick(("feather", "bat")),
        )
        shape.mirror(start)
    if chance.happens(0.15):
        shape.cylinder(chest + (head - chest) * 0.45, width * 0.95, 0.035, turned(0, 0.9), ACCENT, operation=PAINT)
    if chance.happens(0.1):
        shape.box(
            (hip + chest) / 2 + [0, depth * 0.6, 0],
            (width * 1.15, depth * 0.5, length * 0.2),
            material=ACCENT,
            rounding=0.05,
        )
    if pose == "sit":
        shape.move(0, rotation(0, -chance.between(0.5, 0.9)), (0, 0, 0))


def _trunk(chance: Chance, shape: Shape, hip: Vector, chest: Vector, width: float, depth: float) -> None:
    flat = min(1.0, width / depth)
    back, front = depth * chance.between(0.75, 1.05), depth * chance.between(0.8, 1.15)
    shape.cone(hip, chest, back, front, MAIN, flat, side=(1, 0, 0))
    middle = (hip + chest) / 2 + [0, chance.normal(0.08) * depth, 0]
    if chance.happens(0.5):
        shape.ellipsoid(
            middle,
            (width * chance.between(0.85, 1.2), depth * chance.between(0.9, 1.15), 0.4 * float(chest[2] - hip[2])),
        )
    if chance.happens(0.15):
        band = chance.between(0.3, 0.6) * float(chest[2] - hip[2])
        shape.box(middle + [0, 0, chance.normal(0.1)], (1, 1, band / 2), material=SECOND, operation=PAINT)


def _legs(
    chance: Chance,
    shape: Shape,
    hip: Vector,
    chest: Vector,
    width: float,
    depth: float,
    leg: float,
    thick: float,
    pose: str,
) -> None:  # fmt: skip
    feet: tuple[Foot, ...] = ("none", "paw", "paw", "hoof", "boot")
    foot, gait = chance.pick(feet), chance.pick((0.0, 0.15, 0.4, 0.7), (3, 3, 3, 2))
    phase, pattern = (
        chance.between(0, 2 * math.pi),
        chance.pick(((0, math.pi, math.pi, 0), (0, math.pi, 0, math.pi), (0, 0.5, math.pi, 3.6))),
    )
    lower = chance.pick((MAIN, SECOND, DARK), (4, 2, 1))
    lean = chance.between(-0.02, 0.12)
    for i, (base, sign) in enumerate(((hip, -1.0), (hip, 1.0), (chest, -1.0), (chest, 1.0))):
        swing = gait * math.sin(phase + pattern[i]) + chance.normal(0.04)
        fold = gait * max(0.0, math.cos(phase + pattern[i])) * 1.2
        rear = base is hip
        x = sign * (width - thick * 0.9) * 0.95
        start = base + [x, -0.3 * depth, 0.25 * width * (1 if rear else -0.5)]
        swings = (
            [swing + 0.25, swing - 0.35 - fold, swing + 0.1 - 0.5 * fold]
            if rear
            else [swing - 0.1, swing + 0.15 - fold, swing - 0.5 * fold]
        )
        if pose == "lie":
            swings = [1.2, 1.5, 1.5] if not rear else [1.1, -1.2, 1.4]
        elif pose == "sit" and rear:
            swings = [1.9, 0.2, 2.2]
        elif pose == "sit":
            swings = [value - 0.7 for value in swings]
        radii = [thick * value for value in (1.5 if rear else 1.3, 1.0, 0.85, 0.8)]
        limb(
            shape,
            start,
            [leg * 0.45, leg * 0.4, leg * 0.25],
            radii,
            swings,
            sign * lean,
            (MAIN, lower),
            foot,
            thick * chance.between(0.7, 1.2),
            chance.pick((MAIN, SECOND, DARK)),
        )


def _neck_and_head(chance: Chance, shape: Shape, chest: Vector, width: float, depth: float, build: str) -> Vector:
    rise = chance.between(0.0, 1.25)
    length = {"cat": 0.9, "horse": 2.2, "bear": 0.6, "toy": 0.6, "elephant": 0.5}[build] * width * chance.between(
        0.6, 1.5
    ) + 0.5 * width
    if build == "horse" and chance.happens(0.12):
        length *= 2.2
    neck = chest + [0, 0.35 * depth, 0.3 * width]
    head = neck + length * np.array([0, math.sin(rise), math.cos(rise)])
    size = (
        width
        * {"cat": 0.8, "horse": 0.65, "bear": 0.8, "toy": 1.15, "elephant": 0.95}[build]
        * chance.between(0.75, 1.25)
    )
    shape.cone(neck, head, width * 0.75, size * 0.7)
    turn = rotation(chance.normal(0.45) if chance.happens(0.4) else 0.0, chance.between(-0.15, 0.45), 0)
    head = head + turn @ np.array([0, 0, 0.4 * size])
    radii = size * np.array([chance.between(0.8, 1.0), chance.between(0.8, 1.0), chance.between(0.85, 1.2)])
    shape.ellipsoid(head, radii, turn.T)
    snout = size * chance.between(0.6, 1.3) * (1.6 if build == "horse" else 0.9)
    end = head + turn @ np.array([0, -0.35 * size, 0.75 * size + snout * 0.6])
    tip = size * chance.between(0.25, 0.55)
    if build == "elephant" and chance.happens(0.7):
        points = curve(
            head + turn @ np.array([0, -0.2 * size, 0.8 * size]),
            chance.normal(0.2),
            -0.8,
            size * chance.between(1.5, 3.0),
            [(0, chance.normal(0.4, -0.3))] * 4,
        )
        shape.tube(points, taper(0.35 * size, 0.16 * size, 5))
        tusk = len(shape.solids)
        shape.cone(
            head + [0.35 * size, -0.4 * size, 0.7 * size],
            head + [0.45 * size, -0.7 * size, 1.6 * size],
            0.1 * size,
            0.04,
            WHITE,
        )
        shape.mirror(tusk)
    else:
        shape.cone(
            head + turn @ np.array([0, -0.2 * size, 0.5 * size]),
            end,
            size * 0.5,
            tip,
            chance.pick((MAIN, SECOND, WHITE), (3, 2, 1)),
        )
        shape.ellipsoid(end + turn @ np.array([0, 0.3 * tip, 0.8 * tip]), tip * 0.45, turn.T, DARK, operation=PAINT)
        if chance.happens(0.4):
            mouth(chance, shape, end, np.full(3, tip), turn)
    eyes(chance, shape, head, radii, turn, chance.between(0.5, 0.9), 0.17)
    ears(chance, shape, head, size * 0.9, turn)
    if build == "horse" and chance.happens(0.6):
        for point in points_between(neck + [0, 0.2 * width, -0.5 * width], head + [0, 0.6 * size, -0.4 * size], 5):
            shape.ellipsoid(point, (0.25 * width, 0.45 * width, 0.4 * width), material=SECOND)
    if chance.happens(0.08):
        shape.ellipsoid(
            head + [0, -0.2 * size, -0.3 * size],
            size * chance.between(1.3, 1.7) * np.array([1, 1, 0.6]),
            material=SECOND,
            blend=0.02,
        )
    return np.asarray(head)


def lizard(chance: Chance, shape: Shape) -> None:
    """Add a long low animal with splayed legs: newt, crocodile, gecko, turtle, dragon."""
    length, width = chance.between(0.5, 0.9), chance.between(0.08, 0.2)
    bend = chance.normal(0.3)
    spine = curve((0, 0, -length / 2), -bend, 0, length, [(bend * 0.7, chance.normal(0.06))] * 3)
    shape.tube(
        spine, [width * value for value in (0.8, 1.1, 1.05, 0.8)], MAIN, chance.between(0.65, 1.0), side=(0, 1, 0)
    )
    shell = chance.happens(0.25)
    if shell:
        dome = np.array(
            [width * chance.between(1.6, 2.4), width * chance.between(0.9, 1.8), length * chance.between(0.45, 0.6)]
        )
        shape.shell((0, 0, 0), dome, 0.03, -0.1, material=SECOND, blend=0.01)
        shape.ellipsoid((0, 0, 0), dome * [0.98, 0.35, 0.98], material=ACCENT, blend=0.01)
    lean, gait = chance.between(0.4, 1.3), chance.between(0.1, 0.8)
    leg = chance.between(0.14, 0.35) * (1.3 if shell else 1.0)
    foot: Foot = chance.pick(("claw", "paw"))
    for base, order in ((spine[0], 1), (spine[-1], -1)):
        for sign in (-1.0, 1.0):
            swing = gait * sign * order + chance.normal(0.1)
            root = base * [1, 1, 0.75] + [sign * width * (0.9 if not shell else 1.5), -0.2 * width, 0]
            limb(
                shape,
                root,
                [leg * 0.5, leg * 0.5],
                [width * 0.4, width * 0.32, width * 0.28],
                [swing, -0.3 * swing],
                sign * lean,
                (MAIN,),
                foot,
                0.05,
                chance.pick((MAIN, SECOND)),
            )
    skull = width * chance.between(0.8, 1.3)
    rise = chance.between(-0.1, 0.8)
    neck = chance.between(0.05, 0.35)
    head = spine[-1] + (neck + skull * 0.5) * np.array([0.3 * math.sin(bend), math.sin(rise), math.cos(rise)])
    shape.cone(spine[-1], head, width * 0.75, skull * 0.8)
    turn = rotation(bend * 0.5 + chance.normal(0.2), chance.between(-0.2, 0.3))
    radii = skull * np.array([1.0, chance.between(0.65, 0.95), chance.between(1.0, 1.3)])
    shape.ellipsoid(head, radii, turn.T)
    snout = skull * chance.between(0.3, 2.0)
    shape.cone(
        head,
        head + turn @ np.array([0, -0.15 * skull, skull + snout]),
        skull * 0.75,
        skull * 0.45,
        MAIN,
        0.7,
        side=(0, 1, 0),
    )
    eyes(chance, shape, head, radii, turn, chance.between(0.2, 0.6), 0.3)
    long = chance.between(0.15, 0.5) if shell else chance.between(0.5, 1.1)
    wag = chance.normal(0.4)
    rear = curve(
        spine[0], math.pi + bend, chance.between(-0.2, 0.3), long * length * 1.1, [(wag, chance.normal(0.25))] * 4
    )
    shape.tube(rear, taper(width * 0.75, width * 0.12, 5), MAIN)
    if chance.happens(0.35):
        ridge = [point + [0, 0.8 * width, 0] for point in [*reversed(rear[:3]), *spine]]
        plates_along(shape, ridge, width * chance.between(0.5, 1.3), ACCENT, chance.integer(6, 12), chance.happens(0.7))
    if chance.happens(0.12) and not shell:
        start = len(shape.solids)
        wing(
            chance,
            shape,
            spine[2] + [width * 0.7, width * 0.6, 0],
            chance.between(0.4, 0.9),
            chance.between(0.25, 0.45),
            chance.between(0.1, 1.3),
            chance.between(0, 0.5),
            SECOND,
            "bat",
        )
        shape.mirror(start)


def dinosaur(chance: Chance, shape: Shape) -> None:
    """Add a two-legged animal with a long tail: tyrannosaur, kangaroo, small dragon."""
    width, lean, length = chance.between(0.12, 0.24), chance.between(0.0, 1.0), chance.between(0.35, 0.65)
    hip = np.zeros(3)
    chest = hip + length * np.array([0, math.sin(lean), math.cos(lean)])
    shape.cone(hip, chest, width * chance.between(0.95, 1.3), width * chance.between(0.65, 1.0))
    stride, leg = chance.between(0, 0.7), chance.between(0.35, 0.7)
    phase = chance.sign()
    for sign in (-1.0, 1.0):
        swing = stride * sign * phase
        limb(
            shape,
            hip + [sign * width * 0.75, -0.05, 0],
            [leg * 0.4, leg * 0.35, leg * 0.3],
            [width * 0.6, width * 0.38, width * 0.26, width * 0.24],
            [swing + 0.6, swing - 0.7, swing + 0.2],
            sign * 0.05,
            (MAIN,),
            chance.pick(("claw", "paw", "boot")),
            chance.between(0.05, 0.12),
            SECOND,
        )
        arm = chance.between(0.12, 0.35)
        limb(
            shape,
            chest + [sign * width * 0.75, -0.05, 0],
            [arm * 0.5, arm * 0.5],
            [width * 0.28, width * 0.2, width * 0.15],
            [chance.between(0, 0.9), chance.between(0.3, 1.5)],
            sign * 0.2,
            (MAIN,),
            "claw",
            0.04,
        )
    rise, neck = chance.between(0.2, 1.4), chance.between(0.1, 0.45)
    head = chest + neck * np.array([0, math.sin(rise), math.cos(rise)])
    size = chance.between(0.1, 0.2)
    shape.cone(chest, head, width * 0.75, size * 0.8)
    turn = rotation(chance.normal(0.3) if chance.happens(0.4) else 0.0, chance.between(-0.1, 0.4))
    radii = size * np.array([0.85, 0.9, 1.15])
    head = head + [0, 0, 0.4 * size]
    shape.ellipsoid(head, radii, turn.T)
    shape.cone(
        head + turn @ np.array([0, -0.1 * size, 0.6 * size]),
        head + turn @ np.array([0, -0.2 * size, size * chance.between(1.3, 2.3)]),
        size * 0.65,
        size * 0.4,
        chance.pick((MAIN, SECOND)),
    )
    eyes(chance, shape, head, radii, turn, chance.between(0.3, 0.7), 0.2)
    if chance.happens(0.4):
        ears(chance, shape, head, size, turn)
    bend = chance.normal(0.25)
    rear = curve(
        hip + [0, 0, -0.4 * width],
        math.pi + bend,
        chance.between(-0.5, 0.3),
        chance.between(0.4, 1.0),
        [(bend * 0.4, chance.normal(0.3))] * 4,
    )
    shape.tube(rear, taper(width * 0.95, width * 0.12, 5))
    if chance.happens(0.4):
        ridge = [point + [0, 0.7 * width, -0.3 * width] for point in (*reversed(rear[:4]), chest, head)]
        plates_along(shape, ridge, width * chance.between(0.4, 1.0), ACCENT, chance.integer(5, 11), chance.happens(0.7))
    if chance.happens(0.2):
        start = len(shape.solids)
        wing(
            chance,
            shape,
            chest + [width * 0.6, 0.3 * width, -0.6 * width],
            chance.between(0.35, 0.9),
            chance.between(0.2, 0.45),
            chance.between(0.1, 1.2),
            chance.between(0, 0.6),
            SECOND,
            chance.pick(("bat", "feather")),
        )
        shape.mirror(start)
