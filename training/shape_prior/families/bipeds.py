"""Figures on two legs: people, dolls, toys, robots."""

import math

import numpy as np

from training.shape_prior.chance import Chance
from training.shape_prior.families.parts import Foot, ears, eyes, hair, hat, held, limb, mouth, wing
from training.shape_prior.solids import PAINT, Shape, Vector, rotation, turned
from training.shape_prior.texture import ACCENT, DARK, GLOW, HAIR, MAIN, METAL, SECOND, SKIN, WHITE


def person(chance: Chance, shape: Shape) -> None:
    """Add a person, a doll or an animal that stands upright, with clothes."""
    chibi = chance.happens(0.5)
    animal = chance.happens(0.22)
    skin = MAIN if animal else SKIN
    torso = chance.between(0.2, 0.36) if chibi else chance.between(0.36, 0.5)
    width = torso * chance.between(0.38, 0.62) * (1.15 if chibi else 0.85)
    flat = chance.between(0.55, 0.95)
    leg = torso * chance.between(0.6, 1.2) if chibi else torso * chance.between(1.3, 1.8)
    size = torso * chance.between(0.55, 0.95) if chibi else torso * chance.between(0.28, 0.38)
    thick = width * chance.between(0.26, 0.42)
    lean = chance.normal(0.12)
    shoulder = np.array([0, torso * math.cos(lean), torso * math.sin(lean)])
    hip, chest = np.array([0, 0.1 * torso, 0]), shoulder * 0.8
    waist = chance.between(0.75, 1.2)
    shape.cone(hip, chest, width * waist * 0.85, width * chance.between(0.8, 1.05), MAIN, flat)
    shape.ellipsoid(hip, (width * 0.9 * waist, width * 0.7, width * flat * 0.9), material=SECOND)
    _legs(chance, shape, width, leg, thick, skin)
    hands = _arms(
        chance,
        shape,
        shoulder * 0.9,
        width,
        torso * (1.0 if not chibi else chance.between(0.8, 1.1)),
        thick * 0.85,
        skin,
    )
    _head(chance, shape, shoulder, size, chibi, skin, animal)
    _clothes(chance, shape, width, torso, leg, flat)
    if chance.happens(0.3):
        held(chance, shape, chance.pick(hands), chance.between(0.25, 0.6))
    if chance.happens(0.07):
        start = len(shape.solids)
        wing(
            chance,
            shape,
            np.array([0.3 * width, 0.8 * torso, -width * flat]),
            chance.between(0.3, 0.8),
            chance.between(0.15, 0.35),
            chance.between(0.1, 1.2),
            chance.between(0.2, 0.9),
            SECOND,
            chance.pick(("feather", "bat", "leaf")),
        )
        shape.mirror(start)


def _legs(chance: Chance, shape: Shape, width: float, leg: float, thick: float, skin: int) -> None:
    pose = chance.pick(("stand", "walk", "run", "sit", "wide"), (5, 3, 2, 1, 1))
    stride = (
        {"stand": 0.05, "walk": 0.4, "run": 0.9, "sit": 0.1, "wide": 0.1}[pose]
        * chance.between(0.5, 1.2)
        * chance.sign()
    )
    upper = chance.pick((SECOND, MAIN, skin))
    lower = chance.pick((upper, skin, SECOND), (3, 1, 1))
    feet: tuple[Foot, ...] = ("boot", "boot", "paw", "block", "none")
    foot = chance.pick(feet)
    shoe = chance.pick((ACCENT, DARK, SECOND, skin))
    spread = chance.between(0.0, 0.15) + (0.35 if pose == "wide" else 0.0)
    fatter = chance.between(1.1, 1.6)
    for sign in (-1.0, 1.0):
        swing = stride * sign
        bend = max(0.0, -swing) * 1.2 + (1.2 if pose == "run" and swing < 0 else 0.1 * chance.between(0, 1))
        swings = [1.5, chance.between(-0.1, 0.3)] if pose == "sit" else [swing, swing - bend]
        limb(
            shape,
            (sign * width * 0.5, 0, 0),
            [leg * 0.5, leg * 0.5],
            [thick * fatter, thick, thick * chance.between(0.75, 1.1)],
            swings,
            sign * spread,
            (upper, lower),
            foot,
            thick * chance.between(0.7, 1.6),
            shoe,
        )


