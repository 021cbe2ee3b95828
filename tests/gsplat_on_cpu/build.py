"""Compiles gsplat's CUDA kernels for the processor: `python -m tests.gsplat_on_cpu.build`, which `make gsplat` calls.

The sources are those of the wheel that `constraints.txt` names. What no C++ compiler reads of them is rewritten here,
`emulation.h` gives the rest a meaning; only what the adapter calls is compiled. Everything lies in `out/gsplat`.
"""

import argparse
import hashlib
import platform
import re
import shutil
import subprocess
import sys
import sysconfig
import time
import zipfile
from collections.abc import Sequence
from importlib.metadata import distribution
from pathlib import Path
from typing import NoReturn

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
OUT = ROOT / "out" / "gsplat"
PACKAGES = OUT / "packages"  # the unpacked wheel
SOURCES = OUT / "sources"  # rewritten
TORCH = Path(str(distribution("torch").locate_file("torch")))
LIBRARIES = ("torch_python", "torch", "torch_cpu", "c10")
LACKING = 69  # exit status: something is not here
DIGEST = "515a3773641f5e7f7717acab6276c0b1d6dbcad087b7968ca653337c3189a982"  # of the wheel that is rewritten, SHA-256

ARITHMETICS = {
    "fast": ["-march=native", "-ffp-contract=fast"],  # base 2 and fused products, as nvcc makes them
    "noise": ["-march=native", "-ffp-contract=fast", "-DNOISE"],  # the greatest errors that CUDA documents
    "strict": ["-ffp-contract=off", "-DSTRICT"],
}
# products are fused from -O2 on; setjmp moves between stacks, which fortified code takes for an error
FLAGS = ["-std=c++20", "-O2", "-fPIC", "-fvisibility=hidden", "-U_FORTIFY_SOURCE", "-w", "-pthread"]

KERNELS = (
    "ProjectionEWA3DGSFused.cu",
    "ProjectionEWASimple.cu",
    "QuatScaleToCovarCUDA.cu",
    "IntersectTile.cu",
    "RasterizeToPixels3DGSFwd.cu",
    "RasterizeToPixels3DGSBwd.cu",
)
CALLERS = ("Projection.cpp", "Rasterization.cpp", "Intersect.cpp", "QuatScaleToCovar.cpp")
OPERATORS = (
    "quat_scale_to_covar_preci_fwd",
    "quat_scale_to_covar_preci_bwd",
    "projection_ewa_simple_fwd",
    "projection_ewa_simple_bwd",
    "projection_ewa_3dgs_fused_fwd",
    "projection_ewa_3dgs_fused_bwd",
    "intersect_tile",
    "intersect_offset",
    "rasterize_to_pixels_3dgs_fwd",
    "rasterize_to_pixels_3dgs_bwd",
)

