"""Environment of a step: processor, system, Python packages and image, without names of hosts, users or paths."""

import functools
import os
import platform
import sys
from pathlib import Path
from typing import Any

from steps.contract import digest_of


def environment_info() -> dict[str, str]:
    """Return the environment of this process for the record of a step, without empty entries."""
    info = {
        "system": platform.platform(),
        "processor": processor(),
        "cores": str(_cores()),
        "gpu": _gpu(),
        "python": platform.python_version(),
        "packages": digest_of(installed_distributions()),
        "image": os.environ.get("DG4D_IMAGE", ""),
    }
    return {name: value for name, value in info.items() if value}


@functools.cache
def installed_distributions() -> list[str]:
    """Return every installed Python package as "name-version", sorted; folder names are faster than metadata."""
    folders = (Path(entry) for entry in sys.path)
    return sorted({found.stem for folder in folders if folder.is_dir() for found in folder.glob("*.dist-info")})


@functools.cache
def processor() -> str:
    """Return the model of the processor, or its architecture."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        text = ""
    models = [line.partition(":")[2].strip() for line in text.splitlines() if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


def _cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _gpu() -> str:
    """Return the GPU that this process used, without initializing CUDA."""
    torch: Any = sys.modules.get("torch")
    return str(torch.cuda.get_device_name()) if torch is not None and torch.cuda.is_initialized() else ""
