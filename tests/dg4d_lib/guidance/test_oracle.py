import pytest
import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.guidance.interface import View
from dg4d_lib.guidance.oracle import Bank

CAMERAS = (OrbitCamera(0, 0, width=4, height=4), OrbitCamera(20, 337.5, width=4, height=4))


def bank() -> Bank:
    pictures = torch.zeros(2, 2, 4, 4, 4, dtype=torch.uint8)
    pictures[..., 3] = 255
    for row in range(2):
        for column in range(2):
            pictures[row, column, ..., 0] = 100 * row + 50 * column
    return Bank(CAMERAS, (0, 2), pictures)


def test_it_finds_the_pose_and_the_frame():
    views = [View(CAMERAS[1], 2), View(OrbitCamera(20, -22.5, width=4, height=4), 0)]
    color, coverage = bank().clean(views)
    assert (color[:, 0, 0, 0] * 255).round().tolist() == [150, 100]
    assert (coverage == 1).all()


def test_transparent_pixels_are_white():
    empty = Bank(CAMERAS[:1], (0,), torch.zeros(1, 1, 4, 4, 4, dtype=torch.uint8))
    assert (empty.clean([View(CAMERAS[0])])[0] == 1).all()


def test_pictures_come_at_the_size_of_the_camera():
    color, _ = bank().clean([View(OrbitCamera(0, 0, width=8, height=8))])
    assert color.shape == (1, 8, 8, 3)


@pytest.mark.parametrize("view", [View(OrbitCamera(1, 0)), View(CAMERAS[0], 1)])
def test_a_view_it_does_not_have_is_refused(view: View):
    with pytest.raises(BadInput, match="the bank has no picture"):
        bank().clean([view])