def _arms(
    chance: Chance, shape: Shape, shoulder: Vector, width: float, arm: float, thick: float, skin: int
) -> list[Vector]:  # fmt: skip
    pose = chance.pick(("down", "walk", "tee", "up", "fold", "free"), (5, 3, 2, 1, 2, 3))
    together, hands = chance.happens(0.5), []
    sleeve = chance.pick((MAIN, SECOND, skin), (4, 1, 1))
    forearm = chance.pick((sleeve, skin))
    phase = chance.between(-0.8, 0.8)
    draws = [(chance.between(-0.9, 1.6), chance.between(0, 1.5), chance.between(0.0, 1.2)) for _ in range(2)]
    for i, sign in enumerate((-1.0, 1.0)):
        swing, bend, lean = draws[0] if together else draws[i]
        if pose == "down":
            swing, bend, lean = 0.1 * swing, 0.3 * bend, 0.12 + 0.3 * lean
        elif pose == "walk":
            swing, bend, lean = phase * sign, 0.4 * bend + 0.2, 0.1 + 0.1 * lean
        elif pose == "tee":
            swing, bend, lean = 0.1 * swing, 0.1 * bend, 1.2 + 0.35 * lean
        elif pose == "up":
            swing, bend, lean = 0.15 * swing, 0.2 * bend, 2.0 + 0.7 * lean
        elif pose == "fold":
            swing, bend, lean = 0.2 + 0.2 * swing, 1.0 + 0.6 * bend, 0.15
        start = shoulder + [sign * (width + 0.2 * thick), 0, 0]
        hand = limb(
            shape,
            start,
            [arm * 0.48, arm * 0.45],
            [thick * 1.15, thick, thick * 0.8],
            [swing, swing + bend],
            sign * lean,
            (sleeve, forearm),
        )
        grip = thick * chance.between(0.9, 1.5)
        shape.ellipsoid(hand, (grip * 0.85, grip * 1.1, grip), material=chance.pick((skin, ACCENT), (4, 1)))
        hands.append(hand)
    if chance.happens(0.15):
        for sign in (-1.0, 1.0):
            shape.ellipsoid(
                shoulder + [sign * width * 1.1, 0.3 * thick, 0], thick * chance.between(1.5, 2.2), material=METAL
            )
    return hands


def _head(chance: Chance, shape: Shape, shoulder: Vector, size: float, chibi: bool, skin: int, animal: bool) -> None:
    neck = size * chance.between(0.0, 0.35)
    radii = size * np.array([chance.between(0.8, 1.1), chance.between(0.9, 1.1), chance.between(0.8, 1.05)])
    turn = rotation(chance.normal(0.4) if chance.happens(0.4) else 0.0, chance.normal(0.15), chance.normal(0.06))
    head = shoulder + [0, neck + radii[1] * 0.85, chance.between(0, 0.15) * size]
    shape.cone(shoulder - [0, 0.1, 0], head, size * 0.4, size * 0.4, skin)
    shape.ellipsoid(head, radii, turn.T, skin)
    eyes(chance, shape, head, radii, turn, chance.between(0.8, 0.95), 0.16 if chibi else 0.13)
    if animal:
        ears(chance, shape, head, float(radii[1]), turn)
        end = head + turn @ (radii * [0, -0.25, 1.05 + chance.between(0, 0.5)])
        shape.cone(
            head + turn @ (radii * [0, -0.25, 0.6]), end, size * 0.4, size * 0.25, chance.pick((MAIN, SECOND, WHITE))
        )
        shape.ellipsoid(end + turn @ np.array([0, 0.05, 0.2]) * size, size * 0.14, material=DARK, operation=PAINT)
    else:
        if chance.happens(0.6):
            shape.ellipsoid(
                head + turn @ (radii * [0, -0.12, 1.0]), size * np.array([0.12, 0.14, 0.16]), turn.T, skin, blend=0.02
            )
        if chance.happens(0.6):
            for sign in (-1, 1):
                shape.ellipsoid(
                    head + turn @ (radii * [sign * 1.0, -0.05, 0]),
                    size * np.array([0.12, 0.22, 0.16]),
                    turn.T,
                    skin,
                    blend=0.01,
                )
    if chance.happens(0.7):
        mouth(chance, shape, head, radii, turn)
    hooded = chance.happens(0.08)
    if not animal and chance.happens(0.8):
        hair(chance, shape, head, radii, turn, HAIR)
    if chance.happens(0.12) and not animal:
        shape.ellipsoid(
            head + turn @ (radii * [0, -0.75, 0.55]), radii * [0.65, chance.between(0.4, 1.0), 0.45], turn.T, HAIR
        )
    if hooded:
        shape.ellipsoid(head + turn @ (radii * [0, 0.05, -0.2]), radii * 1.18, turn.T, MAIN, blend=0.0)
    elif chance.happens(0.3):
        hat(chance, shape, head + turn @ (radii * [0, 0.75, 0]), float(radii[0]), turn)


