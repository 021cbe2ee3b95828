"""Hardware, packages and weights of this machine, and the missing parts of each profile. Imports no torch."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from dg4d_lib.errors import BackendUnavailable
from dg4d_lib.rasterizer.backends import cuda_devices, cuda_driver_version, gsplat_unavailable_reason
from dg4d_lib.weights.locate import find_weights, folder_name
from dg4d_lib.weights.lock import read_lock
from dg4d_lib.weights.registry import lookup_weights
from steps.contract import Frozen
from steps.profiles import PROFILES
from steps.runtime.environment_info import processor
from steps.runtime.weights import weights_home, weights_in
from steps.store.files import home

NVIDIA_DRIVER = Path("/proc/driver/nvidia/version")
MEMORY = Path("/proc/meminfo")
TORCH_TIMEOUT_S = 120  # for the import of torch in a process of its own
CORE = ("torch", "numpy", "scipy", "numba", "av", "OpenImageIO", "PIL", "skimage", "trimesh", "xatlas", "pymeshlab")
NETWORKS = ("diffusers", "transformers", "accelerate", "safetensors")  # packages that profiles with weights need
SHOWN = ("torch", "gsplat", "diffusers", "transformers", "av")  # packages whose versions are shown
SETUP, SETUP_CUDA = "make setup", "make setup CUDA=1"
GIB = 2**30

State = Literal["ready", "slow", "missing"]
Kernels = Literal["compiled", "compiled at the first use", "not compiled: run `make setup CUDA=1`", "not installed"]


class Gpu(Frozen):
    """GPU of this machine.

    Attributes:
        name: of the model.
        memory_gib: in all.
    """

    name: str
    memory_gib: float


class Machine(Frozen):
    """Hardware and software of this machine.

    Attributes:
        processor: its model.
        cores: that this process may use.
        memory_gib: main memory.
        disk_free_gb: on the disk of the weights folder, units of 1e9 bytes.
        weights_folder: folder of all weights.
        home_problem: reason why the home folder cannot be used; empty if it can.
        python: version.
        packages: versions of some packages; empty if not installed.
        gpus: those that the CUDA driver shows.
        driver: version of NVIDIA's driver; empty without one.
        cuda: newest CUDA version that the driver supports; empty without one.
        gpu_problem: reason why the GPU cannot be used; empty if it can.
        gsplat_kernels: state of gsplat's CUDA kernels.
    """

    processor: str
    cores: int
    memory_gib: float
    disk_free_gb: float
    weights_folder: str
    home_problem: str
    python: str
    packages: dict[str, str]
    gpus: tuple[Gpu, ...]
    driver: str
    cuda: str
    gpu_problem: str
    gsplat_kernels: Kernels


class WeightsState(Frozen):
    """Presence of some weights.

    Attributes:
        name: in settings.
        state: presence on this machine.
        about_gb: size of the download, units of 1e9 bytes; None if unknown.
    """

    name: str
    state: Literal["here", "missing", "damaged"]
    about_gb: float | None


class Readiness(Frozen):
    """Needs of a profile on this machine.

    Attributes:
        profile: its name.
        state: slow: it can run, but its networks run on the processor, for days.
        gpu_gib: GPU memory that its settings plan for; 0 if it needs no GPU.
        weights: that it needs.
        lacks: what is missing, in words.
        command: gets all of it that a command can get; empty if nothing.
    """

    profile: str
    state: State
    gpu_gib: float
    weights: tuple[WeightsState, ...]
    lacks: tuple[str, ...]
    command: str

    @property
    def missing_gb(self) -> float:
        """Size of the missing weights, as far as it is known."""
        return sum(one.about_gb or 0.0 for one in self.weights if one.state != "here")


def examine_machine() -> Machine:
    """Examine the hardware and software of this machine; torch is started in another process, and only with a GPU."""
    gpus = tuple(Gpu(name=one.name, memory_gib=round(one.memory_bytes / GIB, 1)) for one in cuda_devices())
    folder = weights_home()
    return Machine(
        processor=processor(),
        cores=len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1,
        memory_gib=_memory_gib(),
        disk_free_gb=round(shutil.disk_usage(_existing(folder)).free / 1e9, 1),
        weights_folder=str(folder),
        home_problem=_home_problem(home()),
        python=sys.version.split()[0],
        packages={name: _version(name) for name in SHOWN},
        gpus=gpus,
        driver=_driver_version(),
        cuda=cuda_driver_version(),
        gpu_problem=_gpu_problem(bool(gpus)),
        gsplat_kernels=_gsplat_kernels(),
    )


def examine_profile(name: str, machine: Machine) -> Readiness:
    """Compare the needs of a profile with a machine."""
    tree = PROFILES[name].model_dump(mode="json")
    weights = tuple(_weights_state(one) for one in weights_in(tree))
    absent = [one for one in weights if one.state != "here"]
    packages = [package for package in (*CORE, *(NETWORKS if weights else ())) if find_spec(package) is None]
    no_gpu = bool(weights) and bool(machine.gpu_problem)
    size_gb = sum(one.about_gb or 0.0 for one in absent)
    lacks = [
        *([machine.home_problem] if machine.home_problem else []),
        *(f"package {package}" for package in packages),
        *(f"weights {one.name}" + (" (damaged)" if one.state == "damaged" else "") for one in absent),
        *([f"GPU: {machine.gpu_problem}"] if no_gpu else []),
        *(
            [f"disk: {size_gb:.1f} GB to get, {machine.disk_free_gb:g} GB free"]
            if size_gb > machine.disk_free_gb
            else []
        ),
    ]
    needs_setup = bool(packages) or (no_gpu and bool(machine.gpus))
    commands = [
        *([SETUP_CUDA if weights else SETUP] if needs_setup else []),
        *([f"dg4d weights pull {name}"] if absent else []),
    ]
    state: State = "missing" if packages or absent or machine.home_problem else "slow" if no_gpu else "ready"
    return Readiness(
        profile=name,
        state=state,
        gpu_gib=max(_values(tree, "memory_gb"), default=0.0) if weights else 0.0,
        weights=weights,
        lacks=tuple(lacks),
        command=" && ".join(commands),
    )


def _weights_state(name: str) -> WeightsState:
    entry, folder = lookup_weights(name), weights_home()
    state: Literal["here", "missing", "damaged"] = "here"
    try:
        find_weights(name, folder)
    except BackendUnavailable:
        begun = (folder / folder_name(entry)).exists()
        state = "damaged" if begun and entry.name in read_lock(folder) else "missing"
    return WeightsState(name=name, state=state, about_gb=entry.about_gb)


def _home_problem(folder: Path) -> str:
    existing = _existing(folder)
    if existing.is_dir() and os.access(existing, os.W_OK | os.X_OK):
        return ""
    return f"a home folder: {folder} cannot be written; name another in $DG4D_HOME"


def _existing(folder: Path) -> Path:
    """Return a folder, or the nearest parent that exists."""
    return next(path for path in (folder, *folder.parents) if path.exists())


def _gpu_problem(shown: bool) -> str:
    """Return why the GPU cannot be used; torch is asked in another process, because its import takes seconds."""
    if not shown:
        return "the CUDA driver shows no NVIDIA GPU"
    if _version("torch").endswith("+cpu"):
        return f"torch is its CPU build (run `{SETUP_CUDA}`)"
    if reason := gsplat_unavailable_reason():
        return reason
    program = "import torch; torch.cuda.init(); print(torch.cuda.device_count())"
    try:
        asked = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, timeout=TORCH_TIMEOUT_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"torch could not be asked ({type(error).__name__})"
    if asked.returncode == 0:
        return ""
    last = (asked.stderr.strip().splitlines() or ["no message"])[-1]
    return f"torch cannot use it: {last}; often the driver is older than torch's CUDA"


def _gsplat_kernels() -> Kernels:
    """Return the state of gsplat's kernels: in its wheel, in the cache of torch's extensions, or with a compiler."""
    spec = find_spec("gsplat")
    if spec is None or spec.origin is None:
        return "not installed"
    given = os.environ.get("TORCH_EXTENSIONS_DIR")
    cache = Path(given) if given else Path.home() / ".cache" / "torch_extensions"
    if any(Path(spec.origin).parent.glob("csrc*.so")) or any(cache.rglob("gsplat_cuda.so")):
        return "compiled"
    cuda_home = os.environ.get("CUDA_HOME")
    nvcc = shutil.which("nvcc") or (cuda_home and shutil.which("nvcc", path=str(Path(cuda_home) / "bin")))
    return "compiled at the first use" if nvcc and shutil.which("g++") else "not compiled: run `make setup CUDA=1`"


def _driver_version() -> str:
    try:
        found = re.search(r"\d+\.\d+(\.\d+)?", NVIDIA_DRIVER.read_text(encoding="utf-8", errors="replace"))
    except OSError:
        return ""
    return found.group() if found else ""


def _memory_gib() -> float:
    try:
        found = re.search(r"MemTotal:\s*(\d+) kB", MEMORY.read_text(encoding="utf-8"))
    except OSError:
        return 0.0
    return round(int(found.group(1)) / 2**20, 1) if found else 0.0


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def _values(tree: Mapping[str, Any], key: str) -> Iterator[float]:
    """Yield every value of a key in nested settings."""
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from _values(value, key)
        elif name == key:
            yield float(value)
