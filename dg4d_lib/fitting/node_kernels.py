"""Compiled kernels of node motions, with their gradients: moved points, turned edges, and the energy of edges.

A descent over some hundred nodes spends more time on starting torch's small operators than on numbers. The sums of the
gradients have one order, so every run gives the same.
"""

from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from dg4d_lib.kernels.compiling import njit

KERNEL = {"cache": True, "nogil": True, "error_model": "numpy"}


def has_kernels(values: Tensor) -> bool:
    """Return True if the kernels can be used for these variables."""
    return values.device.type == "cpu" and values.dtype == torch.float32


def moved_points(
    quats: Float[Tensor, "t m 4"],
    shifts: Float[Tensor, "t m 3"],
    nodes: Float[Tensor, "m 3"],
    rest: Float[Tensor, "v 3"],
    indices: Int[Tensor, "v k"],
    weights: Float[Tensor, "v k"],
) -> Float[Tensor, "t v 3"]:
    """Return points that are moved by the weighted mean of the rigid transforms of their nodes.

    Differentiable once, in rotations and shifts.

    Args:
        quats: rotations of the nodes about their places, wxyz, any norm from 1e-10 to 1e18.
        shifts: of the nodes.
        nodes: at rest.
        rest: points at rest.
        indices: nodes of every point.
        weights: of these nodes, sum 1.
    """
    points: Tensor = _MovedPoints.apply(quats, shifts, *(_array(value) for value in (nodes, rest, indices, weights)))
    return points


def turned_edges(
    quats: Float[Tensor, "t m 4"], spans: Float[Tensor, "e 3"], edges: Int[Tensor, "e 2"]
) -> Float[Tensor, "t e 3"]:
    """Return the edges turned by the mean of the rotation matrices of their ends; differentiable once, in rotations.

    Args:
        quats: rotations of the nodes, as of `moved_points`.
        spans: edges at rest, from their first node to their second one.
        edges: nodes.
    """
    turned: Tensor = _TurnedEdges.apply(quats, _array(spans), _array(edges))
    return turned


def stretch_and_bend(
    quats: Float[Tensor, "t m 4"],
    shifts: Float[Tensor, "t m 3"],
    spans: Float[Tensor, "e 3"],
    lengths: Float[Tensor, " e"],
    edges: Int[Tensor, "e 2"],
    bending: float,
    softness: float,
    log_scale: float,
) -> Float[Tensor, ""]:
    """Return the energy of the edges, see `rigidity.edge_energy`; differentiable once, in rotations and shifts.

    Args:
        quats: rotations of the nodes, as of `moved_points`.
        shifts: of the nodes.
        spans: edges at rest, from their first node to their second one.
        lengths: of the edges at rest.
        edges: nodes.
        bending: weight of the bend.
        softness: norm of stretch or bend up to which the loss is quadratic; it is linear from there on.
        log_scale: norm from which it is logarithmic; 0: never.
    """
    given = _array(spans), _array(lengths), _array(edges)
    energy: Tensor = _StretchAndBend.apply(quats, shifts, given, (bending, softness, log_scale))
    return energy


class _MovedPoints(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, quats: Tensor, shifts: Tensor, *rest: np.ndarray) -> Tensor:
        ctx.given = _array(quats), *rest
        moved = np.empty((len(quats), len(rest[1]), 3), np.float32)
        _move_points(ctx.given[0], _array(shifts), *rest, moved)
        return torch.from_numpy(moved)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, incoming: Tensor) -> tuple[Tensor | None, ...]:
        quats, nodes = ctx.given[:2]
        slopes = np.empty_like(quats), np.empty((len(quats), *nodes.shape), np.float32)
        _move_points_back(*ctx.given, _array(incoming), *slopes)
        return *map(torch.from_numpy, slopes), None, None, None, None


class _TurnedEdges(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, quats: Tensor, spans: np.ndarray, edges: np.ndarray) -> Tensor:
        ctx.given = _array(quats), spans, edges
        turned = np.empty((len(quats), len(edges), 3), np.float32)
        _turn_edges(*ctx.given, turned)
        return torch.from_numpy(turned)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, incoming: Tensor) -> tuple[Tensor, None, None]:
        slopes = np.empty_like(ctx.given[0])
        _turn_edges_back(*ctx.given, _array(incoming), slopes)
        return torch.from_numpy(slopes), None, None


class _StretchAndBend(torch.autograd.Function):
    """The forward pass computes the gradient too, and the backward pass scales it."""

    @staticmethod
    def forward(
        ctx: Any, quats: Tensor, shifts: Tensor, rest: tuple[np.ndarray, ...], numbers: tuple[float, ...]
    ) -> Tensor:
        given = _array(quats), _array(shifts)
        slopes = tuple(np.empty_like(values) for values in given)
        ctx.slopes = tuple(map(torch.from_numpy, slopes))
        return quats.new_tensor(_stretch_and_bend(*given, *rest, *numbers, *slopes))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, incoming: Tensor) -> tuple[Tensor, Tensor, None, None]:
        turns, shifts = ctx.slopes
        return incoming * turns, incoming * shifts, None, None


def _array(values: Tensor) -> np.ndarray:
    return values.detach().contiguous().numpy()


