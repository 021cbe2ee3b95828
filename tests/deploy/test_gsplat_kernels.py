"""Compiling gsplat's kernels at setup: which compiler, for which GPUs, and when it is not done again."""

import importlib.util
import os
import re
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch
from torch.utils import cpp_extension

SCRIPT = Path(__file__).parents[2] / "deploy" / "gsplat_kernels.py"


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    """The script, with no compiler on the PATH and no GPU."""
    for name in ("CUDA_HOME", "TORCH_CUDA_ARCH_LIST"):
        monkeypatch.setenv(name, "")  # as unset, and restored whatever the script sets
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    spec = importlib.util.spec_from_file_location("gsplat_kernels", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def toolkit(script: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """NVIDIA's packages as they lie in an environment."""
    home = tmp_path / "site" / "nvidia" / "cu13"
    for name in ("bin/nvcc", "lib/libcudart.so.13"):
        (home / name).parent.mkdir(parents=True, exist_ok=True)
        (home / name).touch()

    class Packaged(PurePosixPath):
        def locate(self) -> Path:
            return home.parents[1] / str(self)

    monkeypatch.setattr(script, "files", lambda name: [Packaged("nvidia/cu13/bin/nvcc")])
    return home


@pytest.fixture
def compiled(script: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[dict[str, Any]]:
    """Record the calls of the compiler; g++ and gsplat count as installed."""
    package = tmp_path / "gsplat"
    for name in ("__init__.py", "cuda/ext.cpp", "cuda/csrc/Projection.cu", "cuda/csrc/Tiles.cpp"):
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / name).touch()
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "g++").write_text("#!/bin/sh\n")
    (tmp_path / "bin" / "g++").chmod(0o755)
    calls: list[dict[str, Any]] = []

    def load(**given: object) -> None:
        calls.append(given)
        (package / "build.ninja").touch()
        (package / "Projection.o").touch()

    monkeypatch.setattr(cpp_extension, "CUDA_HOME", "/cuda")
    monkeypatch.setattr(cpp_extension, "load", load)
    monkeypatch.setattr(script, "find_spec", lambda name: SimpleNamespace(origin=str(package / "__init__.py")))
    monkeypatch.setattr(script, "version", lambda name: "1")
    return calls


def test_the_packaged_compiler_is_used_where_none_is_named(script: ModuleType, toolkit: Path) -> None:
    script.use_packaged_compiler()
    assert os.environ["CUDA_HOME"] == str(toolkit)
    assert (toolkit / "lib64" / "libcudart.so").resolve() == toolkit / "lib" / "libcudart.so.13"
    os.environ["CUDA_HOME"] = ""
    script.use_packaged_compiler()  # links are there already


def test_a_toolkit_that_the_user_names_goes_first(
    script: ModuleType, toolkit: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CUDA_HOME", "/opt/cuda")
    script.use_packaged_compiler()
    assert os.environ["CUDA_HOME"] == "/opt/cuda"
    assert not (toolkit / "lib64").exists()


def without_gsplat(script: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(script, "find_spec", lambda name: None)


def without_gpu(script: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_CUDA_ARCH_LIST", "")


def without_nvcc(script: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cpp_extension, "CUDA_HOME", None)


def without_cxx(script: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")


@pytest.mark.parametrize(
    ("take_away", "named"),
    [
        (without_gsplat, "gsplat is not installed"),
        (without_gpu, "no GPU is visible; set TORCH_CUDA_ARCH_LIST"),
        (without_nvcc, "nvcc is missing"),
        (without_cxx, r"g\+\+ is missing"),
    ],
)
def test_what_is_missing_is_named(
    take_away: Callable[[ModuleType, pytest.MonkeyPatch], None], named: str, script: ModuleType,
    compiled: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setenv("TORCH_CUDA_ARCH_LIST", "9.0")
    take_away(script, monkeypatch)
    assert script.main() == 1
    assert not compiled
    assert re.search(named, capsys.readouterr().err)


def test_kernels_are_compiled_once_for_every_set_of_gpus(
    script: ModuleType, compiled: list[dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 3)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda index: [(9, 0), (8, 6), (9, 0)][index])
    assert script.main() == 0
    (given,) = compiled
    names = [Path(path).name for path in given["sources"]]
    assert names == ["Projection.cu", "Tiles.cpp", "ext.cpp"]
    assert given["name"] == "csrc"
    assert os.environ["TORCH_CUDA_ARCH_LIST"] == "8.6 9.0"
    assert {path.name for path in (tmp_path / "gsplat").iterdir()} == {"__init__.py", "cuda", "csrc.txt"}
    assert script.main() == 0
    assert len(compiled) == 1
    monkeypatch.setenv("TORCH_CUDA_ARCH_LIST", "8.6;9.0;12.0")
    assert script.main() == 0
    assert len(compiled) == 2
