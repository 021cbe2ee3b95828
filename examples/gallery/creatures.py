"""Elephant, robot, toucan and reef fish."""

from numpy import ndarray

from examples.gallery.figures import Color, Figure, Part, both_sides, box, disk, left_right, only, slab, tube
from examples.shapes import Field, ellipsoid

WHITE: Color = (0.96, 0.95, 0.92)
BLACK: Color = (0.09, 0.09, 0.12)


def eye(center: tuple[float, float, float], radius: float, look: tuple[float, float], iris: Color) -> Part:
    """Return an eye on the near side and its mirror image: white, iris, pupil, and a glint."""
    x, y, z = center
    dx, dy = look
    middle = (x + dx * radius, y + dy * radius, z + 0.75 * radius)
    glint = (middle[0] + 0.25 * radius, middle[1] + 0.32 * radius, middle[2] + 0.1 * radius)

    def spot(place: tuple[float, float, float], share: float) -> Field:
        return both_sides(ellipsoid(place, (share * radius,) * 3))

    marks = [(spot(middle, 0.72), iris), (spot(middle, 0.50), BLACK), (spot(glint, 0.24), WHITE)]
    return Part(both_sides(ellipsoid(center, (radius,) * 3)), WHITE, marks)


def elephant() -> Figure:
    """Return an elephant that lifts its trunk."""
    gray, pink, nail = (0.45, 0.56, 0.70), (0.93, 0.62, 0.66), (0.93, 0.88, 0.80)
    legs = [
        both_sides(tube((x, -0.10, 0.12, 0.125), (x + 0.01, -0.28, 0.135, 0.105), (x, -0.47, 0.135, 0.11)))
        for x in (0.14, -0.30)
    ]
    nails = [
        both_sides(ellipsoid((x + 0.095 + 0.012 * k, -0.52, 0.135 + 0.055 * (k - 1)), (0.034, 0.034, 0.028)))
        for x in (0.14, -0.30)
        for k in range(3)
    ]
    body = ellipsoid((-0.10, 0.0, 0), (0.41, 0.29, 0.27))
    head = ellipsoid((0.30, 0.20, 0), (0.215, 0.215, 0.20))
    trunk = tube(
        (0.40, 0.14, 0, 0.11),
        (0.52, 0.0, 0, 0.085),
        (0.63, -0.02, 0, 0.066),
        (0.70, 0.08, 0, 0.055),
        (0.70, 0.22, 0, 0.048),
        (0.64, 0.30, 0, 0.045),
    )
    ear = both_sides(ellipsoid((0.15, 0.20, 0.215), (0.165, 0.205, 0.035)))
    inner_ear = both_sides(ellipsoid((0.15, 0.19, 0.26), (0.115, 0.155, 0.045)))
    cheek = both_sides(ellipsoid((0.37, 0.12, 0.185), (0.045, 0.035, 0.05)))
    tail = tube((-0.48, 0.06, 0, 0.03), (-0.60, 0.0, 0, 0.022), (-0.64, -0.12, 0, 0.022))
    tuft = ellipsoid((-0.645, -0.16, 0), (0.035, 0.06, 0.035))
    tusk = both_sides(tube((0.42, 0.05, 0.11, 0.032), (0.50, -0.06, 0.13, 0.026), (0.57, -0.07, 0.13, 0.012)))
    blanket = ellipsoid((-0.13, 0.02, 0), (0.30, 0.290, 0.285))
    red, gold = (0.80, 0.20, 0.25), (0.98, 0.76, 0.25)
    cloth = [
        (only(slab(0, -0.31, 0.05), slab(1, 0.02, 0.5)), red),
        (only(slab(0, -0.31, 0.05), slab(1, 0.02, 0.06)), gold),
        (only(slab(0, -0.31, -0.28), slab(1, 0.02, 0.5)), gold),
        (only(slab(0, 0.02, 0.05), slab(1, 0.02, 0.5)), gold),
        (both_sides(ellipsoid((-0.13, 0.15, 0.25), (0.06, 0.06, 0.2))), gold),
    ]
    return Figure(
        [
            Part(body, gray, cloth),
            Part(blanket, gray, cloth),
            Part(head, gray, [(cheek, pink)]),
            Part(trunk, gray),
            *(Part(leg, gray) for leg in legs),
            *(Part(one, nail) for one in nails),
            Part(ear, gray, [(inner_ear, pink)]),
            Part(tail, gray),
            Part(tuft, (0.25, 0.28, 0.36)),
            Part(tusk, WHITE),
            eye((0.415, 0.265, 0.135), 0.045, (0.35, 0.0), (0.25, 0.16, 0.10)),
        ],
        softness=0.035,
        yaw_deg=-14,
    )


