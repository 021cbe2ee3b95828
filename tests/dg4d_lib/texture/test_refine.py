import math

import pytest
import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.mesh.render import sample
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.texture.refine import refine_texture
from dg4d_lib.texture.refiner import Identity

HALF = 2 * math.tan(math.radians(OrbitCamera().fov_y_deg) / 2)
STILL = torch.zeros(2, 4, 3)


class Negative:
    """Shows every color's opposite."""

    def refine(self, video: torch.Tensor) -> torch.Tensor:
        return 1 - video


@pytest.fixture
def board() -> TexturedMesh:
    """A square that covers the middle half of the input view with the left half of a smooth texture."""
    corners = torch.tensor([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
    uvs = torch.tensor([[0.0, 0.0], [0.5, 0.0], [0.5, 1.0], [0.0, 1.0]])
    ramp = torch.linspace(0, 1, 16)
    texture = torch.stack(torch.broadcast_tensors(ramp[:, None], ramp, torch.tensor(0.2)), -1)
    return TexturedMesh(0.5 * HALF * corners, torch.tensor([[0, 3, 2], [0, 2, 1]]), uvs, texture)


def test_where_the_refiner_changes_nothing_the_texture_stays_bit_for_bit(board: TexturedMesh) -> None:
    assert torch.equal(refine_texture(board, STILL, Identity(), 64), board.texture)


def test_the_texture_follows_what_the_refiner_shows(board: TexturedMesh) -> None:
    texture = refine_texture(board, STILL, Negative(), 64)
    grid = torch.linspace(0.05, 0.45, 9)
    places = torch.stack(torch.meshgrid(grid, 2 * grid, indexing="ij"), -1).reshape(-1, 2)
    wanted = 1 - sample(board.texture, places)
    torch.testing.assert_close(sample(texture, places), wanted, atol=0.03, rtol=0)


def test_texels_that_the_input_view_does_not_show_stay(board: TexturedMesh) -> None:
    texture = refine_texture(board, STILL, Negative(), 64)
    assert torch.equal(texture[:, 10:], board.texture[:, 10:])
