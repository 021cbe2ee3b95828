"""Warps of synthetic shapes: surfaces go where the map takes them, joints hold, symmetry stays."""

import numpy as np
import pytest

from training.shape_prior.chance import Chance
from training.shape_prior.families import FAMILIES
from training.shape_prior.kernels import MOST_SOLIDS, distance
from training.shape_prior.solids import CARVE, CONE, Shape, Solid, packed, turned
from training.shape_prior.warp import Warp, attach, extent_of, random_warp, warped

NONE = np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3, 3))
POINTS = np.random.default_rng(0).normal(0, 0.5, (40, 3))


def distances(solid: Solid, points: np.ndarray) -> np.ndarray:
    labels, numbers = packed([solid])
    return np.array([distance(labels[0, 0], numbers[0], *point) for point in points])


def one_of_each() -> Shape:
    shape = Shape()
    turn = turned(0.3, 0.2, 0.5)
    shape.ellipsoid((0.2, 0.1, -0.1), (0.3, 0.2, 0.1), turn)
    shape.cone((0.1, 0, 0), (0.3, 0.4, 0.2), 0.1, 0.05, flat=0.6)
    shape.box((0, 0.2, 0), (0.3, 0.2, 0.1), turn, taper=0.2)
    shape.cylinder((0.1, 0, 0.3), 0.2, 0.3, turn, flat=0.7)
    shape.torus((0, 0, 0.2), 0.3, 0.1, turn)
    shape.plate((0, 0.1, 0), [(-0.3, -0.2), (0.3, -0.3), (0.2, 0.3), (-0.2, 0.2)], 0.05, turn)
    shape.shell((0, 0, 0), (0.3, 0.3, 0.2), 0.04, 0.1, turn)
    return shape


def test_no_warp_changes_nothing() -> None:
    warp = Warp(np.ones(3), *NONE)
    for solid in one_of_each().solids:
        assert distances(warped(solid, warp), POINTS) == pytest.approx(distances(solid, POINTS), abs=1e-6)


def test_growth_in_all_directions_scales_distances() -> None:
    warp = Warp(np.full(3, 1.4), *NONE)
    for solid in one_of_each().solids:
        assert distances(warped(solid, warp), 1.4 * POINTS) == pytest.approx(1.4 * distances(solid, POINTS), abs=1e-5)


def test_a_stretched_ellipsoid_has_its_surface_where_the_map_takes_it() -> None:
    shape, warp = Shape(), Warp(np.array([1.3, 0.8, 1.1]), *NONE)
    shape.ellipsoid((0.2, -0.1, 0.1), (0.4, 0.2, 0.3))
    direction = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)
    surface = shape.solids[0].center + direction * shape.solids[0].half
    assert distances(warped(shape.solids[0], warp), warp(surface)) == pytest.approx(0, abs=1e-6)


def test_a_turn_around_a_center_turns_what_is_there_and_nothing_far_away() -> None:
    growth = np.cross(np.eye(3), [0.0, 0.3, 0.0])
    warp = Warp(np.ones(3), np.zeros((1, 3)), np.array([0.5]), growth[None])
    shape = Shape()
    shape.box((0, 0, 0), (0.1, 0.1, 0.1))
    shape.box((4, 0, 0), (0.1, 0.1, 0.1))
    here, far = (warped(solid, warp) for solid in shape.solids)
    assert here.center == pytest.approx(np.zeros(3), abs=1e-9)
    cosine = (np.trace(here.axes) - 1) / 2
    assert np.arccos(cosine) == pytest.approx(np.arctan(0.3), abs=1e-3)
    assert far.axes == pytest.approx(np.eye(3), abs=1e-9)


@pytest.mark.parametrize("family", ["mammal", "person", "dinosaur"])
def test_chains_of_cones_stay_joined(family: str) -> None:
    shape = Shape()
    FAMILIES[family][0](Chance(4), shape)
    warp = random_warp(Chance(5), shape)

    def ends(solid: Solid) -> list[np.ndarray]:
        along = solid.parameters[0] * solid.axes[1]
        return [solid.center - along, solid.center + along]

    before = [end for solid in shape.solids if solid.kind == CONE for end in ends(solid)]
    after = [end for solid in shape.solids if solid.kind == CONE for end in ends(warped(solid, warp))]
    joined = [(i, j) for i in range(len(before)) for j in range(i) if np.allclose(before[i], before[j], atol=1e-9)]
    assert len(joined) > 2
    for i, j in joined:
        assert after[i] == pytest.approx(after[j], abs=1e-9)


@pytest.mark.parametrize("family", ["mammal", "robot", "butterfly"])
def test_symmetric_shapes_stay_symmetric(family: str) -> None:
    shape = Shape()
    FAMILIES[family][0](Chance(1), shape)
    shape.symmetric = True
    warp = random_warp(Chance(2), shape)
    for solid in shape.solids:
        one, other = warped(solid, warp).mirrored(), warped(solid.mirrored(), warp)
        assert distances(one, POINTS) == pytest.approx(distances(other, POINTS), abs=1e-6)


def test_bodies_of_revolution_stay_round() -> None:
    shape = Shape(symmetric=None)
    shape.ellipsoid((0, 0, 0), (0.4, 0.5, 0.4))
    for seed in range(5):
        warp = random_warp(Chance(seed), shape)
        turn = turned(0.7)
        assert warp(POINTS @ turn) == pytest.approx(warp(POINTS) @ turn, abs=1e-9)


@pytest.mark.parametrize("family", FAMILIES)
def test_attached_things_are_small_and_carve_nothing(family: str) -> None:
    for seed in range(3):
        shape = Shape()
        FAMILIES["person"][0](Chance(seed), shape)
        before, extent = list(shape.solids), extent_of(shape.solids)
        attach(Chance(seed), shape, FAMILIES[family][0], MOST_SOLIDS)
        added = shape.solids[len(before) :]
        assert shape.solids[: len(before)] == before
        assert len(shape.solids) <= MOST_SOLIDS
        if added:
            assert shape.symmetric is False
            assert all(solid.operation != CARVE for solid in added)
            assert extent_of(shape.solids) < 2.5 * extent
