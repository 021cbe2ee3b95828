"""Resolution of backend names, and messages for unavailable backends."""

import ctypes
import importlib.util

import pytest
import torch

from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.rasterizer import backends
from dg4d_lib.rasterizer.interface import get_rasterizer, preferred_device


class Driver:
    """A CUDA driver with some devices."""

    def __init__(self, devices: int, status: int = 0) -> None:
        self.devices, self.status = devices, status

    def cuInit(self, _flags: int) -> int:
        return self.status

    def cuDeviceGetCount(self, count) -> int:
        count._obj.value = self.devices
        return 0


@pytest.fixture
def machine(monkeypatch):
    """A machine with or without gsplat, a build of torch, a driver."""

    def make(gsplat: bool = True, torch_version: str = "2.13.0", driver: Driver | None = None) -> None:
        monkeypatch.setattr(backends, "find_spec", lambda name: object() if gsplat else None)
        monkeypatch.setattr(backends, "version", lambda name: torch_version)

        def load(name: str) -> Driver:
            if driver is None:
                raise OSError(f"{name}: cannot open shared object file")
            return driver

        monkeypatch.setattr(ctypes, "CDLL", load)

    return make


def test_auto_is_gsplat_where_everything_is_there(machine):
    machine(driver=Driver(1))
    assert backends.backend_name("auto") == "cuda_gsplat"
    assert preferred_device("auto") == preferred_device("cuda_gsplat") == torch.device("cuda")
    backends.require_backend("auto")
    backends.require_backend("cuda_gsplat")


@pytest.mark.parametrize(
    ("here", "lack"),
    [
        ({"gsplat": False, "driver": Driver(1)}, "make setup CUDA=1"),
        ({"torch_version": "2.13.0+cpu", "driver": Driver(1)}, "torch is its CPU build"),
        ({}, "shows no device"),
        ({"driver": Driver(0)}, "shows no device"),
        ({"driver": Driver(1, status=100)}, "shows no device"),
    ],
)
def test_auto_is_the_processor_elsewhere_and_gsplat_is_refused_with_the_reason(here, lack, machine):
    machine(**here)
    assert backends.backend_name("auto") == "cpu"
    assert preferred_device("auto") == torch.device("cpu")
    backends.require_backend("auto")
    with pytest.raises(BackendUnavailable, match="rasterizer 'cuda_gsplat' cannot run here") as caught:
        get_rasterizer("cuda_gsplat")
    assert lack in str(caught.value)
    assert "or choose rasterizer=cpu" in str(caught.value)


def test_a_gpu_that_torch_cannot_use_is_no_import_error(machine, monkeypatch):
    machine(driver=Driver(1))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(BackendUnavailable, match=r"torch .* cannot use the GPU"):
        get_rasterizer("auto")


def test_other_names_stand_for_themselves():
    assert [backends.backend_name(name) for name in ("reference", "cpu", "cuda_gsplat")] == [
        "reference",
        "cpu",
        "cuda_gsplat",
    ]


def test_here_auto_is_what_torch_says():
    here = importlib.util.find_spec("gsplat") is not None and torch.cuda.is_available()
    assert backends.backend_name("auto") == ("cuda_gsplat" if here else "cpu")


def test_an_unknown_rasterizer_is_refused():
    with pytest.raises(BadInput, match="auto, reference, cpu, cuda_gsplat"):
        get_rasterizer("magic")