def _clothes(chance: Chance, shape: Shape, width: float, torso: float, leg: float, flat: float) -> None:
    if chance.happens(0.3):
        length, flare = leg * chance.between(0.3, 1.0), chance.between(1.1, 1.9)
        material = chance.pick((MAIN, SECOND))
        half = (length + 0.3 * torso) / 2
        shape.cylinder(
            (0, 0.3 * torso - half, 0),
            width * (0.85 + flare) / 2,
            half,
            material=material,
            rounding=0.03,
            taper=(0.85 - flare) / (0.85 + flare),
            flat=max(flat, 0.7),
        )
    if chance.happens(0.4):
        shape.cylinder(
            (0, 0.2 * torso, 0),
            width * 1.5,
            0.03 + 0.02 * chance.between(0, 1),
            material=chance.pick((ACCENT, DARK)),
            operation=PAINT,
        )
    if chance.happens(0.18):
        drop, spread = torso + leg * chance.between(0.2, 0.9), chance.between(1.0, 1.7)
        corners = [(-width * 0.8, 0.0), (width * 0.8, 0.0), (width * spread, -drop), (-width * spread, -drop)]
        shape.plate(
            (0, torso * 0.92, -width * flat - 0.04),
            corners,
            0.018,
            turned(0, chance.between(0.0, 0.25)),
            ACCENT,
            blend=0.02,
        )
    if chance.happens(0.15):
        pack = (width * chance.between(0.5, 0.95), torso * chance.between(0.25, 0.4), chance.between(0.04, 0.14))
        shape.box((0, torso * 0.55, -width * flat - pack[2]), pack, material=ACCENT, rounding=0.04, blend=0.01)
    if chance.happens(0.2):
        shape.torus((0, torso * 0.97, 0), width * 0.55, width * 0.22, material=ACCENT, blend=0.01)
    if chance.happens(0.25):
        shape.box(
            (0, torso * 0.5, width * flat),
            (chance.between(0.02, 0.5) * width, torso, width * 0.5),
            material=chance.pick((WHITE, SECOND)),
            operation=PAINT,
        )
    if chance.happens(0.2):
        for i in range(3):
            shape.ellipsoid((0, torso * (0.35 + 0.2 * i), width * flat), 0.022, material=DARK, operation=PAINT)


