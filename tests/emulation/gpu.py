"""A GPU that is none: torch has a CUDA device, on which gsplat's own kernels draw; the processor computes.

What lies on the device and what is computed there is as on a GPU, and whoever mixes tensors of the two is refused. To
run any program so: `python -m tests.emulation.gpu MODULE ARGUMENTS`, for example `benchmarks.paper_schedule --quick`.
"""

import ctypes
import os
import runpy
import sys
import warnings
from collections import Counter
from importlib import import_module
from importlib.machinery import ExtensionFileLoader
from importlib.util import module_from_spec, spec_from_file_location
from types import ModuleType, SimpleNamespace

from tests.emulation.build import PACKAGES, device, library

NAME = "an emulated GPU"
UNLIMITED = ctypes.c_size_t(-1).value
MEMORY_GIB = 80  # that it says it has


class Emulated:
    """The device of `device.cpp`."""

    def __init__(self, compiled: ctypes.CDLL, kernels: ModuleType) -> None:
        self._device, self._kernels = compiled, kernels
        compiled.device_waits.restype = ctypes.c_char_p
        compiled.device_computed.restype = ctypes.c_long
        compiled.device_peak.restype = ctypes.c_size_t
        compiled.device_memory.argtypes = [ctypes.c_size_t]

    @property
    def launches(self) -> int:
        """Of gsplat's kernels."""
        return int(self._kernels.launches())

    @property
    def computed(self) -> int:
        """How many operations torch did; each is a launch of a kernel or more."""
        return int(self._device.device_computed())

    @property
    def waits(self) -> Counter[str]:
        """How often the processor had to wait until the device was done, by reason.

        On a GPU the processor hands out work ahead of time; after each of these the GPU has nothing to do until more
        comes.
        """
        lines = (line.partition(" ") for line in self._device.device_waits().decode().splitlines())
        return Counter({reason: int(times) for times, _, reason in lines})

    @property
    def peak(self) -> int:
        """The most memory that tensors took since `has_memory`, bytes; a GPU's kernels take some for themselves."""
        return int(self._device.device_peak())

    def has_memory(self, limit: int = UNLIMITED) -> None:
        """Give it so many bytes; more is refused as torch refuses it."""
        self._device.device_memory(limit)


present: Emulated | None = None  # from `begin` on


def begin(arithmetic: str = "fast") -> Emulated:
    """Have a GPU until this process ends; torch, which asks once what there is, must not have been imported."""
    global present  # noqa: PLW0603 - there is one device for all
    if "torch" in sys.modules:
        raise RuntimeError("torch was imported before the emulated GPU was there")
    if not library(arithmetic).exists():
        raise RuntimeError(f"{library(arithmetic)} is not there; make it with python -m tests.emulation.build")
    os.environ.update(OMP_WAIT_POLICY="passive")
    compiled = ctypes.CDLL(str(device(arithmetic)))
    sys.path.insert(0, str(PACKAGES))
    sys.modules["gsplat.csrc"] = kernels = loaded(str(library(arithmetic)))
    with warnings.catch_warnings(action="ignore"):
        import_module("gsplat")
    present = Emulated(compiled, kernels)
    answer(present)
    return present


def answer(gpu: Emulated) -> None:
    """What Python asks of CUDA and of gsplat's surroundings."""
    import torch

    answers = {
        "_lazy_init": lambda: None,
        "current_device": lambda: 0,
        "device_count": lambda: 1,
        "empty_cache": lambda: None,
        "get_device_name": lambda device=None: NAME,
        "get_device_properties": lambda device=None: SimpleNamespace(name=NAME, total_memory=MEMORY_GIB << 30),
        "get_rng_state": lambda device=None: torch.get_rng_state(),  # it has no generator of its own
        "is_available": lambda: True,
        "is_initialized": lambda: True,
        "max_memory_allocated": lambda device=None: gpu.peak,
        "reset_peak_memory_stats": lambda device=None: gpu.has_memory(),
        "set_rng_state": lambda state, device=None: None,
        "synchronize": lambda device=None: None,
    }
    for name, told in answers.items():
        setattr(torch.cuda, name, told)

    from dg4d_lib.rasterizer import backends

    backends.gsplat_unavailable_reason = lambda: ""


def loaded(path: str) -> ModuleType:
    """The compiled kernels; those that are missing are looked for when they are called."""
    spec = spec_from_file_location("csrc", path, loader=ExtensionFileLoader("csrc", path))
    assert spec and spec.loader
    flags = sys.getdlopenflags()
    sys.setdlopenflags(os.RTLD_LAZY)
    try:
        module = module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        sys.setdlopenflags(flags)
    return module


if __name__ == "__main__":
    from tests.emulation.gpu import begin as begin_once  # as other modules know it

    begin_once()
    sys.argv = sys.argv[1:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
