"""Robust as-rigid-as-possible energy of a control graph (Sorkine and Alexa 2007)."""

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.fitting.flow_tracking import LOG_SCALE
from dg4d_lib.fitting.node_kernels import has_kernels, stretch_and_bend
from dg4d_lib.fitting.node_motion import NodeMotion
from dg4d_lib.geometry.quaternion import rotate
from dg4d_lib.mesh.models.control_graph import ControlGraph

ROBUST = 0.05  # relative stretch up to which the energy is quadratic


def edge_energy(motion: NodeMotion, graph: ControlGraph, bending: float, log: bool) -> Float[Tensor, ""]:
    """Return the mean over frames and edges of a robust loss of stretch and, weighted, of one of bend.

    An edge has two stretches, each relative to its length: what it differs by from the edge at rest, turned as one of
    its ends turns. Its bend is the difference of the rotation matrices of its ends.

    Args:
        motion: of the nodes.
        graph: with the edges.
        bending: weight of the bend.
        log: see `robust`.
    """
    if has_kernels(motion.quats):
        rest = graph.spans, graph.lengths, graph.edges
        return stretch_and_bend(motion.quats, motion.shifts, *rest, bending, ROBUST, LOG_SCALE if log else 0.0)
    turns = graph.at_ends(motion.matrices.flatten(2))
    first, second = graph.at_ends(motion.shifts)
    moved = graph.spans + second - first
    turned = [rotate(one.unflatten(-1, (3, 3)), graph.spans) for one in turns]
    stretch = torch.cat([(moved - span) / graph.lengths[:, None] for span in turned], 1)
    return robust(stretch, log).mean() + bending * robust(turns[0] - turns[1], log).mean()


def robust(values: Float[Tensor, "*b c"], log: bool) -> Float[Tensor, "*b"]:
    """Return a loss of stretch or bend that is quadratic for small and linear for large vectors, or logarithmic."""
    linear = (values.square().sum(-1) + ROBUST**2).sqrt() - ROBUST
    return LOG_SCALE * torch.log1p(linear / LOG_SCALE) if log else linear
