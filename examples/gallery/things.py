"""Cactus, car, armchair, stacking rings and rubber duck."""

import math

from numpy import ndarray

from examples.gallery.creatures import BLACK, WHITE, eye
from examples.gallery.figures import Figure, Part, both_sides, box, disk, left_right, only, ring, slab, tube
from examples.shapes import Field, ellipsoid, union

WOOD = (0.55, 0.33, 0.16)


def cactus() -> Figure:
    """Return a cactus with two arms and three flowers in a pot."""
    green, clay, pink = (0.28, 0.58, 0.33), (0.80, 0.42, 0.26), (0.96, 0.42, 0.62)
    pot = disk((0, -0.46, 0), 0.20, 0.16, 1, 0.05)
    rim = disk((0, -0.30, 0), 0.255, 0.055, 1, 0.03)
    soil = disk((0, -0.255, 0), 0.21, 0.02, 1, 0.01)
    trunk = tube((0, -0.28, 0, 0.15), (0, 0.0, 0, 0.165), (0, 0.28, 0, 0.155), (0, 0.42, 0, 0.11))
    arms = [
        tube(
            (0.12, -0.06, 0, 0.07), (0.30, -0.05, 0.01, 0.078), (0.375, 0.06, 0.02, 0.078), (0.375, 0.21, 0.02, 0.068)
        ),
        tube(
            (-0.12, 0.06, 0, 0.065),
            (-0.27, 0.07, 0.02, 0.072),
            (-0.345, 0.18, 0.03, 0.072),
            (-0.345, 0.34, 0.03, 0.060),
        ),
    ]

    def ribs(p: ndarray) -> ndarray:
        return 0.5 - abs(((p[:, 0] * 26 + 0.5) % 1) - 0.5) * 1.35 - 0.02

    def flower(x: float, y: float, z: float, size: float) -> list[Part]:
        petals: list[Field] = [
            ellipsoid(
                (x + size * math.cos(a), y + 0.25 * size + size * 0.55 * math.sin(a), z + 0.4 * size),
                (0.62 * size, 0.50 * size, 0.4 * size),
            )
            for a in (k * 2 * math.pi / 6 for k in range(6))
        ]
        return [
            *(Part(one, pink) for one in petals),
            Part(ellipsoid((x, y + 0.25 * size, z + 0.72 * size), (0.52 * size,) * 3), (0.99, 0.82, 0.25)),
        ]

    stripes = [(slab(1, -0.50, -0.45), (0.95, 0.78, 0.55)), (slab(1, -0.42, -0.405), (0.95, 0.78, 0.55))]
    face = [
        (left_right(ellipsoid((0.065, 0.155, 0.16), (0.020, 0.028, 0.06))), BLACK),
        (only(ellipsoid((0, 0.105, 0.16), (0.036, 0.030, 0.06)), lambda p: p[:, 1] - 0.10), BLACK),
        (left_right(ellipsoid((0.112, 0.105, 0.13), (0.026, 0.018, 0.08))), (0.95, 0.55, 0.50)),
    ]
    dark = (0.20, 0.47, 0.27)
    return Figure(
        [
            Part(pot, clay, stripes),
            Part(rim, (0.86, 0.48, 0.30)),
            Part(soil, (0.30, 0.20, 0.14)),
            Part(
                trunk, green, [(ribs, dark), (both_sides(ellipsoid((0, 0.13, 0.16), (0.135, 0.10, 0.1))), green), *face]
            ),
            *(Part(arm, green, [(ribs, dark)]) for arm in arms),
            *flower(0, 0.535, 0, 0.088),
            *flower(0.375, 0.275, 0.02, 0.055),
            *flower(-0.345, 0.40, 0.03, 0.052),
        ],
        softness=0.012,
    )


