"""Synthetic samples: determinism, symmetry, framing, and matter that agrees with the picture."""

import math

import numpy as np
import pytest
from scipy import ndimage

from dg4d_lib.cameras.orbit import RADIUS, OrbitCamera
from dg4d_lib.shape_prior.frustum import BINS, FAR, NEAR, SIZE, TAN_HALF_FOV
from training.shape_prior.chance import Chance
from training.shape_prior.families import FAMILIES
from training.shape_prior.kernels import cross, distance, fill, soft_occupancy
from training.shape_prior.samples import CENTERED_SPAN, Sample, framed, make_sample, make_views
from training.shape_prior.solids import CARVE, CONE, Shape, packed, rotation, scaled, turned

STEP = (FAR - NEAR) / BINS


def crossings(shape: Shape) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Counts, distances and coverage of the rays through a shape in world units."""
    labels, numbers = packed(shape.solids)
    field, near = np.empty((SIZE, SIZE, BINS), np.float32), np.empty((SIZE, SIZE, 2), np.uint64)
    fill(labels, numbers, field, near)
    counts, nearest = np.empty((SIZE, SIZE), np.uint8), np.empty((SIZE, SIZE), np.float32)
    depths, coverage = np.zeros((SIZE, SIZE, 10), np.float32), np.empty((SIZE, SIZE), np.float32)
    cross(field, counts, depths, coverage, nearest)
    return counts, depths, coverage


@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_makes_the_same_sample_twice_and_another_for_another_number(family: str) -> None:
    first, again, other = (make_sample(3, index, family) for index in (5, 5, 6))
    for name in ("picture", "pixels", "counts", "depths", "colors", "plane"):
        assert np.array_equal(getattr(first, name), getattr(again, name))
    assert not np.array_equal(first.picture, other.picture)


@pytest.mark.parametrize("family", FAMILIES)
def test_crossings_come_in_order_and_in_pairs(family: str) -> None:
    sample = make_sample(4, 1, family)
    assert (sample.counts % 2 == 0).all()
    assert (sample.counts > 0).all()
    used = np.arange(sample.depths.shape[1])[None] < sample.counts[:, None]
    steps = np.diff(sample.depths.astype(int), axis=1)
    assert (steps[used[:, 1:]] >= 0).all()


def test_a_ball_is_crossed_where_geometry_says() -> None:
    shape = Shape()
    shape.ellipsoid((0.1, -0.2, 0.15), 0.4)
    counts, depths, _ = crossings(shape)
    for row, column in ((64, 64), (80, 70), (75, 50)):
        ray = np.array(
            [(2 * (column + 0.5) / SIZE - 1) * TAN_HALF_FOV, (1 - 2 * (row + 0.5) / SIZE) * TAN_HALF_FOV, -1]
        )
        start = np.array([0, 0, RADIUS]) - [0.1, -0.2, 0.15]
        a, b, c = ray @ ray, 2 * ray @ start, start @ start - 0.16
        root = math.sqrt(b * b - 4 * a * c)
        assert counts[row, column] == 2
        # the field of an ellipsoid with equal radii is exact, what is left is its linear interpolation
        assert depths[row, column, :2] == pytest.approx([(-b - root) / 2 / a, (-b + root) / 2 / a], abs=0.1 * STEP)


def test_the_camera_is_the_input_camera() -> None:
    shape = Shape()
    shape.ellipsoid((0.3, 0.25, 0.2), 0.05)
    counts, _, _ = crossings(shape)
    rows, columns = np.nonzero(counts)
    camera = OrbitCamera(width=SIZE, height=SIZE)
    view = camera.viewmat().numpy() @ [0.3, 0.25, 0.2, 1]
    center = view[:2] / view[2] * camera.focal + SIZE / 2
    assert (columns.mean() + 0.5, rows.mean() + 0.5) == pytest.approx(tuple(center), abs=0.5)


def test_carving_takes_matter_away() -> None:
    shape = Shape()
    shape.box((0, 0, 0), (0.3, 0.3, 0.3))
    shape.box((0, 0, 0), (0.1, 0.1, 1.0), operation=CARVE)
    counts, _, coverage = crossings(shape)
    assert counts[64, 64] == 0
    assert coverage[64, 64] == 0
    assert counts[64, 80] == 2


def test_thin_plates_are_crossed_at_every_angle() -> None:
    for pitch in (0.0, 0.4, 1.2):
        shape = Shape()
        shape.plate((0, 0, 0), [(-0.3, -0.3), (0.3, -0.3), (0.3, 0.3), (-0.3, 0.3)], 0.016, turned(0.2, pitch))
        counts, _, _ = crossings(shape)
        rows = slice(62, 66)
        assert (counts[rows, 60:68] > 0).all()


@pytest.mark.parametrize("family", ["mammal", "person", "robot", "beetle", "car", "chest"])
def test_the_mirror_image_of_a_solid_has_the_mirrored_distance(family: str) -> None:
    shape = Shape()
    FAMILIES[family][0](Chance(8), shape)
    generator = np.random.default_rng(0)
    points = generator.normal(0, 0.4, (20, 3))
    labels, numbers = packed(shape.solids)
    _, mirrored = packed([solid.mirrored() for solid in shape.solids])
    for x, y, z in points:
        for label, row, other in zip(labels, numbers, mirrored, strict=True):
            assert distance(label[0], row, x, y, z) == pytest.approx(distance(label[0], other, -x, y, z), abs=1e-9)


@pytest.mark.parametrize("family", ["chest", "car", "vessel"])
def test_what_is_called_symmetric_is(family: str) -> None:
    made = [make_sample(2, index, family) for index in range(12)]
    sample = next(s for s in made if s.symmetric == 1 and abs(s.plane[0]) < 0.9)
    matter = points_of(sample)
    normal, offset = sample.plane[:3].astype(float), float(sample.plane[3])
    assert np.linalg.norm(normal) == pytest.approx(1, abs=1e-5)
    mirrored = matter - 2 * (matter @ normal - offset)[:, None] * normal
    assert share_inside(sample, mirrored) > 0.85
    wrong = matter * [-1, 1, 1]
    assert share_inside(sample, wrong) < share_inside(sample, mirrored)


def points_of(sample: Sample) -> np.ndarray:
    """World points in the middle of the occupied cells."""
    unit = sample.depths.astype(np.float32) / 65535
    cells = soft_occupancy(unit, sample.counts, np.empty((len(unit), BINS), np.float32)) > 0.5
    ray, cell = np.nonzero(cells)
    row, column = np.divmod(sample.pixels[ray].astype(int), SIZE)
    distance = NEAR + (cell + 0.5) * STEP
    x = (2 * (column + 0.5) / SIZE - 1) * TAN_HALF_FOV * distance
    y = (1 - 2 * (row + 0.5) / SIZE) * TAN_HALF_FOV * distance
    return np.stack([x, y, RADIUS - distance], -1)


def share_inside(sample: Sample, points: np.ndarray) -> float:
    """Share of points whose cell, or a neighbor along the ray, is occupied."""
    unit = sample.depths.astype(np.float32) / 65535
    grid = np.zeros((SIZE * SIZE, BINS), bool)
    grid[sample.pixels] = soft_occupancy(unit, sample.counts, np.empty((len(unit), BINS), np.float32)) > 0
    distance = RADIUS - points[:, 2]
    column = ((points[:, 0] / distance / TAN_HALF_FOV + 1) / 2 * SIZE).astype(int)
    row = ((1 - points[:, 1] / distance / TAN_HALF_FOV) / 2 * SIZE).astype(int)
    cell = ((distance - NEAR) / STEP).astype(int)
    inside = (column >= 0) & (column < SIZE) & (row >= 0) & (row < SIZE) & (cell >= 0) & (cell < BINS)
    return float(grid[row[inside] * SIZE + column[inside], cell[inside]].sum() / len(points))


def test_framing_centers_and_spans_what_prepare_subject_does() -> None:
    points = np.random.default_rng(1).normal(0, [0.3, 0.6, 0.2], (500, 3))
    scale, shift = framed(points, CENTERED_SPAN, 9.0)
    world = points * scale + shift
    seen = world[:, :2] / (RADIUS - world[:, 2:]) / TAN_HALF_FOV
    assert np.ptp(seen, 0).max() / 2 == pytest.approx(CENTERED_SPAN, abs=0.01)
    assert (seen.max(0) + seen.min(0)) / 2 == pytest.approx([0, 0], abs=0.01)


def test_pictures_are_premultiplied_and_show_the_matter() -> None:
    for index in range(6):
        sample = make_sample(5, index)
        alpha = sample.picture[..., 3]
        assert (sample.picture[..., :3].max(-1) <= alpha.astype(int) + 1).all()
        hit = np.zeros(SIZE * SIZE, bool)
        hit[sample.pixels] = True
        # blurred and hardened alpha moves outlines by a pixel at most
        assert (hit.reshape(SIZE, SIZE) == (alpha > 127)).mean() > 0.97


def test_scaling_a_shape_scales_its_distances() -> None:
    shape = Shape()
    FAMILIES["robot"][0](Chance(1), shape)
    labels, numbers = packed(shape.solids)
    _, grown = packed([scaled(solid, 2.5) for solid in shape.solids])
    for label, row, other in zip(labels, numbers, grown, strict=True):
        assert distance(label[0], other, 0.5, 0.25, 0.75) == pytest.approx(
            2.5 * distance(label[0], row, 0.2, 0.1, 0.3), rel=1e-6
        )


def test_moving_a_shape_moves_its_distances() -> None:
    shape = Shape()
    shape.cone((0, 0, 0), (0.1, 0.4, 0.2), 0.2, 0.05, flat=0.5)
    assert shape.solids[0].kind == CONE
    labels, numbers = packed(shape.solids)
    turn, shift = rotation(0.7, 0.2, 0.1), np.array([0.1, 0.2, 0.3])
    shape.move(0, turn, shift)
    _, moved = packed(shape.solids)
    point = np.array([0.3, 0.2, -0.1])
    there = turn @ point + shift
    assert distance(labels[0, 0], moved[0], *there) == pytest.approx(
        distance(labels[0, 0], numbers[0], *point), abs=1e-9
    )


def test_soft_occupancy_sums_to_the_thickness() -> None:
    depths = np.array([[0.1, 0.35, 0.5, 0.503]], np.float32)
    cells = soft_occupancy(depths, np.array([4], np.uint8), np.empty((1, BINS), np.float32))
    assert cells.sum() / BINS == pytest.approx(0.253, abs=1e-5)
    assert cells.max() <= 1


def test_views_show_the_matter_where_their_cameras_see_it() -> None:
    azimuths = (0.0, 75.0, 180.0, -105.0)
    for index in range(6):
        sample, views = make_views(6, index, azimuths)
        assert np.abs(views[0] * 255 - sample.picture).max() <= 0.51
        used = np.arange(sample.depths.shape[1])[None] < sample.counts[:, None]
        ray, crossing = np.nonzero(used)
        depth = NEAR + sample.depths[ray, crossing] / 65535 * (FAR - NEAR)
        row, column = sample.pixels[ray].astype(int) // SIZE, sample.pixels[ray].astype(int) % SIZE
        x = (2 * (column + 0.5) / SIZE - 1) * TAN_HALF_FOV * depth
        y = (1 - 2 * (row + 0.5) / SIZE) * TAN_HALF_FOV * depth
        points = np.column_stack([x, y, RADIUS - depth, np.ones_like(x)])
        for azimuth, view in zip(azimuths, views, strict=True):
            camera = OrbitCamera(0, azimuth, width=SIZE, height=SIZE)
            seen = points @ camera.viewmat().numpy().T
            at = (SIZE / 2 + camera.focal * seen[:, :2] / seen[:, 2:3]).astype(int).clip(0, SIZE - 1)
            grown = ndimage.maximum_filter(view[..., 3], 5)  # matter is known on pixels of the input camera only
            assert (grown[at[:, 1], at[:, 0]] > 0).mean() > 0.99