LAUNCH = r"(\w+(?:<[^<>;(){}]*>)?)\s*<<<([^<>]*)>>>\("
LAUNCHED = r"emulation::launch(\2, [](auto... given) { \1(given...); }, "
REWRITTEN = (  # file, pattern, replacement, how often
    ("include/Common.h", r"TORCH_CHECK\(x\.is_cuda\(\).*\)$", "", 1),
    *((f"csrc/{name}", LAUNCH, LAUNCHED, 1 if "Pixels" in name else 2) for name in KERNELS),
    *(
        (f"csrc/RasterizeToPixels3DGS{way}.cu", pattern, replacement, times)
        for way in ("Fwd", "Bwd")
        for pattern, replacement, times in (
            (r"extern __shared__ int s\[\];", "int *s = (int *)emulation::block.shared;", 1),
            (r"^__INS__\((?!(3|4)\)).*$", "", 17),  # channels: color, with depth
        )
    ),
    # conversions that end at the bounds of a type
    ("csrc/ProjectionEWA3DGSFused.cu", r"\(int32_t\)(radius_[xy]);", r"emulation::to_int32(\1);", 2),
    ("csrc/IntersectTile.cu", r"\(uint32_t\)((?:floor|ceil)\(tile_\w+ [-+] \w+\))", r"emulation::to_uint32(\1)", 4),
    # where a GPU rounds otherwise
    ("csrc/ProjectionEWA3DGSFused.cu", r"ceilf\(extend \* sqrtf\(", "ceilf(extend * emulation::root(", 2),
    ("csrc/RasterizeToPixels3DGSBwd.cu", r"1\.0f / \(1\.0f - alpha\)", "emulation::reciprocal(1.0f - alpha)", 1),
    ("include/Utils.cuh", r"float rz = 1\.f / z;", "float rz = emulation::reciprocal(z);", 2),
    (
        "csrc/third_party/glm/glm/detail/func_matrix.inl",
        r"(compute_inverse<2, 2, T, Q, Aligned>[^;]*)static_cast<T>\(1\) / \(",
        r"\1emulation::reciprocal(",
        1,
    ),
)
HEADERS = {  # that gsplat includes; what it wants of them is in emulation.h
    "cuda.h": "",
    "cuda_runtime.h": "",
    "cooperative_groups.h": "",
    "cooperative_groups/reduce.h": "",
    "cub/cub.cuh": "",
    "ATen/cuda/Atomic.cuh": "",
    "c10/cuda/CUDACachingAllocator.h": "",
    "c10/cuda/CUDAGuard.h": "#include <ATen/DeviceGuard.h>\n",
    "c10/cuda/CUDAStream.h": "",
}
BINDING = """
#include <torch/csrc/utils/pybind.h>
PYBIND11_MODULE(csrc, module) {
    py::enum_<gsplat::CameraModelType>(module, "CameraModelType")
        .value("PINHOLE", gsplat::CameraModelType::PINHOLE)
        .export_values();
    module.def("launches", [] { return emulation::launches; });
"""


def library(arithmetic: str) -> Path:
    """Where the compiled kernels lie."""
    return OUT / arithmetic / "csrc.so"


def build(arithmetic: str) -> None:
    """Fetch, rewrite and compile, unless the library was made of the same."""
    command, target = compiler(arithmetic), library(arithmetic)
    made_of, record = everything(command), target.with_suffix(".made_of")
    if target.exists() and PACKAGES.exists() and record.exists() and record.read_text() == made_of:
        return say(f"{target.relative_to(ROOT)} is there")
    start = time.monotonic()
    target.parent.mkdir(parents=True, exist_ok=True)
    record.unlink(missing_ok=True)
    fetch()
    rewrite()
    compile_kernels(command, target)
    record.write_text(made_of)
    return say(f"{target.relative_to(ROOT)} is made, {time.monotonic() - start:.0f} s")


def compiler(arithmetic: str) -> list[str]:
    """The command that compiles, without its files."""
    if platform.machine() not in ("x86_64", "AMD64"):
        lacking(f"the emulation is written for x86-64, and this is {platform.machine()}")
    found = shutil.which("g++")
    if found is None:
        lacking("g++ is not here (Debian: apt-get install g++)")
    python = Path(sysconfig.get_paths()["include"])
    if not (python / "Python.h").is_file():
        lacking(f"Python's headers are not in {python} (Debian: apt-get install python3-dev)")
    ours = (SOURCES / "headers", SOURCES / "include", SOURCES, SOURCES / "csrc" / "third_party" / "glm")
    theirs = (TORCH / "include", python)
    places = [*(f"-I{path}" for path in ours), *(f"-isystem{path}" for path in theirs)]
    return [found, *FLAGS, *ARITHMETICS[arithmetic], *places, "-include", str(HERE / "emulation.h")]


