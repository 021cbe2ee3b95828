"""Between the processor and a GPU, which computes behind its back: whoever waits for it leaves it without work."""

import torch
from torch import Tensor


def to_device_async(value: Tensor, device: torch.device) -> Tensor:
    """The same numbers on a device, without waiting for what it still computes.

    An ordinary copy to a GPU waits for all that was asked of it before; one from pinned memory goes on by itself.
    """
    if device.type == "cuda" and value.device.type == "cpu":
        return value.detach().pin_memory().to(device, non_blocking=True)
    return value.to(device)
