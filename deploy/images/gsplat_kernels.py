"""Compiles gsplat's CUDA kernels into the installed package, as `gsplat.csrc`, which it looks for first."""

from importlib.util import find_spec
from pathlib import Path

from torch.utils.cpp_extension import load

package = Path(str(find_spec("gsplat").origin)).parent
cuda = package / "cuda"
load(
    name="csrc",
    sources=[str(path) for pattern in ("csrc/*.cu", "csrc/*.cpp", "ext.cpp") for path in sorted(cuda.glob(pattern))],
    extra_cflags=["-O3", "-Wno-attributes"],
    extra_cuda_cflags=["-O3", "-use_fast_math"],
    extra_include_paths=[str(cuda / "include"), str(cuda / "csrc" / "third_party" / "glm")],
    build_directory=str(package),
)
for left in (*package.glob("*.o"), *package.glob(".ninja*"), package / "build.ninja"):
    left.unlink()
