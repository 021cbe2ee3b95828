"""Compiled node motions equal those of plain torch, which runs in double precision and on GPUs, and so do gradients."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from scipy.spatial import Delaunay
from torch import Tensor

from dg4d_lib.fitting import node_kernels, node_motion, rigidity
from dg4d_lib.fitting.node_motion import NodeBasis, NodeMotion
from dg4d_lib.fitting.rigidity import edge_energy
from dg4d_lib.mesh.models.control_graph import ControlGraph, build_control_graph

FRAMES, NODES = 3, 12
Result = Callable[[NodeMotion, ControlGraph], Tensor]


@pytest.fixture(scope="module")
def graph() -> ControlGraph:
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 7), indexing="ij"))
    vertices = np.stack([x, y, np.sin(2 * x)], -1)
    return build_control_graph(vertices, Delaunay(vertices[:, :2]).simplices.astype(np.int64), NODES, braced=False)


@pytest.fixture(scope="module")
def variables() -> list[Tensor]:
    """Return random quaternions of many norms, shifts, and a rotation and a shift of the whole."""
    generator = torch.Generator().manual_seed(0)
    quats = torch.randn(FRAMES, NODES, 4, generator=generator)
    norms = torch.logspace(-6, 6, NODES)[:, None]
    others = [(FRAMES, NODES, 3), (FRAMES, 4), (FRAMES, 3)]
    return [norms * quats, *(0.3 * torch.randn(shape, generator=generator) for shape in others)]


def points_of(motion: NodeMotion, graph: ControlGraph) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    rest = torch.randn(len(graph.indices), 3, generator=generator)
    return motion.points(rest.to(graph.nodes), graph)


def integral_of(motion: NodeMotion, graph: ControlGraph) -> Tensor:
    return NodeBasis(graph, 1.0, integrated=True).integral(motion.quats)


@pytest.mark.parametrize(
    "result",
    [
        points_of,
        integral_of,
        partial(edge_energy, bending=0.0, log=False),
        partial(edge_energy, bending=0.7, log=False),
        partial(edge_energy, bending=0.7, log=True),
    ],
)
def test_kernels_and_torch_agree(
    result: Result, graph: ControlGraph, variables: list[Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    exact = replace(graph, **{name: getattr(graph, name).double() for name in ("nodes", "weights", "lengths")})
    found = values_and_gradients(result, graph, variables)
    for module in (node_motion, rigidity):  # torch must not be what is compared with torch
        monkeypatch.setattr(module, "has_kernels", lambda values: False)
    expected = values_and_gradients(result, exact, [value.double() for value in variables])
    for ours, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(ours.double(), theirs, rtol=1e-4, atol=1e-5 * float(theirs.abs().max()))


def values_and_gradients(result: Result, graph: ControlGraph, variables: list[Tensor]) -> list[Tensor]:
    """Return the result of a motion, and the gradient of a sum of its coordinates, which differ in weight."""
    leaves = [value.clone().requires_grad_() for value in variables]
    values = result(NodeMotion(*leaves), graph)
    weights = torch.linspace(-1, 2, values.numel()).view_as(values).to(values)
    gradients = torch.autograd.grad((weights * values).sum(), leaves, allow_unused=True)
    norm = variables[0].norm(dim=-1, keepdim=True)  # gradients by quaternions shrink with their norms
    slopes = [gradient for gradient in (gradients[0] * norm, *gradients[1:]) if gradient is not None]
    return [values.detach(), *slopes]


def test_kernels_are_for_single_precision_on_a_processor() -> None:
    assert node_kernels.has_kernels(torch.zeros(1))
    assert not node_kernels.has_kernels(torch.zeros(1, dtype=torch.float64))
    assert not node_kernels.has_kernels(torch.zeros(1, device="meta"))
