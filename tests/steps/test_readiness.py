"""Facts about a machine, and what profiles lack there."""

import ctypes
from pathlib import Path
from typing import Any

import pytest

from dg4d_lib.rasterizer import backends
from dg4d_lib.weights.locate import digests
from dg4d_lib.weights.lock import LockedFile, LockEntry, write_lock
from dg4d_lib.weights.registry import KNOWN
from steps.profiles import PROFILES
from steps.runtime import readiness
from steps.runtime.readiness import Gpu, Machine, examine_machine, examine_profile
from steps.runtime.weights import weights_in

MACHINE = Machine(
    processor="some", cores=2, memory_gib=16, disk_free_gb=100, weights_folder="w", home_problem="",
    python="3.11", packages={},
    gpus=(Gpu(name="A100", memory_gib=79.2),), driver="580.1", cuda="13.0", gpu_problem="", gsplat_kernels="compiled",
)  # fmt: skip


@pytest.fixture(autouse=True)
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DG4D_WEIGHTS", str(tmp_path / "weights"))
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    return tmp_path / "weights"


def pulled(home: Path, name: str) -> Path:
    folder = home / name
    for part in KNOWN[name].parts:
        (folder / part).mkdir(parents=True)
        (folder / part / "model.safetensors").write_bytes(b"tensors of " + part.encode())
    files = {
        path: LockedFile(sha256=digest, size=(folder / path).stat().st_size) for path, digest in digests(folder).items()
    }
    write_lock(home, name, LockEntry(hub_id=KNOWN[name].hub_id, revision="c" * 40, files=files))
    return folder


def test_the_preview_is_ready_on_any_machine() -> None:
    found = examine_profile("preview", MACHINE.model_copy(update={"gpus": (), "gpu_problem": "none"}))
    assert (found.state, found.lacks, found.command, found.gpu_gib) == ("ready", (), "", 0)


def test_without_a_folder_that_can_be_written_nothing_is_ready(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "file" / "home"))
    found = examine_profile("preview", examine_machine())
    assert found.state == "missing"
    assert found.lacks == (f"a home folder: {tmp_path}/file/home cannot be written; name another in $DG4D_HOME",)


@pytest.mark.parametrize("name", sorted(set(PROFILES) - {"preview"}))
def test_a_profile_lacks_the_weights_that_it_names_and_one_command_gets_them(name: str) -> None:
    found = examine_profile(name, MACHINE)
    named = list(weights_in(PROFILES[name].model_dump(mode="json")))
    assert [one.name for one in found.weights] == named and len(named) > 1
    assert found.lacks == tuple(f"weights {one}" for one in named)
    assert (found.state, found.command, found.gpu_gib) == ("missing", f"dg4d weights pull {name}", 24)
    assert found.missing_gb == pytest.approx(sum(KNOWN[one].about_gb or 0 for one in named))


def test_with_weights_a_gpu_makes_it_ready_and_a_processor_slow(weights: Path) -> None:
    folders = [pulled(weights, name) for name in ("svd", "zero123-xl")]
    assert examine_profile("paper", MACHINE).state == "ready"
    alone = examine_profile("paper", MACHINE.model_copy(update={"gpus": (), "gpu_problem": "no GPU"}))
    assert (alone.state, alone.lacks, alone.command) == ("slow", ("GPU: no GPU",), "")
    (folders[0] / "vae" / "model.safetensors").write_bytes(b"cut")
    cut = examine_profile("paper", MACHINE)
    assert (cut.state, cut.lacks) == ("missing", ("weights svd (damaged)",))


def test_a_gpu_without_its_packages_needs_the_set_up_too(monkeypatch: pytest.MonkeyPatch) -> None:
    cpu = MACHINE.model_copy(update={"gpu_problem": "torch is its CPU build"})
    assert examine_profile("paper", cpu).command == "make setup CUDA=1 && dg4d weights pull paper"
    known = readiness.find_spec
    monkeypatch.setattr(readiness, "find_spec", lambda name: None if name in ("av", "diffusers") else known(name))
    assert examine_profile("preview", MACHINE).command == "make setup"
    found = examine_profile("paper", MACHINE)
    assert {"package av", "package diffusers"} < set(found.lacks)
    assert found.command == "make setup CUDA=1 && dg4d weights pull paper"