def robot(chance: Chance, shape: Shape) -> None:
    """Add a robot or a mech with hard edges."""
    shape.blend = chance.pick((0.0, 0.005, 0.02))
    hard = chance.between(0.004, 0.06)
    torso = chance.between(0.2, 0.42)
    half = np.array([torso * chance.between(0.4, 0.85), torso * 0.5, torso * chance.between(0.3, 0.7)])
    middle = np.array([0, torso * 0.5, 0])
    style = chance.pick(("box", "ball", "barrel", "wedge"), (4, 2, 2, 2))
    if style == "ball":
        shape.ellipsoid(middle, half * [1, 1.1, 1.1], material=MAIN)
    elif style == "barrel":
        shape.cylinder(middle, float(half[0]), float(half[1]), material=MAIN, rounding=hard, taper=chance.normal(0.2))
    else:
        shape.box(
            middle, half, material=MAIN, rounding=hard, taper=chance.between(0.1, 0.4) if style == "wedge" else 0.0
        )
    _plating(chance, shape, middle, half, hard)
    for sign in (-1.0, 1.0):
        shape.ellipsoid((sign * half[0] * 0.6, -0.02, 0), torso * 0.18, material=DARK)
    _robot_legs(chance, shape, half, torso, hard)
    hands = _robot_arms(chance, shape, half, torso, hard)
    _robot_head(chance, shape, np.array([0, torso, 0]), torso * chance.between(0.3, 0.8), hard)
    if chance.happens(0.2):
        held(chance, shape, chance.pick(hands), 0.4)
    if chance.happens(0.35):
        shape.box(
            (0, torso * 0.6, -half[2] - 0.05),
            (half[0] * chance.between(0.4, 0.9), torso * chance.between(0.2, 0.4), 0.08),
            material=SECOND,
            rounding=hard,
        )
        for sign in (-1, 1):
            shape.cylinder((sign * half[0] * 0.5, torso * 0.35, -half[2] - 0.12), 0.05, 0.1, material=METAL, taper=-0.2)


def _plating(chance: Chance, shape: Shape, middle: Vector, half: Vector, hard: float) -> None:
    if chance.happens(0.5):
        shape.box(
            middle + [0, 0.2 * half[1], half[2]],
            half * [0.6, 0.45, 0.15],
            material=chance.pick((SECOND, DARK, METAL)),
            rounding=hard,
        )
    if chance.happens(0.5):
        for sign in (-1, 1):
            kind = chance.pick((GLOW, ACCENT, DARK))
            shape.ellipsoid(
                middle + [sign * half[0] * 0.35, 0.25 * half[1], half[2]], 0.035, material=kind, operation=PAINT
            )
    if chance.happens(0.4):
        shape.box(middle - [0, 0.7 * half[1], 0], half * [1.5, 0.08, 1.5], material=ACCENT, operation=PAINT)
    for _ in range(chance.integer(0, 4)):
        start = len(shape.solids)
        place = middle + half * [chance.between(0.3, 1.0), chance.between(-0.9, 0.9), chance.between(-1, 1)]
        shape.box(
            place, half * chance.between(0.1, 0.35), material=chance.pick((SECOND, METAL, ACCENT, DARK)), rounding=hard
        )
        shape.mirror(start)


def _robot_legs(chance: Chance, shape: Shape, half: Vector, torso: float, hard: float) -> None:
    if chance.happens(0.12):
        for sign in (-1.0, 1.0):
            shape.box((sign * half[0], -0.15, 0), (0.08, 0.1, half[2] * 1.6), material=DARK, rounding=0.08)
        return
    leg, thick = torso * chance.between(0.7, 1.7), torso * chance.between(0.1, 0.25)
    reverse, stride = chance.happens(0.4), chance.between(0, 0.6) * chance.sign()
    boxy = chance.happens(0.6)
    for sign in (-1.0, 1.0):
        swing = stride * sign
        angles = (swing + 0.6, swing - 0.7) if not reverse else (swing - 0.5, swing + 0.6)
        point = np.array([sign * half[0] * chance.between(0.6, 0.75), 0.0, 0.0])
        for i, angle in enumerate(angles):
            turn = rotation(0, -angle)
            step = turn @ np.array([0, -leg * 0.5, 0])
            wide = thick * (1.2 - 0.3 * i)
            if boxy:
                shape.box(
                    point + step / 2,
                    (wide, leg * 0.25, wide * chance.between(0.8, 1.3)),
                    turn.T,
                    (MAIN, SECOND)[i],
                    hard,
                )
            else:
                shape.cone(point, point + step, wide, wide * 0.8, (MAIN, METAL)[i])
            point = point + step
            shape.cylinder(point, thick * 0.9, thick * 1.1, turned(0, 0, math.pi / 2), DARK)
        shape.box(
            point + [0, -0.03, 0.3 * thick],
            (thick * 1.5, 0.04, thick * chance.between(1.8, 2.8)),
            material=chance.pick((SECOND, METAL)),
            rounding=hard,
        )


