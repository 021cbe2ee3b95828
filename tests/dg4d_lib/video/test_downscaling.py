import pytest
import torch

from dg4d_lib.video.downscaling import BandDownscaler
from dg4d_lib.video.framing import downscale


def in_bands(picture: torch.Tensor, longest: int, rows: int) -> torch.Tensor:
    shrinker = BandDownscaler(*picture.shape[:2], longest)
    for top in range(0, len(picture), rows):
        shrinker.add(top, picture[top : top + rows])
    return shrinker.picture()


def noise(height: int, width: int) -> torch.Tensor:
    return torch.rand(height, width, 4, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("rows", [1, 7, 64, 500])
@pytest.mark.parametrize(("height", "width"), [(300, 200), (123, 457), (64, 512)])
def test_a_picture_in_bands_shrinks_as_the_whole_does(height, width, rows):
    picture = noise(height, width)
    picture[:, : width // 3, 3] = 0
    # float32 sums of a few hundred terms in another order
    torch.testing.assert_close(in_bands(picture, 60, rows), downscale(picture[None], 60)[0], atol=2e-6, rtol=0)


def test_a_picture_that_is_small_enough_keeps_its_values():
    picture = noise(40, 50)
    assert torch.equal(in_bands(picture, 50, 7), picture)


def test_bands_may_come_in_any_order():
    picture, shrinker = noise(90, 70), BandDownscaler(90, 70, 31)
    for top in (60, 0, 30):
        shrinker.add(top, picture[top : top + 30])
    torch.testing.assert_close(shrinker.picture(), downscale(picture[None], 31)[0], atol=2e-6, rtol=0)
