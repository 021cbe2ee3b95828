import torch

from dg4d_lib.geometry.spherical_harmonics import rgb_to_sh, sh_to_rgb


def test_colors_survive_the_round_trip():
    colors = torch.rand(100, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(sh_to_rgb(rgb_to_sh(colors)), colors)


def test_colors_stay_in_range():
    assert sh_to_rgb(torch.tensor([[[9.0, -9.0, 0.0]]])).tolist() == [[1.0, 0.0, 0.5]]