def _robot_arms(chance: Chance, shape: Shape, half: Vector, torso: float, hard: float) -> list[Vector]:
    arm, thick = torso * chance.between(0.7, 1.5), torso * chance.between(0.08, 0.2)
    draws, hands = [(chance.between(-0.6, 1.2), chance.between(0, 1.5)) for _ in range(2)], []
    together, lean = chance.happens(0.6), chance.between(0.05, 0.7)
    heavy = chance.happens(0.4)
    for i, sign in enumerate((-1.0, 1.0)):
        swing, bend = draws[0] if together else draws[i]
        start = np.array([sign * (half[0] + thick), torso * 0.8, 0])
        shape.ellipsoid(start, thick * chance.between(1.2, 1.9), material=chance.pick((METAL, SECOND)))
        hand = limb(
            shape,
            start,
            [arm * 0.45, arm * 0.45],
            [thick, thick * 0.8, thick * 0.9],
            [swing, swing + bend],
            sign * lean,
            (METAL, MAIN),
        )
        if heavy:
            turn = rotation(0, -(swing + bend))
            shape.box(
                hand - turn @ np.array([0, -arm * 0.2, 0]), (thick * 1.4, arm * 0.25, thick * 1.4), turn.T, MAIN, hard
            )
        for finger in (-0.6, 0.6):
            tip = hand + np.array([math.sin(finger) * thick, -0.4 * thick, 1.4 * thick])
            shape.cone(hand, tip, thick * 0.6, thick * 0.3, DARK)
        shape.box(hand, np.full(3, thick), material=SECOND, rounding=hard)
        hands.append(hand)
    return hands


def _robot_head(chance: Chance, shape: Shape, base: Vector, size: float, hard: float) -> None:
    turn = rotation(chance.normal(0.4) if chance.happens(0.3) else 0.0)
    head = base + [0, size * chance.between(0.3, 0.7), chance.between(0, 0.4) * size]
    half = size * np.array([chance.between(0.5, 0.9), chance.between(0.35, 0.6), chance.between(0.4, 0.8)])
    if chance.happens(0.12):
        shape.ellipsoid(base, np.array([size, size * 0.5, size]), material=SECOND)
        return
    if chance.happens(0.6):
        shape.box(head, half, turn.T, chance.pick((MAIN, SECOND)), hard)
    else:
        shape.ellipsoid(head, half * 1.2, turn.T, chance.pick((MAIN, SECOND)))
    shape.cone(base, head, size * 0.25, size * 0.25, DARK)
    look = chance.pick(("eyes", "visor", "one"))
    front = head + turn @ np.array([0, 0.1 * size, half[2]])
    light = chance.pick((GLOW, ACCENT, WHITE))
    if look == "visor":
        shape.box(front, half * [0.85, 0.3, 0.3], turn.T, light, operation=PAINT)
    elif look == "one":
        shape.cylinder(front, size * 0.25, size * 0.12, turned(0, math.pi / 2) @ turn.T, light)
    else:
        for sign in (-1, 1):
            shape.ellipsoid(
                front + turn @ np.array([sign * half[0] * 0.5, 0, 0]),
                size * 0.15,
                turn.T,
                light,
                operation=chance.pick((0, PAINT)),
            )
    if chance.happens(0.5):
        start = len(shape.solids)
        root = head + [half[0] * 0.7, half[1], 0]
        shape.cone(
            root,
            root + np.array([chance.between(0, 0.4), chance.between(0.3, 1.0), chance.normal(0.2)]) * size,
            0.018,
            0.014,
            METAL,
        )
        shape.mirror(start)
