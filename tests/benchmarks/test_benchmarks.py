"""Benchmarks are run by hand; what they use of the product must still be there."""

import importlib
from pathlib import Path

import pytest

import benchmarks

NAMES = sorted(path.stem for path in Path(benchmarks.__path__[0]).glob("[!_]*.py"))


@pytest.mark.parametrize("name", NAMES)
def test_a_benchmark_finds_what_it_uses(name: str) -> None:
    module = importlib.import_module(f"benchmarks.{name}")
    source = Path(str(module.__file__)).read_text(encoding="utf-8")
    assert ('__name__ == "__main__"' in source) == hasattr(module, "main")
