"""Closed-form looping motions of a puppet's nodes; phase 0 is the rest pose."""

import math

import numpy as np
from jaxtyping import Float64

from dg4d_lib.video.puppet import SubjectBounds

Nodes = Float64[np.ndarray, "n 2"]

# Lengths are relative to the height of the subject unless noted.
SWAY_DEG = 9.0  # maximum angle at the top, degrees
BEND_DEG = 18.0  # maximum angle at the top, degrees
BREATH = 0.0225  # vertical amplitude
CHEST = 0.0585  # horizontal amplitude, relative to the width
CHEST_HEIGHT, CHEST_SPREAD = 0.6, 0.28  # center above the feet and standard deviation
JUMP = 0.16  # height of the jump
MIN_JUMP = 0.03  # height of the jump without room above
ROOM_USED = 0.8  # share of the free margin above that a jump uses
CROUCH = 0.12  # compression before and after the jump
STRETCH = 0.5625  # elongation in flight, relative to the jump


def lean(nodes: Nodes, bounds: SubjectBounds, phase: float, degrees: float) -> Nodes:
    """Bend to the right and to the left like a beam clamped at the feet, with constant length.

    Args:
        nodes: rest positions, pixels.
        bounds: of the subject; the feet stay in place.
        phase: position in the loop, in [0, 1).
        degrees: maximum angle at the top.
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
    """Rise, sink and widen slightly, most at the chest."""
    breath = strength * math.sin(2 * math.pi * phase)
    level = (bounds.bottom - nodes[:, 1]) / bounds.height
    chest = np.exp(-(((level - CHEST_HEIGHT) / CHEST_SPREAD) ** 2))
    positions = squash(nodes, bounds, BREATH * breath)
    positions[:, 0] = bounds.middle + (positions[:, 0] - bounds.middle) * (1 + CHEST * breath * chest)
    return positions


def bounce(nodes: Nodes, bounds: SubjectBounds, phase: float, strength: float) -> Nodes:
    """Crouch, jump and land once per loop."""
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
    """Return the height of the jump in subject heights, limited by the free margin above the subject."""
    return max(MIN_JUMP, min(JUMP * strength, ROOM_USED * bounds.top / bounds.height))


def squash(nodes: Nodes, bounds: SubjectBounds, change: float) -> Nodes:
    """Stretch vertically by this share, measured from the feet, and shrink horizontally to match."""
    foot = np.array([bounds.foot, bounds.bottom])
    return foot + (nodes - foot) * np.array([(1 + change) ** -0.9, 1 + change])
