import torch

from dg4d_lib.geometry.spherical_harmonics import color_of_harmonics, harmonics_of_color


def test_colors_survive_the_round_trip():
    colors = torch.rand(100, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(color_of_harmonics(harmonics_of_color(colors)), colors)


def test_colors_stay_in_range():
    assert color_of_harmonics(torch.tensor([[[9.0, -9.0, 0.0]]])).tolist() == [[1.0, 0.0, 0.5]]
