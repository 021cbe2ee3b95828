"""Which backend `auto` is on this machine; told without torch, so that a request can name its backend."""

import ctypes
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec

from dg4d_lib.errors import BackendUnavailable

PROCESSOR, CUDA = "cpu", "cuda_gsplat"
CUDA_DRIVER = "libcuda.so.1"


def backend_name(name: str) -> str:
    """The backend that this name stands for here: `auto` is gsplat where nothing keeps it from drawing, else `cpu`."""
    if name != "auto":
        return name
    return PROCESSOR if gsplat_unavailable_reason() else CUDA


def require_backend(name: str) -> None:
    """Refuse a backend that cannot draw here.

    Raises:
        BackendUnavailable: says what is missing and what gets it.
    """
    if backend_name(name) == CUDA and (lack := gsplat_unavailable_reason()):
        raise BackendUnavailable(f"rasterizer {CUDA!r} cannot run here: {lack}; or choose rasterizer={PROCESSOR}")


def gsplat_unavailable_reason() -> str:
    """What keeps gsplat from drawing here, and what mends it; empty where nothing is known to."""
    if find_spec("gsplat") is None:
        return "gsplat is not installed (run `make setup CUDA=1`)"
    try:
        build = version("torch").partition("+")[2]
    except PackageNotFoundError:
        return "torch is not installed"
    if build == "cpu":
        return "torch is its CPU build (run `make setup CUDA=1`)"
    if not cuda_device_count():
        return "the CUDA driver shows no device (it takes an NVIDIA GPU, its driver, and no empty CUDA_VISIBLE_DEVICES)"
    return ""


def cuda_device_count() -> int:
    """How many GPUs the CUDA driver shows to this process; 0 where there is no driver."""
    try:
        driver = ctypes.CDLL(CUDA_DRIVER)
    except OSError:
        return 0
    count = ctypes.c_int()
    started = driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0
    return count.value if started else 0
