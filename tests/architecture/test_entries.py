"""The catalog of steps tells the truth about the code it names without importing it."""

import ast
import inspect
from importlib import import_module
from typing import Any, get_type_hints

import pytest
import repository

from steps.catalog import STEPS
from steps.contract import StepSpec
from steps.profiles import settings_class
from steps.runtime.job import Job, StepReport

SPECS = pytest.mark.parametrize("spec", STEPS.values(), ids=STEPS)


def named(entry: str) -> Any:
    module, _, attribute = entry.partition(":")
    return getattr(import_module(module), attribute)


def module_of(spec: StepSpec) -> str:
    return spec.entry.partition(":")[0].replace(".", "/") + ".py"


def ports_named(spec: StepSpec, side: str) -> set[str]:
    """The ports that a step's code reads from `job.inputs` or `job.outputs`: subscripts, `get`, and `in`."""
    found = set()
    for node in ast.walk(repository.tree(module_of(spec))):
        match node:
            case (
                ast.Subscript(value=ast.Attribute(ast.Name("job"), attr), slice=ast.Constant(str(port)))
                | ast.Call(ast.Attribute(ast.Attribute(ast.Name("job"), attr), "get"), [ast.Constant(str(port)), *_])
                | ast.Compare(ast.Constant(str(port)), [ast.In()], [ast.Attribute(ast.Name("job"), attr)])
            ) if attr == side:
                found.add(port)
    return found


@SPECS
def test_the_entry_is_a_function_of_a_job(spec: StepSpec) -> None:
    function = named(spec.entry)
    assert inspect.isfunction(function)
    hints = get_type_hints(function)
    assert hints.pop("return") is StepReport
    assert list(hints.values()) == [Job]


@SPECS
def test_the_settings_have_the_fields_that_the_code_reads_and_no_others(spec: StepSpec) -> None:
    nodes = list(ast.walk(repository.tree(module_of(spec))))
    names = {"job.settings"}  # and what it is assigned to as a whole
    names |= {
        ast.unparse(node.target) for node in nodes if isinstance(node, ast.AnnAssign) and _is_settings(node.value)
    }
    attributes = [node for node in nodes if isinstance(node, ast.Attribute)]
    fields = set(settings_class(spec).model_fields)
    assert {node.attr for node in attributes if _is_settings(node.value)} <= fields
    assert fields <= {node.attr for node in attributes if ast.unparse(node.value) in names}


def _is_settings(node: ast.AST | None) -> bool:
    return node is not None and ast.unparse(node) == "job.settings"


@SPECS
def test_a_step_is_called_as_its_module(spec: StepSpec) -> None:
    assert spec.entry == f"steps.{spec.name}:run"
    assert STEPS[spec.name] is spec


@SPECS
def test_a_step_reads_and_writes_its_ports_and_no_others(spec: StepSpec) -> None:
    words = {node.value for node in ast.walk(repository.tree(module_of(spec))) if isinstance(node, ast.Constant)}
    for side, ports in (("inputs", spec.inputs), ("outputs", spec.outputs)):
        assert ports_named(spec, side) <= set(ports)
        assert set(ports) <= words, f"steps/{spec.name}.py does not name all of its {side}"


@SPECS
def test_every_input_is_the_users_or_made_by_a_step_before(spec: StepSpec) -> None:
    order = list(STEPS.values())
    before = {name: port for other in order[: order.index(spec)] for name, port in other.outputs.items()}
    for name, port in spec.inputs.items():
        if name not in {"source", "text", "bank", "truth", "model", "mask", "depth", "layers", "views"}:
            assert before[name].media_type == port.media_type


def test_every_step_is_run_by_a_flow() -> None:
    words = {
        node.value
        for path in repository.modules("flows")
        for node in ast.walk(repository.tree(path))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    assert set(STEPS) <= words
