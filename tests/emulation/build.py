"""Compiles a GPU and gsplat's kernels for the processor: `python -m tests.emulation.build`, called by `make emulation`.

The GPU is `device.cpp`. The kernels are those of the wheel that `deploy/locks/cuda.txt` names: what no C++ compiler
reads of their sources is rewritten here, `emulation.h` gives the rest a meaning; only what the adapter calls is
compiled. Everything lies in `out/emulation`.
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
OUT = ROOT / "out" / "emulation"
LOCK = ROOT / "deploy" / "locks" / "cuda.txt"
PACKAGES = OUT / "packages"  # the unpacked wheel
SOURCES = OUT / "sources"  # rewritten
TORCH = Path(str(distribution("torch").locate_file("torch")))
DEVICE_LIBRARIES = ("torch", "torch_cpu", "c10")
LIBRARIES = ("torch_python", *DEVICE_LIBRARIES)
OURS = ("device.cpp", "emulation.h", "fibers.cpp")
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


def device(arithmetic: str) -> Path:
    """Where the compiled GPU lies."""
    return library(arithmetic).with_name("device.so")


def build(arithmetic: str) -> None:
    """Fetch, rewrite and compile, unless the library was made of the same."""
    command, options, target = compiler(), kernel_options(arithmetic), library(arithmetic)
    made_of, record = everything([*command, *options]), target.with_suffix(".made_of")
    if target.exists() and PACKAGES.exists() and record.exists() and record.read_text() == made_of:
        return say(f"{target.relative_to(ROOT)} is there")
    start = time.monotonic()
    target.parent.mkdir(parents=True, exist_ok=True)
    record.unlink(missing_ok=True)
    fetch()
    rewrite()
    compile_all(command, options, target.parent)
    record.write_text(made_of)
    return say(f"{target.relative_to(ROOT)} is made, {time.monotonic() - start:.0f} s")


def compiler() -> list[str]:
    """The command that compiles, without its files."""
    if platform.machine() not in ("x86_64", "AMD64"):
        lacking(f"the emulation is written for x86-64, and this is {platform.machine()}")
    if (TORCH / "lib" / "libtorch_cuda.so").exists():
        lacking("torch is its build for CUDA, which has devices of its own: python -m pytest -m gpu runs on a GPU")
    found = shutil.which("g++")
    if found is None:
        lacking("g++ is not here (Debian: apt-get install g++)")
    python = Path(sysconfig.get_paths()["include"])
    if not (python / "Python.h").is_file():
        lacking(f"Python's headers are not in {python} (Debian: apt-get install python3-dev)")
    return [found, *FLAGS, *(f"-isystem{path}" for path in (TORCH / "include", python))]


def kernel_options(arithmetic: str) -> list[str]:
    """What the kernels' sources are compiled with besides."""
    places = (SOURCES / "headers", SOURCES / "include", SOURCES, SOURCES / "csrc" / "third_party" / "glm")
    return [*ARITHMETICS[arithmetic], *(f"-I{path}" for path in places), "-include", str(HERE / "emulation.h")]


def everything(command: Sequence[str]) -> str:
    """A digest of what a library is made of."""
    files = (Path(__file__), *(HERE / name for name in OURS))
    parts = [*(path.read_text() for path in files), pinned_version(), distribution("torch").version, *command]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def pinned_version() -> str:
    """Return the locked version of gsplat."""
    pin = re.search(r"^gsplat==(\S+)", LOCK.read_text(), re.MULTILINE)
    assert pin, f"{LOCK} does not lock gsplat"
    return pin[1]


def fetch() -> None:
    """Download the locked wheel, compare its digest and unpack it."""
    version = pinned_version()
    wheel = OUT / f"gsplat-{version}-py3-none-any.whl"
    if not wheel.exists():
        say(f"fetching {wheel.name}")
        pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "download", "--quiet", "--no-deps"]
        only = ["--only-binary", ":all:", f"gsplat=={version}", "--dest", str(OUT)]
        done = subprocess.run([*pip, *only], check=False)
        if done.returncode or not wheel.exists():
            lacking(f"pip could not fetch {wheel.name} (see above); it takes the network, or a package index")
    if hashlib.sha256(wheel.read_bytes()).hexdigest() != DIGEST:
        sys.exit(
            f"emulation: {wheel} is not the wheel whose sources are known here. If {LOCK.name} names another "
            f"version, give its digest in {Path(__file__).name}; if not, delete the file"
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
            sys.exit(
                f"emulation: {name} has {found} places like {pattern}, where {times} were known: look what changed"
            )
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


def compile_all(command: Sequence[str], options: Sequence[str], target: Path) -> None:
    """All sources side by side, then the libraries."""
    say("compiling, three quarters of a minute on two cores")
    kernels = [SOURCES / "callers.cpp", SOURCES / "kernels.cpp", HERE / "fibers.cpp"]
    jobs = {
        source: subprocess.Popen([*command, *given, "-c", str(source), "-o", str(target / f"{source.stem}.o")])
        for given, sources in ((options, kernels), ((), [HERE / "device.cpp"]))
        for source in sources
    }
    if any([job.wait() for job in jobs.values()]):
        sys.exit("emulation: g++ could not compile its sources; the errors stand above")
    # what is not compiled is looked for when it is called, which nothing does
    link(target / "csrc.so", kernels, LIBRARIES, "-Wl,-z,lazy")
    link(target / "device.so", [HERE / "device.cpp"], DEVICE_LIBRARIES)


def link(library: Path, sources: Sequence[Path], names: Sequence[str], *options: str) -> None:
    """A shared library of what was compiled from some sources."""
    objects = [str(library.with_name(f"{source.stem}.o")) for source in sources]
    libraries = [f"-L{TORCH / 'lib'}", f"-Wl,-rpath,{TORCH / 'lib'}", *(f"-l{name}" for name in names)]
    linked = subprocess.run(["g++", "-shared", *options, "-o", str(library), *objects, *libraries], check=False)
    if linked.returncode:
        sys.exit(f"emulation: {library.name} could not be linked; the errors stand above")


def lacking(what: str) -> NoReturn:
    """End where this machine cannot do it: nothing is wrong with the project."""
    say(what)
    sys.exit(LACKING)


def say(text: str) -> None:
    """A line of progress."""
    sys.stdout.write(f"emulation: {text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arithmetic", choices=ARITHMETICS, default="fast")
    build(parser.parse_args().arithmetic)
