"""The catalog of steps tells the truth about the code it names without importing it."""

import ast
import inspect
from importlib import import_module
from typing import Any, get_type_hints

import pytest
import repository

from dg4d_lib.settings import Settings
from steps.catalog import STEPS
from steps.contract import StepSpec
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
def test_the_settings_are_a_settings_class(spec: StepSpec) -> None:
    assert issubclass(named(spec.settings), Settings)


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
        if name not in {"source", "text", "bank", "truth"}:
            assert before[name].media_type == port.media_type


def test_every_step_is_run_by_a_flow() -> None:
    words = {
        node.value
        for path in repository.modules("flows")
        for node in ast.walk(repository.tree(path))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    assert set(STEPS) <= words
