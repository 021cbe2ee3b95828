"""Small random network of the shape prior."""

import torch

from dg4d_lib.shape_prior.network import ShapePriorConfig, ShapePriorNetwork

TINY = ShapePriorConfig(widths=(8, 16, 32, 32), blocks=(1, 1, 1), layers=1, head=32)


def tiny_network(seed: int = 0) -> ShapePriorNetwork:
    """Return a network with random weights in all places."""
    torch.manual_seed(seed)
    made = ShapePriorNetwork(TINY)
    for parameter in made.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    return made.eval()
