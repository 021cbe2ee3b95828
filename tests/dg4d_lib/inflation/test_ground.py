"""Closed forms of the turn from the ground line."""

import math

import pytest
import torch

from dg4d_lib.cameras.orbit import FOV_Y_DEG
from dg4d_lib.inflation.ground import LARGEST_DEG, ground_turn

SIZE = 256
GROUND = -0.5  # world units: height of the ground below the camera
ROWS, COLUMNS = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")


def walker(turn_deg: float, reach: float = 0.45, frames: int = 8) -> torch.Tensor:
    """Return the silhouettes of a table: two thin legs on a turned line, each seen in every other frame, and a top."""
    footage = torch.zeros(frames, SIZE, SIZE, 1)
    focal = SIZE / 2 / math.tan(math.radians(FOV_Y_DEG) / 2)
    for i, side in enumerate((-reach, reach)):
        x, depth = side * math.cos(math.radians(turn_deg)), 2 - side * math.sin(math.radians(turn_deg))
        column, bottom = SIZE / 2 + focal * x / depth, SIZE / 2 - focal * GROUND / depth
        leg = ((COLUMNS - column).abs() < 2) & (ROWS > SIZE / 2 - 20) & (bottom > ROWS)
        footage[i::2, ..., 0] += leg
    top = ((COLUMNS - SIZE / 2).abs() < 75) & ((ROWS - SIZE / 2 + 30).abs() < 12)
    return (footage + top[..., None]).clamp(max=1)


@pytest.mark.parametrize("turn_deg", [-35, -20, 0, 12, 30])
def test_the_turn_of_two_feet_is_found(turn_deg):
    assert ground_turn(walker(turn_deg), 0.5) == pytest.approx(0.5 * turn_deg, abs=1.5)  # feet end between pixels


def test_a_mirrored_walker_is_turned_the_other_way():
    footage = walker(25)
    assert ground_turn(footage.flip(2), 1.0) == pytest.approx(-ground_turn(footage, 1.0))


def test_a_large_turn_is_clipped():
    assert ground_turn(walker(45), 1.0) == LARGEST_DEG


def test_a_level_line_is_a_turn_of_zero():
    assert ground_turn(walker(0), 1.0) == 0


def test_a_line_without_trust_says_nothing():
    assert ground_turn(walker(0), 0.0) is None


def test_a_solid_base_says_nothing():
    slope = (ROWS - 150 < 0.2 * (COLUMNS - 80)) & (ROWS > 60) & ((COLUMNS - SIZE / 2).abs() < 60)
    assert ground_turn(slope[None, ..., None].float().expand(8, -1, -1, -1), 1.0) is None


@pytest.mark.parametrize(
    "footage",
    [
        walker(25, frames=6),
        walker(25, reach=0.1),
        walker(25).roll(-80, 1),
        torch.zeros(8, SIZE, SIZE, 1),
        ((ROWS - 200).abs() < 20)[None, ..., None].float() * (COLUMNS == 9.5)[..., None] * torch.ones(8, 1, 1, 1),
    ],
    ids=["few frames", "feet close together", "feet at the horizon", "nothing", "one column"],
)
def test_unclear_footage_says_nothing(footage):
    assert ground_turn(footage, 1.0) is None
