"""Specks beside a moving subject are found; what is thin, sparse or a piece of the subject is kept."""

from dataclasses import replace

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.initialize import on_surface
from dg4d_lib.gaussians.strays import find_strays

FRAMES, COUNT = 4, 600


def states(paths: Float[Tensor, "t n 3"], scale: float = 0.01) -> Gaussians:
    """Return Gaussians of one size on these paths."""
    count = paths.shape[1]
    cloud = on_surface(paths[0], torch.full((count, 3), 0.5), 1.0)
    log_scales = torch.full(paths.shape, scale).log()
    return replace(cloud, means=paths, log_scales=log_scales, quats=cloud.quats.expand(len(paths), -1, -1))


@pytest.fixture
def body() -> Tensor:
    """Paths of a ball that moves to the right."""
    generator = torch.Generator().manual_seed(0)
    ball = 0.3 * torch.nn.functional.normalize(torch.randn(COUNT, 3, generator=generator), dim=-1)
    return ball + torch.linspace(0, 0.3, FRAMES)[:, None, None] * torch.tensor([1.0, 0, 0])


def test_what_tears_away_at_one_frame_is_a_stray(body: Tensor) -> None:
    torn = body.clone()
    torn[2, 7] += torch.tensor([0.0, 1.0, 0.0])
    torn[3, 11:13] += torch.tensor([0.0, 1.0, 0.0])  # two that stay together
    torn[3, 12] = torn[3, 11] + 0.01
    assert find_strays([states(torn)]).nonzero()[:, 0].tolist() == [7, 11, 12]
    assert find_strays([states(torn[:3]), states(torn[3:])]).nonzero()[:, 0].tolist() == [7, 11, 12]


def test_pieces_of_the_subject_stay_however_small(body: Tensor) -> None:
    ball = torch.tensor([[0.0, 0.8, 0.0]]).expand(FRAMES, 1, 3)  # thrown up all the time
    arm = torch.stack([torch.linspace(0.3, 0.9, 12), torch.zeros(12), torch.zeros(12)], -1).expand(FRAMES, -1, -1)
    apart = body.clone()
    apart[1:, body[0, :, 1] > 0.1] += torch.tensor([0.0, 1.0, 0.0])  # a lid is taken off
    assert not find_strays([states(torch.cat([apart, ball, arm], 1))]).any()


def test_large_gaussians_reach_farther(body: Tensor) -> None:
    torn = body.clone()
    torn[2, 7] = body[2, body[2, :, 1].argmax()] + torch.tensor([0.0, 0.15, 0.0])
    assert find_strays([states(torn)]).sum() == 1
    assert not find_strays([states(torn, scale=0.03)]).any()


@pytest.mark.parametrize("count", [1, 4, 40])
def test_a_sparse_cloud_is_kept(count: int) -> None:
    paths = torch.randn(FRAMES, count, 3, generator=torch.Generator().manual_seed(0))
    assert find_strays([states(paths)]).tolist() == [False] * count