def robot() -> Figure:
    """Return a round robot that waves."""
    shell, teal, glow, joint = (0.93, 0.92, 0.88), (0.10, 0.56, 0.62), (0.45, 0.98, 0.95), (0.30, 0.33, 0.38)
    orange = (0.97, 0.55, 0.15)
    face = box((0, 0.32, 0.2), (0.20, 0.115, 0.06), 0.055)
    eyes = left_right(ellipsoid((0.085, 0.335, 0.26), (0.036, 0.048, 0.2)))
    smile = only(ellipsoid((0, 0.295, 0.26), (0.062, 0.040, 0.2)), lambda p: p[:, 1] - 0.285)
    head = box((0, 0.32, 0), (0.29, 0.19, 0.20), 0.12)
    torso = box((0, -0.08, 0), (0.215, 0.205, 0.165), 0.11)
    badge = ellipsoid((0, -0.06, 0.17), (0.07, 0.07, 0.1))
    heart = ellipsoid((0, -0.06, 0.17), (0.045, 0.045, 0.1))
    hips = only(slab(1, -0.30, -0.20), slab(0, -1, 1))
    left_arm = tube((-0.22, 0.03, 0, 0.055), (-0.36, -0.06, 0.02, 0.050), (-0.42, -0.20, 0.05, 0.050))
    right_arm = tube((0.22, 0.03, 0, 0.055), (0.40, 0.0, 0.02, 0.050), (0.50, 0.15, 0.04, 0.050))
    hands = [
        ellipsoid((-0.43, -0.26, 0.06), (0.078, 0.085, 0.075)),
        ellipsoid((0.53, 0.22, 0.05), (0.082, 0.088, 0.075)),
    ]
    fingers = [
        tube((0.50, 0.27, 0.06, 0.03), (0.485, 0.34, 0.06, 0.028)),
        tube((0.56, 0.28, 0.06, 0.03), (0.58, 0.34, 0.06, 0.028)),
        tube((-0.39, -0.31, 0.07, 0.03), (-0.375, -0.36, 0.08, 0.028)),
        tube((-0.46, -0.32, 0.07, 0.03), (-0.47, -0.37, 0.08, 0.028)),
    ]
    legs = left_right(tube((0.11, -0.26, 0, 0.068), (0.125, -0.40, 0, 0.062), (0.13, -0.50, 0.0, 0.066)))
    feet = left_right(box((0.145, -0.56, 0.045), (0.105, 0.058, 0.14), 0.05))
    ears = left_right(disk((0.30, 0.32, 0), 0.085, 0.045, 0))
    antenna = tube((0, 0.49, 0, 0.02), (0.0, 0.56, 0, 0.018), (0.0, 0.60, 0, 0.018))
    return Figure(
        [
            Part(head, shell),
            Part(face, (0.08, 0.13, 0.20), [(eyes, glow), (smile, glow)]),
            Part(torso, shell, [(hips, teal), (badge, teal), (heart, orange)]),
            Part(left_arm, joint),
            Part(right_arm, joint),
            *(Part(hand, teal) for hand in hands),
            *(Part(finger, teal) for finger in fingers),
            Part(legs, joint),
            Part(feet, orange),
            Part(ears, orange),
            Part(antenna, joint),
            Part(ellipsoid((0, 0.64, 0), (0.05,) * 3), orange),
        ],
        softness=0.012,
        yaw_deg=12,
    )


def toucan() -> Figure:
    """Return a toucan on its feet."""
    night, cream, sun = (0.10, 0.11, 0.17), (0.98, 0.93, 0.72), (1.0, 0.70, 0.12)
    body = tube((0.16, 0.26, 0, 0.155), (0.06, 0.06, 0, 0.195), (-0.08, -0.16, 0, 0.185), (-0.26, -0.34, 0, 0.075))
    bib = both_sides(ellipsoid((0.24, 0.13, 0.05), (0.125, 0.17, 0.17)))
    tail = tube((-0.24, -0.32, 0, 0.07), (-0.38, -0.47, 0, 0.065), (-0.47, -0.60, 0, 0.045))
    beak = tube((0.24, 0.31, 0, 0.105), (0.40, 0.34, 0, 0.100), (0.56, 0.29, 0, 0.078), (0.66, 0.17, 0, 0.028))
    beak_marks = [
        (only(slab(0, 0.27, 0.325)), BLACK),
        (ellipsoid((0.46, 0.46, 0), (0.22, 0.10, 0.3)), (0.93, 0.30, 0.16)),
        (ellipsoid((0.68, 0.17, 0), (0.10, 0.11, 0.2)), BLACK),
        (lambda p: abs(p[:, 1] - 0.335 + 0.55 * (p[:, 0] - 0.36) ** 2 * 2.2) - 0.006, (0.45, 0.20, 0.08)),
    ]
    wing = both_sides(ellipsoid((-0.08, -0.08, 0.165), (0.10, 0.25, 0.045)))
    feather = both_sides(ellipsoid((-0.11, -0.21, 0.20), (0.055, 0.115, 0.04)))
    ring_of_eye = both_sides(ellipsoid((0.215, 0.345, 0.125), (0.078, 0.078, 0.05)))
    legs = both_sides(tube((-0.04, -0.32, 0.09, 0.034), (-0.01, -0.42, 0.10, 0.030), (0.0, -0.52, 0.10, 0.030)))
    toes = both_sides(tube((-0.06, -0.555, 0.10, 0.024), (0.02, -0.545, 0.10, 0.032), (0.13, -0.555, 0.12, 0.022)))
    under_tail = ellipsoid((-0.23, -0.38, 0), (0.10, 0.07, 0.2))
    return Figure(
        [
            Part(body, night, [(bib, cream), (under_tail, (0.85, 0.15, 0.18))]),
            Part(tail, night),
            Part(beak, sun, beak_marks),
            Part(wing, (0.16, 0.19, 0.30), [(feather, (0.26, 0.36, 0.58))]),
            Part(ring_of_eye, (0.20, 0.62, 0.86)),
            eye((0.225, 0.35, 0.140), 0.046, (0.25, 0.05), (0.35, 0.20, 0.10)),
            Part(legs, (0.35, 0.50, 0.66)),
            Part(toes, (0.35, 0.50, 0.66)),
        ],
        softness=0.02,
        yaw_deg=-14,
    )