def car() -> Figure:
    """Return a small round car with luggage on its roof."""
    red, glass, rubber, chrome = (0.83, 0.17, 0.16), (0.42, 0.66, 0.78), (0.13, 0.13, 0.15), (0.86, 0.88, 0.90)
    hull = box((0, -0.10, 0), (0.60, 0.135, 0.27), 0.12)
    hood = ellipsoid((0.36, -0.03, 0), (0.24, 0.13, 0.24))
    cabin = box((-0.07, 0.10, 0), (0.345, 0.185, 0.235), 0.15)
    windows = [
        (both_sides(box((0.085, 0.14, 0.25), (0.125, 0.085, 0.2), 0.04)), glass),
        (both_sides(box((-0.195, 0.14, 0.25), (0.115, 0.085, 0.2), 0.04)), glass),
        (only(box((0.4, 0.135, 0), (0.20, 0.085, 0.19), 0.04)), glass),
    ]
    line = [
        (slab(1, -0.135, -0.105), (0.98, 0.93, 0.82)),
        (both_sides(box((-0.05, -0.05, 0.27), (0.045, 0.011, 0.1), 0.008)), chrome),
    ]
    wheels = [both_sides(disk((x, -0.235, 0.235), 0.135, 0.06, 2, 0.03)) for x in (0.36, -0.36)]

    def hub(x: float) -> list[tuple[Field, tuple[float, float, float]]]:
        return [
            (both_sides(disk((x, -0.235, 0.30), 0.085, 0.05, 2)), chrome),
            (both_sides(disk((x, -0.235, 0.30), 0.055, 0.06, 2)), red),
            (both_sides(disk((x, -0.235, 0.30), 0.022, 0.07, 2)), chrome),
        ]

    arches = [both_sides(disk((x, -0.215, 0.225), 0.175, 0.058, 2, 0.03)) for x in (0.36, -0.36)]
    lamp = both_sides(ellipsoid((0.57, -0.05, 0.17), (0.045, 0.058, 0.058)))
    tail_lamp = both_sides(ellipsoid((-0.585, -0.06, 0.18), (0.03, 0.04, 0.045)))
    bumpers = [box((s * 0.605, -0.20, 0), (0.028, 0.032, 0.25), 0.025) for s in (1, -1)]
    case = box((-0.10, 0.345, 0.0), (0.17, 0.065, 0.13), 0.03)
    straps = [(slab(0, -0.19, -0.165), (0.35, 0.20, 0.10)), (slab(0, -0.04, -0.015), (0.35, 0.20, 0.10))]
    parcel = box((0.11, 0.32, 0.02), (0.06, 0.05, 0.10), 0.02)
    return Figure(
        [
            Part(hull, red, line),
            Part(hood, red, line),
            Part(cabin, red, windows),
            *(Part(arch, (0.70, 0.12, 0.12)) for arch in arches),
            *(Part(wheel, rubber, hub(x)) for wheel, x in zip(wheels, (0.36, -0.36), strict=True)),
            Part(lamp, (1.0, 0.93, 0.65)),
            Part(tail_lamp, (0.95, 0.35, 0.15)),
            *(Part(one, chrome) for one in bumpers),
            Part(case, (0.72, 0.45, 0.20), straps),
            Part(parcel, (0.25, 0.50, 0.45), [(slab(0, 0.10, 0.12), WHITE)]),
        ],
        softness=0.02,
        yaw_deg=-22,
        pitch_deg=6,
    )


def armchair() -> Figure:
    """Return an armchair with a cushion."""
    cloth, shade, gold = (0.16, 0.46, 0.50), (0.12, 0.37, 0.42), (0.96, 0.72, 0.20)
    seat = box((0, -0.19, 0.06), (0.30, 0.10, 0.30), 0.07)
    back = box((0, 0.14, -0.19), (0.37, 0.40, 0.125), 0.11)
    arms = left_right(box((0.385, -0.13, 0.05), (0.105, 0.20, 0.30), 0.09))
    base = box((0, -0.33, 0.03), (0.42, 0.075, 0.28), 0.04)
    legs = left_right(
        both_sides(tube((0.33, -0.38, 0.22, 0.045), (0.36, -0.47, 0.24, 0.036), (0.375, -0.56, 0.25, 0.026)))
    )
    cushion = box((0.03, 0.035, 0.04), (0.185, 0.165, 0.075), 0.07, lean=0.16)
    buttons: list[Field] = [
        ellipsoid((x, y, -0.065), (0.018, 0.018, 0.03))
        for x, y in ((-0.21, 0.36), (0, 0.36), (0.21, 0.36), (-0.105, 0.26), (0.105, 0.26), (-0.21, 0.16), (0.21, 0.16))
    ]
    stripes = [
        (only(lambda p: abs(((p[:, 0] * 0.987 + p[:, 1] * 0.16) * 9 % 1) - 0.5) - 0.16), WHITE),
    ]
    return Figure(
        [
            Part(seat, cloth),
            Part(back, cloth, [(union(buttons, 0.001), gold)]),
            Part(arms, cloth),
            Part(base, shade),
            Part(legs, WOOD),
            Part(cushion, gold, stripes),
        ],
        softness=0.02,
        yaw_deg=-24,
        pitch_deg=10,
    )


