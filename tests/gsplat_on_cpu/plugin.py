"""`pytest -p tests.gsplat_on_cpu.plugin`: the backend `cuda_gsplat` draws with gsplat's kernels on the processor."""

import os
import sys
import warnings
from importlib import import_module
from importlib.machinery import ExtensionFileLoader
from importlib.util import module_from_spec, spec_from_file_location
from types import ModuleType

import pytest

from tests.gsplat_on_cpu.build import ARITHMETICS, PACKAGES, library


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--arithmetic", choices=ARITHMETICS, default="fast", help="how gsplat's kernels round")


def pytest_configure(config: pytest.Config) -> None:
    """After `tests/conftest.py` has set the environment, so that torch is imported in it."""
    import torch

    path = library(config.getoption("arithmetic"))
    if not path.exists():
        raise pytest.UsageError(f"{path} is not there; make it with python -m tests.gsplat_on_cpu.build")
    sys.path.insert(0, str(PACKAGES))
    sys.modules["gsplat.csrc"] = loaded(str(path))
    with warnings.catch_warnings(action="ignore"):
        import_module("gsplat")

    from dg4d_lib.rasterizer import choice, cuda_gsplat, interface

    patch = pytest.MonkeyPatch()  # for the whole run
    patch.setattr(choice, "what_gsplat_lacks", lambda: "")
    patch.setattr(interface, "CUDA", None)  # the backend that asks for a device: none does
    patch.setattr(cuda_gsplat, "DEVICE", torch.device("cpu"))


def loaded(path: str) -> ModuleType:
    """The compiled kernels; those that are missing are looked for when they are called."""
    spec = spec_from_file_location("csrc", path, loader=ExtensionFileLoader("csrc", path))
    assert spec and spec.loader
    flags = sys.getdlopenflags()
    sys.setdlopenflags(os.RTLD_LAZY)
    try:
        module = module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        sys.setdlopenflags(flags)
    return module


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Tests that met no kernel prove nothing."""
    if session.testscollected and not launches():
        session.exitstatus = pytest.ExitCode.INTERNAL_ERROR


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    meaning = "" if launches() else ": nothing is proven"
    terminalreporter.write_line(f"gsplat's kernels were launched {launches()} times{meaning}")


def launches() -> int:
    return int(sys.modules["gsplat.csrc"].launches())
