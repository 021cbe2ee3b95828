"""Loading of published checkpoints into networks of this project, which use their tensor names."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor, nn

from dg4d_lib.diffusion.components import Placement, frozen, read_tensors
from dg4d_lib.diffusion.flop_counter import attach_flop_counter
from dg4d_lib.errors import BadInput

Network = TypeVar("Network", bound=nn.Module)


def load_checkpoint(build: Callable[[dict[str, Tensor]], Network], file: Path, placement: Placement) -> Network:
    """Build a network and load the tensors of a file, frozen; extra tensors of the file are ignored.

    Args:
        build: creates the network for these tensors; called on the meta device.
        file: a safetensors file, or a pickle of tensors.
        placement: device, precision and memory format.

    Raises:
        BadInput: the file cannot be read, or tensors are missing or of another shape.
    """
    tensors = read_tensors(file)
    with torch.device("meta"):
        network = build(tensors)
    expected = {name: value.shape for name, value in network.state_dict().items()}
    wrong = [name for name, shape in expected.items() if name not in tensors or tensors[name].shape != shape]
    if wrong:
        raise BadInput(
            f"{file} does not match {type(network).__name__}: {len(wrong)} of its {len(expected)} tensors are missing "
            f"or of another shape, the first is {wrong[0]}"
        )
    network.load_state_dict({name: tensors[name].to(placement.dtype) for name in expected}, assign=True)
    loaded: Network = attach_flop_counter(frozen(network, placement))
    return loaded
