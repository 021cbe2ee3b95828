"""Choice and availability of rasterizer backends; imports no torch, so that flows can resolve `auto`."""

import ctypes
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec

from dg4d_lib.errors import BackendUnavailable

CPU, CUDA = "cpu", "cuda_gsplat"
CUDA_DRIVER = "libcuda.so.1"


def backend_name(name: str) -> str:
    """Resolve the name of a backend: `auto` is gsplat if it is available on this machine, else `cpu`."""
    if name != "auto":
        return name
    return CPU if gsplat_unavailable_reason() else CUDA


def require_backend(name: str) -> None:
    """Refuse a backend that is not available on this machine.

    Raises:
        BackendUnavailable: names the missing part and the remedy.
    """
    if backend_name(name) == CUDA and (reason := gsplat_unavailable_reason()):
        raise BackendUnavailable(f"rasterizer {CUDA!r} cannot run here: {reason}; or choose rasterizer={CPU}")


def gsplat_unavailable_reason() -> str:
    """Return why gsplat cannot run on this machine, with a remedy; empty if no reason is known."""
    if find_spec("gsplat") is None:
        return "gsplat is not installed (run `make setup CUDA=1`)"
    try:
        build = version("torch").partition("+")[2]
    except PackageNotFoundError:
        return "torch is not installed"
    if build == "cpu":
        return "torch is its CPU build (run `make setup CUDA=1`)"
    if not cuda_device_count():
        return "the CUDA driver shows no device (it needs an NVIDIA GPU, its driver, and no empty CUDA_VISIBLE_DEVICES)"
    return ""


@dataclass(frozen=True)
class CudaDevice:
    """GPU that the CUDA driver shows.

    Attributes:
        name: of the model.
        memory_bytes: in all.
    """

    name: str
    memory_bytes: int


def cuda_devices() -> list[CudaDevice]:
    """Return the GPUs that the CUDA driver shows to this process; empty without a driver."""
    count = cuda_device_count()
    if not count:
        return []
    driver, found = ctypes.CDLL(CUDA_DRIVER), []
    for index in range(count):
        handle, name, size = ctypes.c_int(), ctypes.create_string_buffer(256), ctypes.c_size_t()
        driver.cuDeviceGet(ctypes.byref(handle), index)
        driver.cuDeviceGetName(name, len(name), handle)
        driver.cuDeviceTotalMem_v2(ctypes.byref(size), handle)
        found.append(CudaDevice(name.value.decode(errors="replace"), size.value))
    return found


def cuda_driver_version() -> str:
    """Return the newest CUDA version that the driver supports, "13.0"; empty without a driver."""
    try:
        driver = ctypes.CDLL(CUDA_DRIVER)
    except OSError:
        return ""
    version = ctypes.c_int()
    driver.cuDriverGetVersion(ctypes.byref(version))
    return f"{version.value // 1000}.{version.value % 1000 // 10}"


def cuda_device_count() -> int:
    """Return the number of GPUs that the CUDA driver shows to this process; 0 without a driver."""
    try:
        driver = ctypes.CDLL(CUDA_DRIVER)
    except OSError:
        return 0
    count = ctypes.c_int()
    succeeded = driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0
    return count.value if succeeded else 0