def fish() -> Figure:
    """Return a reef fish with bands."""
    orange, fin = (0.98, 0.46, 0.10), (0.99, 0.62, 0.16)
    body = tube(
        (0.52, 0.0, 0, 0.06),
        (0.38, 0.02, 0, 0.17),
        (0.12, 0.03, 0, 0.25),
        (-0.16, 0.02, 0, 0.19),
        (-0.40, 0.0, 0, 0.085),
    )

    def flat(p: ndarray) -> ndarray:
        return body(p * (1, 1, 1.55)) / 1.2

    def band(x: float, half: float, bow: float) -> Field:
        return lambda p: abs(p[:, 0] - x - bow * p[:, 1] ** 2) - half

    bands = [
        (band(0.27, 0.070, -1.2), BLACK),
        (band(0.27, 0.052, -1.2), WHITE),
        (band(-0.05, 0.085, 0.8), BLACK),
        (band(-0.05, 0.067, 0.8), WHITE),
        (band(-0.37, 0.045, 0.0), BLACK),
        (band(-0.37, 0.030, 0.0), WHITE),
    ]
    tail = [tube((-0.40, 0.0, 0, 0.05), (-0.52, s * 0.10, 0, 0.055), (-0.63, s * 0.19, 0, 0.03)) for s in (1, -1)]
    web = ellipsoid((-0.53, 0, 0), (0.10, 0.13, 0.028))
    top = tube(
        (0.24, 0.22, 0, 0.04),
        (0.10, 0.33, 0, 0.055),
        (-0.06, 0.31, 0, 0.05),
        (-0.22, 0.26, 0, 0.055),
        (-0.32, 0.17, 0, 0.025),
    )
    low = tube((-0.04, -0.22, 0, 0.04), (-0.14, -0.29, 0, 0.052), (-0.26, -0.21, 0, 0.025))
    pelvic = both_sides(tube((0.16, -0.20, 0.04, 0.045), (0.10, -0.31, 0.06, 0.05), (0.03, -0.36, 0.07, 0.02)))
    side = both_sides(ellipsoid((0.08, -0.05, 0.185), (0.105, 0.075, 0.024)))

    def dark_edge(center: tuple[float, float, float], radii: tuple[float, float, float]) -> Field:
        inside = ellipsoid(center, radii)
        return lambda p: -inside(p)

    tail_edge = dark_edge((-0.40, 0, 0), (0.215, 0.26, 1))
    mouth = both_sides(tube((0.53, -0.045, 0.0, 0.010), (0.49, -0.065, 0.08, 0.010), (0.45, -0.06, 0.12, 0.008)))
    return Figure(
        [
            Part(flat, orange, [*bands, (mouth, (0.45, 0.12, 0.05))]),
            *(Part(one, fin, [(tail_edge, BLACK)]) for one in tail),
            Part(web, fin, [(tail_edge, BLACK)]),
            Part(top, fin, [(lambda p: 0.335 - p[:, 1], BLACK)]),
            Part(low, fin, [(lambda p: p[:, 1] + 0.31, BLACK)]),
            Part(pelvic, fin, [(lambda p: p[:, 1] + 0.35, BLACK)]),
            Part(side, fin, [(lambda p: p[:, 0] - 0.0, BLACK)]),
            eye((0.42, 0.065, 0.082), 0.052, (0.30, 0.05), (0.95, 0.60, 0.10)),
        ],
        softness=0.02,
        yaw_deg=-12,
    )
