import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, generate_binary_structure, label
from skimage.measure import euler_number, marching_cubes

from dg4d_lib.mesh.extraction import solid as module
from dg4d_lib.mesh.extraction.solid import LEAK, ambiguous, cavities
from dg4d_lib.mesh.folds import genus

LEVEL = 0.5


def noise(seed: int, softness: float) -> np.ndarray:
    """Blobs, filaments and gaps of all sizes, with an empty border."""
    soft = gaussian_filter(np.random.default_rng(seed).random((20, 21, 22)), softness)
    return np.pad((soft * LEVEL / np.quantile(soft, 0.6)).astype(np.float32), 2)


def unambiguous(values: np.ndarray) -> np.ndarray:
    values = values.copy()
    while (marked := ambiguous(values, LEVEL)).any():
        assert (values[marked] < LEVEL).all()
        values[marked] = 2 * LEVEL
    return values


def parts(solid: np.ndarray, reach: int) -> int:
    return int(label(solid, generate_binary_structure(3, reach))[1])


@pytest.mark.parametrize(("seed", "softness"), [(1, 0.0), (2, 0.5), (3, 0.8), (4, 1.2)])
def test_unambiguous_samples_have_one_topology_however_neighbors_are_defined(seed: int, softness: float) -> None:
    before = noise(seed, softness)
    after = unambiguous(before) >= LEVEL
    assert not (before >= LEVEL)[~after].any()
    assert parts(before >= LEVEL, 1) > parts(before >= LEVEL, 3)
    assert parts(after, 1) == parts(after, 3)
    assert euler_number(after, 1) == euler_number(after, 3)


@pytest.mark.parametrize("seed", [5, 6, 7])
def test_surfaces_have_the_handles_of_their_samples(seed: int) -> None:
    values = unambiguous(noise(seed, 0.9))
    solid = values >= LEVEL
    rooms = parts(~solid, 1) - 1
    tunnels = parts(solid, 3) + rooms - euler_number(solid, 3)
    assert tunnels > 3
    assert genus(marching_cubes(values, LEVEL)[1]) == tunnels


@pytest.mark.parametrize("step", [(1, 1, 0), (0, 1, -1), (1, -1, 1), (1, 1, 1)])
def test_the_denser_sample_beside_a_diagonal_contact_is_marked(step: tuple[int, int, int]) -> None:
    values = np.zeros((5, 5, 5), np.float32)
    values[2, 2, 2] = values[2 + step[0], 2 + step[1], 2 + step[2]] = 1
    axis = max(number for number, reach in enumerate(step) if reach)
    denser = tuple(2 + reach * (number == axis) for number, reach in enumerate(step))
    values[denser] = 0.3
    np.testing.assert_array_equal(np.argwhere(ambiguous(values, LEVEL)), [denser])
    values[denser] = 0.6
    assert not ambiguous(values, LEVEL)[denser]


def test_empty_samples_that_touch_at_a_corner_are_joined_by_none() -> None:
    values = np.ones((6, 6, 6), np.float32)
    values[2, 2, 2], values[3, 3, 3] = 0.2, 0.4
    np.testing.assert_array_equal(np.argwhere(ambiguous(values, LEVEL)), [(3, 3, 3)])


def test_a_room_behind_a_narrow_gap_is_a_cavity_and_an_open_one_is_not() -> None:
    box = np.zeros((24, 24, 24), bool)
    box[3:21, 3:21, 3:21] = True
    box[6:18, 6:18, 6:18] = False
    for width, closed in ((2, True), (8, False)):
        opened = box.copy()
        low = 12 - width // 2
        opened[low : low + width, low : low + width, 18:] = False
        assert bool(cavities(opened)[12, 12, 12]) is closed


@pytest.mark.parametrize("margin", [0, 1, 9])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.5])
def test_samples_far_from_the_body_are_not_searched_and_hold_no_cavity(
    margin: int, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    soft = gaussian_filter(np.random.default_rng(0).random((24, 25, 26)), 1.5)
    solid = np.pad(soft > np.quantile(soft, 1 - share), margin)
    searched = []
    whole = module._cavities
    monkeypatch.setattr(module, "_cavities", lambda part: searched.append(part.shape) or whole(part))
    found = cavities(solid)
    np.testing.assert_array_equal(found, whole(solid))
    assert found.any() == (share > 0)
    assert all(max(shape) <= 26 + 2 * LEAK for shape in searched)
