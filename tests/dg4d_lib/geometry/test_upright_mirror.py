"""Mirror planes: known ones are found wherever they lie, and bodies without one have none."""

import numpy as np
import pytest

from dg4d_lib.geometry.mirror import mirror_errors, mirror_normal


def symmetric(azimuth_deg: float, offset: float = 0.0) -> np.ndarray:
    """Return random clumps and their mirror images across an upright plane."""
    random = np.random.default_rng(3)
    centers, scales = random.uniform(-0.5, 0.5, (6, 3)), random.uniform(0.03, 0.1, (6, 3))
    half = (centers + scales * random.normal(size=(100, 6, 3))).reshape(-1, 3)
    angle = np.deg2rad(azimuth_deg)
    normal = np.array([np.sin(angle), 0, np.cos(angle)])
    mirrored = half - 2 * (half @ normal - offset)[:, None] * normal
    return random.permutation(np.concatenate([half, mirrored]))


@pytest.mark.parametrize("azimuth", [0.0, 33.0, 90.0, 128.0, 178.0])
def test_the_plane_of_a_symmetric_body_is_found(azimuth: float) -> None:
    found = mirror_normal(symmetric(azimuth))
    assert found is not None
    angle = np.deg2rad(azimuth)
    assert abs(found @ (np.sin(angle), 0, np.cos(angle))) > np.cos(np.deg2rad(1.5))
    assert found[1] == 0 and found[2] >= 0 and np.linalg.norm(found) == pytest.approx(1)


def test_it_need_not_pass_through_the_middle() -> None:
    points = symmetric(33.0, 0.05)
    points = np.concatenate([points, points[:100] * 0.01 + (0.2, 0.4, 0.1)])
    errors = mirror_errors(points, np.array([33.0, 123.0]))
    assert errors[0] < 0.6 * errors[1]


@pytest.mark.parametrize("shape", ["ball", "box", "one-sided"])
def test_a_body_without_a_plane_of_its_own_has_none(shape: str) -> None:
    random = np.random.default_rng(5)
    points = random.normal(size=(1500, 3))
    if shape == "ball":
        points /= np.linalg.norm(points, axis=1, keepdims=True)
    elif shape == "box":  # has two
        points = random.uniform(-1, 1, (1500, 3)) * (0.5, 0.3, 0.8)
    else:  # a helix
        turn = np.linspace(0, 9, 1500)
        points = np.stack([np.cos(turn), turn / 3, np.sin(turn)], 1) + 0.02 * points
    assert mirror_normal(points) is None


def test_a_single_point_has_none() -> None:
    assert mirror_normal(np.zeros((4, 3))) is None
