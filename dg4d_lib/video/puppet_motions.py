"""Motions that are formulas: where the nodes of a puppet go. All are loops, at rest at phase 0."""

import math

import numpy as np
from jaxtyping import Float64

from dg4d_lib.video.puppet import SubjectBounds

Nodes = Float64[np.ndarray, "n 2"]

SWAY_DEG = 9.0  # at the top
BEND_DEG = 18.0
BREATH = 0.0225  # of the height
CHEST = 0.0585  # of the width
CHEST_HEIGHT, CHEST_SPREAD = 0.6, 0.28  # of the height, above the feet
JUMP = 0.16  # of the height
LEAST_JUMP = 0.03  # of the height, even without room above
ROOM_USED = 0.8  # of the free margin above
CROUCH = 0.12  # of the height
STRETCH = 0.5625  # of the jump


def lean(nodes: Nodes, bounds: SubjectBounds, phase: float, degrees: float) -> Nodes:
    """Bend to the right and to the left like a beam held at the feet; its length is kept.

    Args:
        nodes: at rest, pixels.
        bounds: whose feet are held.
        phase: in turns.
        degrees: greatest angle at the top.
    """
    above = np.maximum(bounds.bottom - nodes[:, 1], 0)
    below = np.maximum(nodes[:, 1] - bounds.bottom, 0)
    angle = math.radians(degrees) * math.sin(2 * math.pi * phase) * above / bounds.height
    half = angle / 2
    spine_x = above * np.sin(half) * np.sinc(half / math.pi)
    spine_y = above * np.sinc(angle / math.pi)
    beside = nodes[:, 0] - bounds.foot
    return np.stack(
        [bounds.foot + spine_x + beside * np.cos(angle), bounds.bottom - spine_y + below + beside * np.sin(angle)], -1
    )


def breathe(nodes: Nodes, bounds: SubjectBounds, phase: float, strength: float) -> Nodes:
    """Rise and sink a little, the chest most."""
    breath = strength * math.sin(2 * math.pi * phase)
    level = (bounds.bottom - nodes[:, 1]) / bounds.height
    chest = np.exp(-(((level - CHEST_HEIGHT) / CHEST_SPREAD) ** 2))
    places = squash(nodes, bounds, BREATH * breath)
    places[:, 0] = bounds.middle + (places[:, 0] - bounds.middle) * (1 + CHEST * breath * chest)
    return places


def bounce(nodes: Nodes, bounds: SubjectBounds, phase: float, strength: float) -> Nodes:
    """Crouch, jump, land: one hop a loop."""
    jump = jump_height(bounds, strength)
    lift = 0.0
    if phase < 0.25:
        change = -CROUCH * strength * math.sin(4 * math.pi * phase)
    elif phase < 0.75:
        flight = 2 * phase - 0.5
        lift = 4 * flight * (1 - flight) * jump * bounds.height
        change = STRETCH * jump * math.cos(2 * math.pi * flight) * math.sqrt(math.sin(math.pi * flight))
    else:
        landing = 4 * phase - 3
        change = -CROUCH * strength * math.sin(math.pi * landing) * (1 - 0.35 * landing)
    return squash(nodes, bounds, change) - np.array([0, lift])


def jump_height(bounds: SubjectBounds, strength: float) -> float:
    """How high `bounce` goes, as a share of the subject's height; little where the picture has no room above."""
    return max(LEAST_JUMP, min(JUMP * strength, ROOM_USED * bounds.top / bounds.height))


def squash(nodes: Nodes, bounds: SubjectBounds, change: float) -> Nodes:
    """Taller by this share above the feet and slimmer to match."""
    foot = np.array([bounds.foot, bounds.bottom])
    return foot + (nodes - foot) * np.array([(1 + change) ** -0.9, 1 + change])
