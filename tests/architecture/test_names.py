"""Names and habits that a linter does not know."""

import ast
import re
import tomllib
from pathlib import PurePosixPath

import pytest
import repository

VAGUE = {"util", "utils", "common", "helper", "helpers", "base", "misc", "data", "process", "manager", "core"}
MOST_LINES = 500
BRITISH = re.compile(
    r"colour|normalis|initialis|optimis|serialis|visualis|discretis|parametris|minimis|maximis|organis|recognis|"
    r"centre|metre\b|neighbour|behaviour|favour|catalogue|artefact|modelling|labelled|licence|\bgrey",
    re.IGNORECASE,
)
MACHINE_PATH = re.compile(r"^(/(work|root|tmp|home|mnt|Users|opt)(/|$)|[A-Z]:\\)")

CODE = repository.modules(*repository.CODE)
PACKAGES = repository.modules(*repository.PACKAGES)


def vague(path: str) -> set[str]:
    """The parts of a path that name nothing."""
    return {PurePosixPath(part).stem for part in PurePosixPath(path).parts} & VAGUE


def machine_paths(source: ast.AST) -> list[str]:
    """String literals that begin with a place on one machine."""
    literals = [node.value for node in ast.walk(source) if isinstance(node, ast.Constant)]
    return [value for value in literals if isinstance(value, str) and MACHINE_PATH.match(value)]


def prints(source: ast.AST) -> list[int]:
    """Lines that call `print`."""
    calls = [node for node in ast.walk(source) if isinstance(node, ast.Call)]
    return [call.lineno for call in calls if isinstance(call.func, ast.Name) and call.func.id == "print"]


def postpones_annotations(source: ast.AST) -> bool:
    imports = [node for node in ast.walk(source) if isinstance(node, ast.ImportFrom)]
    return any(node.module == "__future__" and node.names[0].name == "annotations" for node in imports)


def test_there_is_code_to_look_at() -> None:
    assert len(PACKAGES) > 50
    assert {path.split("/")[0] for path in PACKAGES} == set(repository.PACKAGES)


@pytest.mark.parametrize("path", ["a/utils.py", "common/x.py", "a/helpers/b.py", "base.py"])
def test_a_vague_name_would_be_noticed(path: str) -> None:
    assert vague(path)


def test_every_module_has_a_name_that_says_something() -> None:
    assert not [path for path in CODE if vague(path)]


def test_no_file_is_too_long_to_read() -> None:
    lengths = {path: len(repository.text(path).splitlines()) for path in CODE}
    assert not {path: lines for path, lines in lengths.items() if lines > MOST_LINES}


def test_annotations_are_real() -> None:
    assert postpones_annotations(ast.parse("from __future__ import annotations"))
    assert not [path for path in CODE if postpones_annotations(repository.tree(path))]


def test_the_product_does_not_print() -> None:
    assert prints(ast.parse("x = 1\nprint(x)")) == [2]
    assert not {path: lines for path in PACKAGES if (lines := prints(repository.tree(path)))}


def test_spelling_is_american() -> None:
    documents = [path for path in repository.files() if path.endswith((".md", ".toml", ".sh", ".yaml"))]
    found = {
        f"{path}:{number}": words
        for path in [*CODE, *documents]
        if path != "tests/architecture/test_names.py"
        for number, line in enumerate(repository.text(path).splitlines(), 1)
        if (words := BRITISH.findall(line))
    }
    assert not found


@pytest.mark.parametrize("literal", ["/tmp/x", "/work", "/root/a", "C:\\\\x"])
def test_a_path_of_one_machine_would_be_noticed(literal: str) -> None:
    assert machine_paths(ast.parse(f"x = '{literal}'"))


def test_no_path_of_one_machine_is_in_the_product() -> None:
    product = [*PACKAGES, *repository.modules("examples", "benchmarks", "experiments")]
    found = {path: literals for path in product if (literals := machine_paths(repository.tree(path)))}
    assert found == {"flows/engine/containers.py": ["/tmp"]}  # a folder in a container, not on a machine


def test_every_module_says_what_it_is() -> None:
    assert not [path for path in PACKAGES if not ast.get_docstring(repository.tree(path))]


def test_every_package_of_the_library_stands_in_the_layers() -> None:
    contracts = tomllib.loads(repository.text("pyproject.toml"))["tool"]["importlinter"]["contracts"]
    lines = next(contract["layers"] for contract in contracts if contract.get("containers") == ["dg4d_lib"])
    layers = [name.strip() for line in lines for name in line.split("|")]
    children = {PurePosixPath(path).parts[1].removesuffix(".py") for path in repository.modules("dg4d_lib")}
    assert sorted(layers) == sorted(children - {"__init__"})


def test_tests_lie_where_their_subject_lies() -> None:
    tests = [PurePosixPath(path) for path in repository.modules("tests")]
    places = {path.parent.relative_to("tests").as_posix() for path in tests if path.name.startswith("test_")}
    folders = {PurePosixPath(path).parent.as_posix() for path in CODE}
    assert places - {"architecture", "clients", "deploy", "hostile"} <= folders


def test_no_two_test_files_share_a_name() -> None:
    names = [PurePosixPath(path).name for path in repository.modules("tests") if "conftest" not in path]
    assert not {name for name in names if names.count(name) > 1}
