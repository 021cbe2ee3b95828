import math

import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt
from skimage.measure import euler_number

from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.extraction.density import DensityField, density_field
from dg4d_lib.mesh.extraction.extract import extract_surface
from dg4d_lib.mesh.extraction.tunnels import dilated, euler_gain, fill_tunnels
from dg4d_lib.mesh.folds import genus
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.settings import MeshSettings

LEVEL = 0.5
RASTERIZE = get_rasterizer("auto")


def cloud(means: torch.Tensor, deviation: float) -> Gaussians:
    count = len(means)
    return Gaussians(
        means,
        torch.full((count, 3), math.log(deviation)),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        torch.full((count,), 5.0),
        torch.zeros(count, 1, 3),
    )


def ring() -> Gaussians:
    """A torus that faces the input camera."""
    angles = torch.linspace(0, 2 * math.pi, 25)[:-1]
    return cloud(0.11 * torch.stack([angles.cos(), angles.sin(), 0 * angles], -1), 0.03)


def handles(field: DensityField) -> int:
    return genus(extract_surface(field, LEVEL)[1])


def block_with_bent_bore(width: int) -> DensityField:
    """A cube of 24 cells with a bore that enters at the right and leaves at the top."""
    values = np.zeros((40, 40, 40), np.float32)
    values[8:32, 8:32, 8:32] = 1
    low, high = 20 - width // 2, 20 - width // 2 + width
    values[low:, low:high, low:high] = 0
    values[low:high, low:, low:high] = 0
    return DensityField(torch.from_numpy(values), torch.full((3,), -0.39, dtype=torch.float64), 0.02, 1.0)


def test_narrow_tunnels_are_filled_and_wide_ones_stay():
    opaque = cloud(torch.zeros(1, 3), 0.5)  # no view looks through anything
    narrow, wide = block_with_bent_bore(4), block_with_bent_bore(12)
    assert handles(narrow) == handles(wide) == 1
    filled = fill_tunnels(narrow, LEVEL, opaque, RASTERIZE)
    assert handles(filled) == 0
    assert torch.equal(filled.values[8:16], narrow.values[8:16])  # nothing but the bore
    assert handles(fill_tunnels(wide, LEVEL, opaque, RASTERIZE)) == 1


def test_a_hole_that_a_view_looks_through_stays():
    field = density_field(ring(), MeshSettings(grid=16))
    assert handles(field) == 1
    wall = cloud(torch.tensor([[0.0, 0.0, -0.3]]), 0.3)
    hidden = Gaussians(*(torch.cat(pair) for pair in zip(vars(ring()).values(), vars(wall).values(), strict=True)))
    for silhouettes, left in ((ring(), 1), (hidden, 0)):
        assert handles(fill_tunnels(field, LEVEL, silhouettes, RASTERIZE)) == left


def test_gaps_between_two_bodies_are_not_tunnels():
    values = block_with_bent_bore(4).values.clone()
    values[:, :, 19:21] = 0
    field = DensityField(values, torch.full((3,), -0.39, dtype=torch.float64), 0.02, 1.0)
    filled = fill_tunnels(field, LEVEL, cloud(torch.zeros(1, 3), 0.5), RASTERIZE)
    assert not filled.values[:, :, 19:21].any()


def test_an_empty_field_stays_empty():
    field = DensityField(torch.zeros(8, 8, 8), torch.zeros(3, dtype=torch.float64), 0.1, 1.0)
    assert torch.equal(fill_tunnels(field, LEVEL, ring(), RASTERIZE).values, field.values)


@pytest.mark.parametrize("radius", [1, 2, 3, 4])
def test_a_dilation_reaches_all_samples_within_a_distance(radius: int) -> None:
    solid = np.random.default_rng(radius).random((11, 17, 23)) < 0.004
    assert 0 < solid.sum() < 30
    np.testing.assert_array_equal(dilated(solid, radius), distance_transform_edt(~solid) <= radius)


@pytest.mark.parametrize("share", [0.1, 0.3, 0.6])
def test_the_growth_of_the_euler_characteristic_equals_that_of_whole_pictures(share: float) -> None:
    random = np.random.default_rng(round(10 * share))
    solid = np.pad(random.random((6, 7, 8)) < share, 1)
    labels = np.where(solid, 0, np.pad(random.integers(0, 4, (6, 7, 8)), 1))
    gains = [euler_gain(solid, labels, np.argwhere(labels == part)) for part in (1, 2, 3)]
    before = euler_number(solid, 3)
    assert gains == [euler_number(solid | (labels == part), 3) - before for part in (1, 2, 3)]
    assert len(set(gains)) > 1
