"""Asynchronous host-to-device copies."""

import torch
from torch import Tensor


def to_device_async(value: Tensor, device: torch.device) -> Tensor:
    """Copy a tensor to a device without waiting for the kernels that are queued there.

    A copy from pageable memory synchronizes with the GPU, one from pinned memory does not.
    """
    if device.type == "cuda" and value.device.type == "cpu":
        return value.detach().pin_memory().to(device, non_blocking=True)
    return value.to(device)
