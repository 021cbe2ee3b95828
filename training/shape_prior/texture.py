"""Materials with patterns, palettes and light."""

import colorsys
import math

import numpy as np
from jaxtyping import Float64

from training.shape_prior.chance import Chance

PLAIN, STRIPES, SPOTS, CLOUDS, VERTICAL, BELLY, CHECKER, GRAIN = range(8)
# places in the row of a light, after its direction
AMBIENT, HEMISPHERE, DIFFUSE, SPECULAR, RIM, TOON, OCCLUSION = range(3, 10)
MATERIAL_COLUMNS = 15  # pattern, two colors, scale, phase, sharpness, mirrored, axis, threshold
# parts of a palette
MAIN, SECOND, ACCENT, SKIN, HAIR, DARK, WHITE, IRIS, WOOD, METAL, LEAF, GLOW = range(12)
_PATTERNS = (PLAIN, STRIPES, SPOTS, CLOUDS, VERTICAL, BELLY, CHECKER, GRAIN)
_WEIGHTS = {
    "animal": (0.3, 0.13, 0.14, 0.14, 0.07, 0.17, 0.0, 0.05),
    "cloth": (0.66, 0.1, 0.04, 0.03, 0.06, 0.0, 0.06, 0.05),
    "thing": (0.58, 0.08, 0.03, 0.06, 0.08, 0.0, 0.07, 0.1),
}


def palette(chance: Chance, style: str) -> Float64[np.ndarray, "12 15"]:
    """Return the materials of one shape: named colors that go together, with patterns.

    Args:
        chance: source of the draws.
        style: "animal", "cloth" or "thing": which patterns are likely.
    """
    hue, spread = chance.between(0, 1), chance.pick((0.03, 0.12, 0.35), (0.4, 0.3, 0.3))
    lively = chance.pick((0.0, 0.35, 0.6, 0.85), (0.1, 0.35, 0.35, 0.2))
    natural = style == "animal" and chance.happens(0.55)
    rows = np.zeros((12, MATERIAL_COLUMNS))
    for place in (MAIN, SECOND, ACCENT):
        first = _fur(chance) if natural else _color(chance, hue + chance.normal(spread), lively)
        second = _fur(chance) if natural else _color(chance, hue + chance.normal(spread * 1.5), lively)
        pattern = chance.pick(_PATTERNS, _WEIGHTS[style]) if place != ACCENT or chance.happens(0.3) else PLAIN
        if pattern == GRAIN:
            second = np.clip(first * chance.between(0.75, 1.3), 0, 1)
        rows[place] = _material(chance, pattern, first, second)
    skin = np.array(colorsys.hsv_to_rgb(chance.between(0.03, 0.1), chance.between(0.2, 0.6), chance.between(0.35, 1.0)))
    if style != "cloth" or chance.happens(0.15):
        skin = rows[chance.pick((MAIN, SECOND, ACCENT)), 1:4]
    wood = np.array(colorsys.hsv_to_rgb(chance.between(0.04, 0.12), chance.between(0.3, 0.8), chance.between(0.2, 0.8)))
    leaf = np.array(
        colorsys.hsv_to_rgb(chance.between(0.18, 0.42), chance.between(0.3, 0.9), chance.between(0.25, 0.85))
    )
    dark, white = np.full(3, chance.between(0.0, 0.15)), np.full(3, chance.between(0.85, 1.0))
    plain = {
        SKIN: skin,
        HAIR: _fur(chance) if chance.happens(0.7) else _color(chance, chance.between(0, 1), 0.8),
        DARK: dark,
        WHITE: white,
        IRIS: _color(chance, chance.between(0, 1), 0.8) if chance.happens(0.5) else dark,
        METAL: np.full(3, chance.between(0.25, 0.85)) * [1, chance.between(0.9, 1.0), chance.between(0.7, 1.1)],
        GLOW: np.array(colorsys.hsv_to_rgb(chance.between(0, 1), chance.between(0.4, 1), 1.0)),
    }
    for place, color in plain.items():
        rows[place] = _material(chance, PLAIN, color, color)
    rows[WOOD] = _material(chance, chance.pick((PLAIN, STRIPES, GRAIN)), wood, wood * chance.between(0.5, 0.85))
    rows[LEAF] = _material(chance, chance.pick((PLAIN, GRAIN, CLOUDS)), leaf, np.clip(leaf * 1.35, 0, 1))
    rows[:, 1:7] = np.clip(rows[:, 1:7], 0, 1)
    return rows


def lighting(chance: Chance) -> Float64[np.ndarray, " 10"]:
    """Return a light: direction towards it and how much there is of each kind, or none at all (pure albedo)."""
    row = np.zeros(10)
    direction = np.array([chance.normal(0.6), chance.between(0.3, 1.2), chance.normal(0.5, 0.6)])
    row[:3] = direction / np.linalg.norm(direction)
    row[AMBIENT] = 1.0
    if chance.happens(0.2):
        return row
    row[AMBIENT] = chance.between(0.3, 0.8)
    row[HEMISPHERE] = chance.between(0, 0.4)
    row[DIFFUSE] = max(0.0, chance.between(0.9, 1.25) - row[AMBIENT] - 0.6 * row[HEMISPHERE])
    if chance.happens(0.3):
        row[SPECULAR] = chance.between(0.05, 0.6)
    if chance.happens(0.15):
        row[RIM] = chance.between(0.05, 0.4)
    if chance.happens(0.15):
        row[TOON] = chance.integer(1, 3)
    if chance.happens(0.5):
        row[OCCLUSION] = chance.between(0.1, 0.6)
    return row


def _color(chance: Chance, hue: float, lively: float) -> Float64[np.ndarray, "3"]:
    saturation = float(np.clip(lively + chance.normal(0.15), 0, 1))
    return np.array(colorsys.hsv_to_rgb(hue % 1, saturation, chance.between(0.1, 1.0) ** 0.7))


def _fur(chance: Chance) -> Float64[np.ndarray, "3"]:
    """Return a color of real animals: white, gray, black, or brown to orange."""
    if chance.happens(0.4):
        return np.full(3, chance.pick((0.05, 0.2, 0.5, 0.75, 0.95)) + chance.normal(0.03)).clip(0, 1)
    return np.array(colorsys.hsv_to_rgb(chance.between(0.03, 0.13), chance.between(0.2, 0.85), chance.between(0.15, 1)))


def _material(
    chance: Chance, pattern: int, first: Float64[np.ndarray, "3"], second: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, " 15"]:
    row = np.zeros(MATERIAL_COLUMNS)
    row[0], row[1:4], row[4:7] = pattern, first, second
    row[7] = math.exp(chance.between(math.log(2.5), math.log(14.0)))
    row[8] = chance.between(0, 6)
    row[9] = chance.pick((0.5, 1.5, 6.0))
    row[10] = float(chance.happens(0.6))
    axis = chance.pick(
        (np.array([0.0, 0, 1]), np.array([0.0, 1, 0]), np.array([1.0, 0, 0]), None), (0.4, 0.3, 0.1, 0.2)
    )
    row[11:14] = axis if axis is not None else chance.generator.normal(0, 0.6, 3)
    row[14] = chance.between(0.0, 0.5) if pattern == STRIPES else chance.between(0.25, 0.6)
    if pattern == BELLY:
        row[14] = chance.between(-0.2, 0.5)
    if pattern == VERTICAL:
        row[8], row[9] = chance.normal(4), chance.pick((0.8, 3.0, 20.0))
    return row
