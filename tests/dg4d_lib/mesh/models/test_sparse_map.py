"""Sparse maps against dense matrices."""

import pytest
import torch
from torch.testing import assert_close

from dg4d_lib.mesh.models.sparse_map import SparseMap


@pytest.mark.parametrize("frames", [0, 1, 3])
def test_sums_and_their_gradients_are_those_of_a_dense_matrix(frames: int) -> None:
    generator = torch.Generator().manual_seed(0)
    indices = torch.stack([torch.randperm(20, generator=generator)[:4] for _ in range(50)])
    weights = torch.rand(50, 4, generator=generator)
    dense = torch.zeros(50, 20).scatter_(1, indices, weights)
    values = torch.randn(frames, 20, 5, generator=generator, requires_grad=True)
    sums, toward = SparseMap(indices, weights, 20)(values), torch.randn(frames, 50, 5, generator=generator)
    assert_close(sums, dense @ values)
    (gradient,) = torch.autograd.grad((sums * toward).sum(), values)
    assert_close(gradient, dense.T @ toward)
