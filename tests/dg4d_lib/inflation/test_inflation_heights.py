import numpy as np
import pytest

from dg4d_lib.inflation.heights import (
    GREATEST,
    SWELL,
    heights,
    inscribed_balls,
    local_radius,
    membrane,
    outline_distance,
)

SIZE = 61
Y, X = np.mgrid[:SIZE, :SIZE] - SIZE // 2
DISC = X**2 + Y**2 < 20**2
BAR = np.abs(X) < 10


def test_the_balls_of_a_disc_are_one_ball():
    squares = inscribed_balls(DISC)
    radius = outline_distance(DISC).max()
    ball = np.maximum(radius**2 - X**2 - Y**2, 0) * DISC
    assert np.abs(np.sqrt(squares) - np.sqrt(ball)).max() < 0.35 * radius  # pixel steps at the rim
    inner = X**2 + Y**2 < 15**2
    assert np.abs(np.sqrt(squares) - np.sqrt(ball))[inner].max() < 1


def test_balls_match_their_definition():
    rng = np.random.default_rng(0)
    mask = rng.random((15, 15)) < 0.7
    distance = outline_distance(mask)
    rows, columns = np.nonzero(mask)
    y, x = np.mgrid[:15, :15]
    gap = (y[..., None] - rows) ** 2 + (x[..., None] - columns) ** 2
    expected = np.maximum((distance[rows, columns] ** 2 - gap).max(-1), 0) * mask
    np.testing.assert_allclose(inscribed_balls(mask), expected, atol=1e-9)


def test_the_membrane_over_a_bar_is_a_circle_across():
    squares = membrane(BAR)
    expected = np.where(BAR, 10.0**2 - X**2, 0)  # -u'' = 2, u(+-10) = 0; the border holds nothing
    np.testing.assert_allclose(squares, expected, atol=1e-4)


def test_the_local_radius_is_that_of_the_largest_disc_around():
    radius = local_radius(BAR, outline_distance(BAR))
    np.testing.assert_allclose(radius[BAR], 10)
    assert (radius[~BAR] == 0).all()


def test_small_parts_have_their_own_radius():
    two = DISC | ((X - 25) ** 2 + Y**2 < 3**2)
    radius = local_radius(two, outline_distance(two))
    assert radius[SIZE // 2, SIZE // 2] > 19
    assert radius[SIZE // 2, SIZE // 2 + 27] < 4


def test_the_border_of_the_picture_is_no_outline():
    left = SIZE // 2 + X < 20
    thick = heights(left, 1e-3)
    assert thick[:, 0].min() == pytest.approx(thick.max(), rel=0.01)


def test_heights_are_bounded():
    assert heights(DISC, 1.0).max() == GREATEST
    assert heights(np.ones((9, 9), bool), 0.1).max() == pytest.approx(SWELL * 0.35 * 9 * 0.1)
