import platform
import socket
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from steps.contract import is_digest
from steps.runtime.environment_info import environment_info, installed_distributions


def test_a_machine_is_told_by_facts_and_names_nobody() -> None:
    facts = environment_info()
    assert facts["python"] == platform.python_version()
    assert int(facts["cores"]) >= 1
    assert is_digest(facts["packages"])
    assert facts["processor"]
    text = " ".join(facts.values())
    assert socket.gethostname() not in text
    assert str(Path.home()) not in text


def test_packages_are_those_that_are_installed() -> None:
    assert f"numpy-{__import__('numpy').__version__}" in installed_distributions()
    assert installed_distributions() == sorted(set(installed_distributions()))


def test_an_image_is_named_where_there_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "image" not in environment_info()
    monkeypatch.setenv("DG4D_IMAGE", "dg4d/cpu:1")
    assert environment_info()["image"] == "dg4d/cpu:1"


def test_a_gpu_is_named_only_if_it_was_used(monkeypatch: pytest.MonkeyPatch) -> None:
    used = False
    cuda = SimpleNamespace(is_initialized=lambda: used, get_device_name=lambda: "Abacus GPU")
    monkeypatch.setitem(sys.modules, "torch", SimpleNamespace(cuda=cuda))
    assert "gpu" not in environment_info()
    used = True
    assert environment_info()["gpu"] == "Abacus GPU"