def everything(command: Sequence[str]) -> str:
    """A digest of what a library is made of."""
    files = (Path(__file__), HERE / "emulation.h", HERE / "emulation.cpp", ROOT / "constraints.txt")
    parts = [*(path.read_text() for path in files), distribution("torch").version, *command]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def fetch() -> None:
    """The pinned wheel, compared and unpacked."""
    pin = re.search(r"^gsplat==(\S+)$", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    assert pin, "constraints.txt pins no gsplat"
    wheel = OUT / f"gsplat-{pin[1]}-py3-none-any.whl"
    if not wheel.exists():
        say(f"fetching {wheel.name}")
        pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "download", "--quiet", "--no-deps"]
        done = subprocess.run([*pip, f"gsplat=={pin[1]}", "--dest", str(OUT)], check=False)
        if done.returncode or not wheel.exists():
            lacking(f"pip could not fetch {wheel.name} (see above); it takes the network, or a package index")
    if hashlib.sha256(wheel.read_bytes()).hexdigest() != DIGEST:
        sys.exit(
            f"gsplat: {wheel} is not the wheel whose sources are known here. If constraints.txt names another version, "
            f"give its digest in {Path(__file__).name}; if not, delete the file"
        )
    shutil.rmtree(PACKAGES, ignore_errors=True)
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(PACKAGES)


def rewrite() -> None:
    """gsplat's sources as C++, two that include the others, and the headers of CUDA that they ask for."""
    shutil.rmtree(SOURCES, ignore_errors=True)
    shutil.copytree(PACKAGES / "gsplat" / "cuda", SOURCES)
    for name, pattern, replacement, times in REWRITTEN:
        source = SOURCES / name
        known = source.read_text() if source.exists() else ""
        text, found = re.subn(pattern, replacement, known, flags=re.MULTILINE)
        if found != times:
            sys.exit(f"gsplat: {name} has {found} places like {pattern}, where {times} were known: look what changed")
        source.write_text(text)
    for name, text in HEADERS.items():
        header = SOURCES / "headers" / name
        header.parent.mkdir(parents=True, exist_ok=True)
        header.write_text(text)
    definitions = "".join(f'    module.def("{name}", &gsplat::{name});\n' for name in OPERATORS)
    (SOURCES / "kernels.cpp").write_text(including(KERNELS))
    (SOURCES / "callers.cpp").write_text(including(CALLERS) + BINDING + definitions + "}\n")


def including(names: Sequence[str]) -> str:
    """A source of nothing but others: their headers are read once."""
    return "".join(f'#include "csrc/{name}"\n' for name in names)


def compile_kernels(command: Sequence[str], target: Path) -> None:
    """All sources side by side, then the library."""
    say("compiling, half a minute on two cores")
    sources = (SOURCES / "callers.cpp", SOURCES / "kernels.cpp", HERE / "emulation.cpp")
    objects = [target.parent / f"{source.stem}.o" for source in sources]
    jobs = [
        subprocess.Popen([*command, "-c", str(source), "-o", str(made)])
        for source, made in zip(sources, objects, strict=True)
    ]
    if any([job.wait() for job in jobs]):
        sys.exit("gsplat: g++ could not compile its sources; the errors stand above")
    libraries = [f"-L{TORCH / 'lib'}", f"-Wl,-rpath,{TORCH / 'lib'}", *(f"-l{name}" for name in LIBRARIES)]
    # what is not compiled is looked for when it is called, which nothing does
    linked = subprocess.run(
        [command[0], "-shared", "-Wl,-z,lazy", "-o", str(target), *map(str, objects), *libraries], check=False
    )
    if linked.returncode:
        sys.exit("gsplat: the library could not be linked; the errors stand above")


def lacking(what: str) -> NoReturn:
    """End where this machine cannot do it: nothing is wrong with the project."""
    say(what)
    sys.exit(LACKING)


def say(text: str) -> None:
    """A line of progress."""
    sys.stdout.write(f"gsplat: {text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arithmetic", choices=ARITHMETICS, default="fast")
    build(parser.parse_args().arithmetic)
