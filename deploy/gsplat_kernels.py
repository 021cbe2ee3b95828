"""Compilation of gsplat's CUDA kernels into the installed package, as `gsplat.csrc`, which it looks for first.

    python deploy/gsplat_kernels.py

They are for the GPUs of this machine, or for those of $TORCH_CUDA_ARCH_LIST ("8.0 9.0"). The compiler is that of
$CUDA_HOME, else the one of NVIDIA's packages in the environment, whose version is that of torch's CUDA; g++ and ninja
must be on the PATH. Kernels that are there already for these versions and GPUs are kept.
"""

import os
import sys
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, files, version
from importlib.util import find_spec
from pathlib import Path
from shutil import which

import torch

STAMP = "csrc.txt"  # beside the kernels: what they were compiled for
COMPILER = "nvidia-cuda-nvcc"
SOURCES = ("csrc/*.cu", "csrc/*.cpp", "ext.cpp")


def main() -> int:
    """Compile, and return the exit status."""
    use_packaged_compiler()
    from torch.utils.cpp_extension import CUDA_HOME, load  # noqa: PLC0415 - reads $CUDA_HOME when imported

    spec, targets = find_spec("gsplat"), architectures()
    if spec is None or spec.origin is None:
        return refused("gsplat is not installed")
    if not targets:
        return refused("no GPU is visible; set TORCH_CUDA_ARCH_LIST, or set up again where the GPU is")
    if CUDA_HOME is None or which("g++") is None:
        return refused(f"{'nvcc' if CUDA_HOME is None else 'g++'} is missing")
    package = Path(spec.origin).parent
    stamp = f"gsplat {version('gsplat')}, torch {version('torch')}, GPUs {' '.join(targets)}\n"
    if (package / STAMP).exists() and (package / STAMP).read_text(encoding="utf-8") == stamp:
        return 0
    say(f"Compiling gsplat's kernels for GPUs of architecture {' '.join(targets)}: this takes minutes, once.")
    os.environ["TORCH_CUDA_ARCH_LIST"] = " ".join(targets)
    cuda = package / "cuda"
    load(
        name="csrc",
        sources=[str(path) for pattern in SOURCES for path in sorted(cuda.glob(pattern))],
        extra_cflags=["-O3", "-Wno-attributes"],
        extra_cuda_cflags=["-O3", "-use_fast_math"],
        extra_include_paths=[str(cuda / "include"), str(cuda / "csrc" / "third_party" / "glm")],
        build_directory=str(package),
    )
    for left in (*package.glob("*.o"), *package.glob(".ninja*"), package / "build.ninja"):
        left.unlink()
    (package / STAMP).write_text(stamp, encoding="utf-8")
    return 0


def architectures() -> Sequence[str]:
    """Return the GPU architectures to compile for, without repetition."""
    if given := os.environ.get("TORCH_CUDA_ARCH_LIST", "").replace(";", " ").split():
        return given
    count = torch.cuda.device_count()
    found = [torch.cuda.get_device_capability(index) for index in range(count)]
    return sorted({f"{major}.{minor}" for major, minor in found})


def use_packaged_compiler() -> None:
    """Point $CUDA_HOME, if it is not set, to NVIDIA's packages, with the names that linkers expect."""
    if os.environ.get("CUDA_HOME"):
        return
    try:
        found = [Path(str(path.locate())) for path in files(COMPILER) or () if path.parts[-2:] == ("bin", "nvcc")]
    except PackageNotFoundError:
        return
    if not found:
        return
    home = found[0].resolve().parents[1]
    for link, target in ((home / "lib64", "lib"), (home / "lib" / "libcudart.so", "libcudart.so.13")):
        if not link.exists():
            link.symlink_to(target)
    os.environ["CUDA_HOME"] = str(home)


def refused(why: str) -> int:
    """Say why nothing was compiled, and return the exit status."""
    say(f"gsplat's kernels were not compiled: {why}.")
    return 1


def say(sentence: str) -> None:
    """Write a line to standard error."""
    sys.stderr.write(f"{sentence}\n")


if __name__ == "__main__":
    sys.exit(main())