@njit(**KERNEL)
@no_type_check
def _rotations(quats):
    """Return the rotation matrices of quaternions."""
    matrices = np.empty((len(quats), 3, 3), np.float32)
    for node in range(len(quats)):
        w, x, y, z = quats[node] / np.sqrt((quats[node] ** 2).sum())
        matrices[node, 0] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
        matrices[node, 1] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
        matrices[node, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return matrices


@njit(**KERNEL)
@no_type_check
def _quat_slopes(quats, g, slopes):
    """Store the gradient by quaternions of any norm, from that by their rotation matrices."""
    for node in range(len(quats)):
        norm = np.sqrt((quats[node] ** 2).sum())
        w, x, y, z = quats[node] / norm
        m = g[node]
        a, b, c = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
        d, e, f = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
        by_w = x * a + y * b + z * c
        by_x = w * a - 2 * x * (m[1, 1] + m[2, 2]) + y * d + z * e
        by_y = w * b + x * d - 2 * y * (m[0, 0] + m[2, 2]) + z * f
        by_z = w * c + x * e + y * f - 2 * z * (m[0, 0] + m[1, 1])
        along = w * by_w + x * by_x + y * by_y + z * by_z
        slopes[node, 0] = 2 * (by_w - w * along) / norm
        slopes[node, 1] = 2 * (by_x - x * along) / norm
        slopes[node, 2] = 2 * (by_y - y * along) / norm
        slopes[node, 3] = 2 * (by_z - z * along) / norm


@njit(**KERNEL)
@no_type_check
def _move_points(quats, shifts, nodes, rest, indices, weights, moved):
    for time in range(len(quats)):
        matrices = _rotations(quats[time])
        origins = nodes + shifts[time]  # less the turned nodes: x -> R x + origin
        for node in range(len(nodes)):
            for a in range(3):
                for b in range(3):
                    origins[node, a] -= matrices[node, a, b] * nodes[node, b]
        for v in range(len(rest)):
            for a in range(3):
                total = np.float32(0)
                for k in range(indices.shape[1]):
                    node = indices[v, k]
                    place = origins[node, a]
                    for b in range(3):
                        place += matrices[node, a, b] * rest[v, b]
                    total += weights[v, k] * place
                moved[time, v, a] = total


@njit(**KERNEL)
@no_type_check
def _move_points_back(quats, nodes, rest, indices, weights, incoming, by_quats, by_shifts):
    by_shifts[:] = 0
    for time in range(len(quats)):
        by_matrices = np.zeros((len(nodes), 3, 3), np.float32)
        for v in range(len(rest)):
            for k in range(indices.shape[1]):
                node = indices[v, k]
                for a in range(3):
                    force = weights[v, k] * incoming[time, v, a]
                    by_shifts[time, node, a] += force
                    for b in range(3):
                        by_matrices[node, a, b] += force * (rest[v, b] - nodes[node, b])
        _quat_slopes(quats[time], by_matrices, by_quats[time])


@njit(**KERNEL)
@no_type_check
def _turn_edges(quats, spans, edges, turned):
    for time in range(len(quats)):
        matrices = _rotations(quats[time])
        for edge in range(len(edges)):
            i, j = edges[edge]
            for a in range(3):
                total = np.float32(0)
                for b in range(3):
                    total += (matrices[i, a, b] + matrices[j, a, b]) * spans[edge, b]
                turned[time, edge, a] = total / 2


@njit(**KERNEL)
@no_type_check
def _turn_edges_back(quats, spans, edges, incoming, slopes):
    for time in range(len(quats)):
        by_matrices = np.zeros((quats.shape[1], 3, 3), np.float32)
        for edge in range(len(edges)):
            i, j = edges[edge]
            for a in range(3):
                for b in range(3):
                    slope = incoming[time, edge, a] * spans[edge, b] / 2
                    by_matrices[i, a, b] += slope
                    by_matrices[j, a, b] += slope
        _quat_slopes(quats[time], by_matrices, slopes[time])


@njit(**KERNEL)
@no_type_check
def _soft_norm(squares, softness, log_scale):
    """Return the robust loss of a vector, by its squared norm, and the factor from the vector to the gradient."""
    soft = np.sqrt(squares + softness * softness)
    loss = soft - softness
    if log_scale == 0:
        return loss, 1 / soft
    return log_scale * np.log1p(loss / log_scale), 1 / (soft * (1 + loss / log_scale))


@njit(**KERNEL)
@no_type_check
def _stretch_and_bend(quats, shifts, spans, lengths, edges, bending, softness, log_scale, by_quats, by_shifts):
    """Return the energy and store its gradient."""
    count, energy = len(quats) * len(edges), 0.0
    by_shifts[:] = 0
    for time in range(len(quats)):
        matrices, places = _rotations(quats[time]), shifts[time]
        by_matrices = np.zeros(matrices.shape, np.float32)
        stretch = np.empty(3)
        for edge in range(len(edges)):
            i, j = edges[edge]
            bent = 0.0
            for a in range(3):
                for b in range(3):
                    bent += (matrices[i, a, b] - matrices[j, a, b]) ** 2
            loss, slope = _soft_norm(bent, softness, log_scale)
            energy += bending * loss / count
            slope *= bending / count
            for a in range(3):
                for b in range(3):
                    bend = slope * (matrices[i, a, b] - matrices[j, a, b])
                    by_matrices[i, a, b] += bend
                    by_matrices[j, a, b] -= bend
            for node in (i, j):  # turned as either end turns
                stretched = 0.0
                for a in range(3):
                    turned = 0.0
                    for b in range(3):
                        turned += matrices[node, a, b] * spans[edge, b]
                    stretch[a] = (spans[edge, a] + places[j, a] - places[i, a] - turned) / lengths[edge]
                    stretched += stretch[a] ** 2
                loss, slope = _soft_norm(stretched, softness, log_scale)
                energy += loss / (2 * count)
                slope /= 2 * count * lengths[edge]
                for a in range(3):
                    pull = slope * stretch[a]
                    by_shifts[time, j, a] += pull
                    by_shifts[time, i, a] -= pull
                    for b in range(3):
                        by_matrices[node, a, b] -= pull * spans[edge, b]
        _quat_slopes(quats[time], by_matrices, by_quats[time])
    return energy
