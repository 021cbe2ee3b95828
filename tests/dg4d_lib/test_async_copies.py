import pytest
import torch

from dg4d_lib.devices import to_device_async
from tests.emulation.gpu import Emulated

GPU = torch.device("cuda")


def test_what_is_there_is_not_copied() -> None:
    value = torch.rand(3)
    assert to_device_async(value, torch.device("cpu")) is value


@pytest.mark.gpu
def test_a_gpu_gets_the_same_numbers() -> None:
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    value = torch.arange(6).reshape(2, 3).T
    there = to_device_async(value, GPU)
    assert there.device.type == "cuda" and there.dtype == value.dtype
    assert torch.equal(there.cpu(), value)
    assert to_device_async(there, there.device) is there


@pytest.mark.gpu
def test_nobody_waits_for_the_gpu(emulated_gpu: Emulated) -> None:
    before = emulated_gpu.waits.total()
    to_device_async(torch.rand(3), GPU)
    assert emulated_gpu.waits.total() == before
    torch.rand(3).to(GPU)
    assert emulated_gpu.waits.total() == before + 1