def test_a_disk_too_small_for_the_weights_is_named() -> None:
    small = examine_profile("paper", MACHINE.model_copy(update={"disk_free_gb": 3.0}))
    assert "disk: 7.0 GB to get, 3 GB free" in small.lacks


class Driver:
    """The calls of libcuda that are used, for one GPU."""

    def cuInit(self, flags: int) -> int:
        return 0

    def cuDeviceGetCount(self, count: Any) -> int:
        count._obj.value = 1
        return 0

    def cuDeviceGet(self, handle: Any, index: int) -> int:
        handle._obj.value = 40 + index
        return 0

    def cuDeviceGetName(self, name: Any, length: int, handle: Any) -> int:
        assert handle.value == 40 and length == 256
        name.value = b"NVIDIA L4"
        return 0

    def cuDeviceTotalMem_v2(self, size: Any, handle: Any) -> int:
        size._obj.value = 23 * 2**30
        return 0

    def cuDriverGetVersion(self, version: Any) -> int:
        version._obj.value = 13010
        return 0


def test_the_driver_is_asked_for_name_and_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ctypes, "CDLL", lambda name: Driver())
    assert backends.cuda_devices() == [backends.CudaDevice("NVIDIA L4", 23 * 2**30)]
    assert backends.cuda_driver_version() == "13.1"
    machine = examine_machine()
    assert machine.gpus == (Gpu(name="NVIDIA L4", memory_gib=23.0),)
    assert machine.gpu_problem  # the test environment has torch's CPU build, or no gsplat


def test_without_a_driver_there_is_no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise OSError(name)

    monkeypatch.setattr(ctypes, "CDLL", missing)
    assert (backends.cuda_devices(), backends.cuda_driver_version()) == ([], "")
    machine = examine_machine()
    assert machine.gpus == () and "shows no NVIDIA GPU" in machine.gpu_problem
    assert machine.cores >= 1 and machine.memory_gib > 0 and machine.disk_free_gb > 0


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("NVRM version: NVIDIA UNIX x86_64 Kernel Module  550.54.14  Thu Feb 22 01:44:30 UTC 2024\n", "550.54.14"),
        ("NVRM version: NVIDIA UNIX Open Kernel Module for x86_64  580.65.06  Release Build\n", "580.65.06"),
        ("something else\n", ""),
    ],
)
def test_the_version_of_the_driver_is_read(text: str, found: str, tmp_path: Path, monkeypatch: Any) -> None:
    (tmp_path / "version").write_text(text)
    monkeypatch.setattr(readiness, "NVIDIA_DRIVER", tmp_path / "version")
    assert readiness._driver_version() == found


def test_kernels_are_in_the_wheel_in_the_cache_or_need_a_compiler(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "gsplat"
    package.mkdir()
    (package / "__init__.py").write_text("raise ImportError('must not be imported')")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    monkeypatch.delenv("CUDA_HOME", raising=False)
    assert readiness._gsplat_kernels() == "not compiled: run `make setup CUDA=1`"
    (tmp_path / "bin").mkdir()
    for name in ("nvcc", "g++"):
        (tmp_path / "bin" / name).write_text("#!/bin/sh\n")
        (tmp_path / "bin" / name).chmod(0o755)
    assert readiness._gsplat_kernels() == "compiled at the first use"
    (tmp_path / "cache" / "gsplat_cuda").mkdir(parents=True)
    (tmp_path / "cache" / "gsplat_cuda" / "gsplat_cuda.so").write_bytes(b"")
    assert readiness._gsplat_kernels() == "compiled"