def rings() -> Figure:
    """Return stacking rings with a smiling ball on top."""
    colors = ((0.86, 0.20, 0.22), (0.96, 0.55, 0.14), (0.98, 0.83, 0.22), (0.33, 0.68, 0.34), (0.20, 0.50, 0.80))
    parts = [Part(disk((0, -0.54, 0), 0.40, 0.055, 1, 0.045), (0.86, 0.70, 0.48))]
    y, radius = -0.485, 0.36
    for color in colors:
        thickness = 0.085 - 0.25 * (0.36 - radius) * 0.2
        y += thickness
        parts.append(
            Part(ring((0, y, 0), radius - thickness, thickness, 1), color, [(slab(1, y - 0.010, y + 0.010), WHITE)])
        )
        parts.append(Part(disk((0, y, 0), radius - thickness, thickness * 0.8, 1), color))
        y += thickness * 0.98
        radius -= 0.043
    top = y + 0.105
    face = [
        (left_right(ellipsoid((0.052, top + 0.025, 0.125), (0.019, 0.027, 0.05))), BLACK),
        (
            only(ellipsoid((0, top - 0.020, 0.13), (0.045, 0.042, 0.06)), lambda p: p[:, 1] - top + 0.022),
            (0.75, 0.15, 0.20),
        ),
        (left_right(ellipsoid((0.092, top - 0.015, 0.10), (0.024, 0.018, 0.07))), (0.98, 0.62, 0.55)),
    ]
    parts.append(Part(ellipsoid((0, top, 0), (0.145,) * 3), (0.99, 0.90, 0.72), face))
    parts.append(Part(ellipsoid((0, top + 0.15, 0), (0.035,) * 3), (0.86, 0.20, 0.22)))
    return Figure(parts, softness=0.008, yaw_deg=10, pitch_deg=8)


def duck() -> Figure:
    """Return a rubber duck."""
    yellow, beak = (0.99, 0.82, 0.14), (0.95, 0.42, 0.10)
    body = ellipsoid((-0.06, -0.20, 0), (0.44, 0.27, 0.31))
    chest = ellipsoid((0.20, -0.15, 0), (0.23, 0.25, 0.25))
    tail = tube((-0.36, -0.10, 0, 0.13), (-0.48, 0.02, 0, 0.075), (-0.53, 0.13, 0, 0.03))
    head = ellipsoid((0.22, 0.25, 0), (0.225, 0.215, 0.21))
    wing = both_sides(tube((0.02, -0.14, 0.28, 0.085), (-0.16, -0.15, 0.29, 0.075), (-0.30, -0.06, 0.25, 0.03)))
    upper = ellipsoid((0.47, 0.225, 0), (0.105, 0.035, 0.115))
    lower = ellipsoid((0.45, 0.175, 0), (0.075, 0.026, 0.085))
    tuft = tube((0.17, 0.43, 0, 0.045), (0.11, 0.50, 0, 0.028), (0.05, 0.51, 0, 0.014))
    return Figure(
        [
            Part(body, yellow),
            Part(chest, yellow),
            Part(tail, yellow),
            Part(head, yellow),
            Part(wing, (0.97, 0.72, 0.08)),
            Part(upper, beak),
            Part(lower, (0.82, 0.28, 0.08)),
            Part(tuft, (0.97, 0.72, 0.08)),
            eye((0.34, 0.31, 0.135), 0.058, (0.35, 0.0), (0.15, 0.35, 0.60)),
        ],
        softness=0.05,
        yaw_deg=-24,
        pitch_deg=7,
    )
