"""Video distances against formulas, SciPy's matrix root, and NumPy's old covariance of one row."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_judges
import torch
from scipy.linalg import sqrtm
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.metrics.fvd import MIN_FRAMES, frechet_distance, fvd, fvd_consistent4d, load_i3d, logits

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def i3d(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return load_i3d(tiny_judges.write_i3d(tmp_path_factory.mktemp("i3d")), CPU)


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def test_the_published_number_is_a_frechet_distance_with_one_films_spread() -> None:
    a, b = random(400).double(), 2 * random(400, seed=1).double() + 1
    spread_a, spread_b = (float(np.cov(one.numpy())) for one in (a, b))
    expected = float((a - b).square().sum()) + spread_a + spread_b - 2 * np.sqrt(spread_a * spread_b)
    assert fvd_consistent4d(a, b).item() == pytest.approx(expected)
    assert fvd_consistent4d(a, a) == 0


def test_crowds_that_differ_by_a_shift_are_its_square_apart() -> None:
    crowd, shift = random(50, 4), torch.tensor([3.0, 0, 4, 0])
    assert frechet_distance(crowd, crowd + shift).item() == pytest.approx(25)
    assert frechet_distance(crowd, crowd).item() == pytest.approx(0, abs=1e-9)


def test_a_crowd_twice_as_wide_is_as_far_as_its_variance() -> None:
    """tr(C + 4 C - 2 (4 C^2)^(1/2)) = tr C, around a common mean."""
    crowd = random(60, 5).double()
    crowd = crowd - crowd.mean(0)
    assert frechet_distance(crowd, 2 * crowd).item() == pytest.approx(float(crowd.var(0).sum()))


def test_the_distance_is_that_with_a_matrix_root() -> None:
    a, b = random(40, 6).double() @ random(6, 6, seed=3).double(), random(30, 6, seed=1).double() + 0.5
    covariances = [np.cov(one.numpy(), rowvar=False) for one in (a, b)]
    root = sqrtm(covariances[0] @ covariances[1])
    shift = (a.mean(0) - b.mean(0)).numpy()
    expected = shift @ shift + np.trace(covariances[0] + covariances[1] - 2 * np.real(root))
    assert frechet_distance(a, b).item() == pytest.approx(expected)
    assert fvd(a.tolist(), b.tolist()) == pytest.approx(expected)


def test_as_many_films_as_numbers_are_too_few() -> None:
    assert frechet_distance(random(7, 6), random(7, 6, seed=1)) > 0
    with pytest.raises(BadInput, match="more than 6 on each side; given 7 and 6"):
        frechet_distance(random(7, 6), random(6, 6))


def test_the_network_sees_colors_between_minus_one_and_one(i3d: Any) -> None:
    gray = torch.full((MIN_FRAMES, 32, 32, 3), 0.75)
    expected = tiny_judges.TinyI3d()(torch.full((1, 3, 2, 2, 2), 0.5), False, False, True)
    torch.testing.assert_close(logits(i3d, gray, CPU), expected[0], atol=1e-5, rtol=1e-4)


def test_a_film_is_seen_whole_and_as_it_is(i3d: Any) -> None:
    film = torch.rand(MIN_FRAMES, 224, 224, 3, generator=torch.Generator().manual_seed(4))
    expected = tiny_judges.TinyI3d()(2 * film.permute(3, 0, 1, 2)[None] - 1, False, False, True)
    torch.testing.assert_close(logits(i3d, film, CPU), expected[0], atol=1e-4, rtol=1e-3)


def test_a_short_film_is_refused(i3d: Any) -> None:
    with pytest.raises(BadInput, match="10 frames or more; given 9"):
        logits(i3d, torch.zeros(9, 32, 32, 3), CPU)


def test_a_file_that_is_no_torchscript_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="has no TorchScript file"):
        load_i3d(tmp_path, CPU)
    (tmp_path / "i3d.pt").write_bytes(b"something else")
    with pytest.raises(BadInput, match=r"i3d\.pt is not a TorchScript"):
        load_i3d(tmp_path, CPU)
