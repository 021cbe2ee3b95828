import pytest
import torch

from dg4d_lib.devices import sent
from dg4d_lib.errors import BackendUnavailable
from dg4d_lib.rasterizer.interface import choose_rasterizer, device_of
from tests.emulation.gpu import Emulated


def test_what_is_there_is_not_copied() -> None:
    value = torch.rand(3)
    assert sent(value, torch.device("cpu")) is value


@pytest.mark.gpu
def test_a_gpu_gets_the_same_numbers() -> None:
    try:
        choose_rasterizer("cuda_gsplat")
    except BackendUnavailable as missing:
        pytest.skip(str(missing))
    value = torch.arange(6).reshape(2, 3).T
    there = sent(value, device_of("cuda_gsplat"))
    assert there.device.type == "cuda" and there.dtype == value.dtype
    assert torch.equal(there.cpu(), value)
    assert sent(there, there.device) is there


@pytest.mark.gpu
def test_nobody_waits_for_the_gpu(emulated_gpu: Emulated) -> None:
    device, before = device_of("cuda_gsplat"), emulated_gpu.waits.total()
    sent(torch.rand(3), device)
    assert emulated_gpu.waits.total() == before
    torch.rand(3).to(device)
    assert emulated_gpu.waits.total() == before + 1
