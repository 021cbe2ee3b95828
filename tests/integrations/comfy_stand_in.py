"""Stand-in for ComfyUI: the modules that nodes import, its loader of custom nodes, and its executor.

It follows ComfyUI 0.3.64 in what nodes see of it: `load_custom_node` of nodes.py, `validate_inputs` and `execute` of
execution.py, `ProgressBar` of comfy/utils.py, the interrupt of comfy/model_management.py, and the folders of
folder_paths.py. Outputs are lists, links are [node, output], one call per entry of the longest list.
"""

import importlib.util
import inspect
import os
import sys
import types
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

Prompt = dict[str, dict[str, Any]]


class InterruptProcessingException(Exception):
    """The user interrupted the prompt."""


class Comfy:
    """Running ComfyUI: what was reported to it, and its interrupt."""

    def __init__(self, output: Path) -> None:
        self.output = output
        self.reported: list[tuple[int, int]] = []
        self.interrupt_when: Callable[[], bool] = lambda: False
        self.classes: dict[str, type] = {}
        self.cache: dict[Any, list[Any]] = {}

    def modules(self) -> dict[str, types.ModuleType]:
        """Return the modules that nodes import."""
        reported = self.reported

        class ProgressBar:
            def __init__(self, total: int, node_id: str | None = None) -> None:
                self.total, self.current = total, 0

            def update_absolute(self, value: int, total: int | None = None, preview: Any = None) -> None:
                self.total = self.total if total is None else total
                self.current = min(value, self.total)
                reported.append((self.current, self.total))

        def throw_exception_if_processing_interrupted() -> None:
            if self.interrupt_when():
                raise InterruptProcessingException

        def get_save_image_path(prefix: str, folder: str, *_: int) -> tuple[str, str, int, str, str]:
            subfolder, name = os.path.split(os.path.normpath(prefix))
            target = Path(folder, subfolder)
            if os.path.commonpath((folder, str(target.resolve()))) != folder:
                raise Exception("Saving image outside the output folder is not allowed.")
            target.mkdir(parents=True, exist_ok=True)
            numbers = [
                int(entry.name[len(name) + 1 :].split("_")[0] or 0)
                for entry in target.iterdir()
                if entry.name.startswith(f"{name}_")
            ]
            return str(target), name, max(numbers, default=0) + 1, subfolder, prefix

        modules = {
            name: types.ModuleType(name) for name in ("comfy", "comfy.utils", "comfy.model_management", "folder_paths")
        }
        vars(modules["comfy.utils"])["ProgressBar"] = ProgressBar
        vars(modules["comfy.model_management"]).update(
            throw_exception_if_processing_interrupted=throw_exception_if_processing_interrupted,
            InterruptProcessingException=InterruptProcessingException,
        )
        vars(modules["folder_paths"]).update(
            get_output_directory=lambda: str(self.output), get_save_image_path=get_save_image_path
        )
        vars(modules["comfy"]).update(utils=modules["comfy.utils"], model_management=modules["comfy.model_management"])
        return modules

    def load_custom_node(self, folder: Path) -> types.ModuleType:
        """Import a folder of nodes under its path as the name, and keep its classes."""
        name = str(folder).replace(".", "_x_")
        spec = importlib.util.spec_from_file_location(name, folder / "__init__.py")
        assert spec and spec.loader
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        spec.loader.exec_module(module)
        for key, node in module.NODE_CLASS_MAPPINGS.items():
            self.classes.setdefault(key, node)
        return module

    def validate(self, prompt: Prompt) -> list[str]:
        """Return the errors of a prompt as `validate_prompt` words them."""
        return [f"{key}: {error}" for key, node in prompt.items() for error in self._errors(prompt, node)]

    def _errors(self, prompt: Prompt, node: dict[str, Any]) -> Iterator[str]:
        if node["class_type"] not in self.classes:
            yield f"node {node['class_type']} does not exist"
            return
        kind = self.classes[node["class_type"]]
        types_ = kind.INPUT_TYPES()  # type: ignore[attr-defined]  # by contract
        declared = {**types_["required"], **types_.get("optional", {})}
        yield from (f"Required input is missing: {name}" for name in types_["required"] if name not in node["inputs"])
        check = getattr(kind, "VALIDATE_INPUTS", None)
        checked = set(inspect.getfullargspec(check).args) - {"cls"} if check else set()
        for name, value in node["inputs"].items():
            if name not in declared:
                continue
            wanted, options = declared[name][0], (*declared[name], {})[1]
            if isinstance(value, list):
                source = self.classes.get(prompt[value[0]]["class_type"])
                if source is None:
                    continue  # its own error says so
                received = source.RETURN_TYPES[value[1]]  # type: ignore[attr-defined]  # by contract
                if received != wanted:
                    yield f"Return type mismatch between linked nodes: {name}, {received} != {wanted}"
            elif isinstance(wanted, list):
                if value not in wanted and name not in checked:
                    yield f"Value not in list: {name}: {value!r}"
            elif wanted in ("INT", "FLOAT") and not options.get("min", value) <= value <= options.get("max", value):
                yield f"Value out of range: {name}: {value}"
        if check:
            given = {name: None if isinstance(value, list) else value for name, value in node["inputs"].items()}
            answer = check(**{name: value for name, value in given.items() if name in checked})
            if answer is not True:
                yield from (f"Custom validation failed for node: {name} - {answer}" for name in sorted(checked))

    def execute(self, prompt: Prompt) -> dict[str, Any]:
        """Run the output nodes of a prompt; return what they send to the page, by node."""
        errors = self.validate(prompt)
        if errors:
            raise ValueError("\n".join(errors))
        shown: dict[str, Any] = {}
        with torch.inference_mode():
            for key, node in prompt.items():
                if getattr(self.classes[node["class_type"]], "OUTPUT_NODE", False):
                    self._outputs(prompt, key, shown)
        return shown

    def _outputs(self, prompt: Prompt, key: str, shown: dict[str, Any]) -> list[Any]:
        node = prompt[key]
        kind: Any = self.classes[node["class_type"]]
        given: dict[str, list[Any]] = {}
        for name, value in node["inputs"].items():
            given[name] = self._outputs(prompt, value[0], shown)[value[1]] if isinstance(value, list) else [value]
        constants = {k: None if isinstance(v, list) else v for k, v in node["inputs"].items()}
        changed = kind.IS_CHANGED(**constants) if hasattr(kind, "IS_CHANGED") else False
        signature = (key, node["class_type"], changed, repr(self._signature(prompt, key)))
        if signature not in self.cache:
            calls = max((len(values) for values in given.values()), default=1)
            results = []
            for k in range(calls):
                arguments = {name: values[min(k, len(values) - 1)] for name, values in given.items()}
                result = getattr(kind(), kind.FUNCTION)(**arguments)
                if isinstance(result, dict):
                    shown[key] = result["ui"]
                    result = result.get("result", ())
                assert isinstance(result, tuple) and len(result) == len(kind.RETURN_TYPES)
                results.append(result)
            self.cache[signature] = [[one[i] for one in results] for i in range(len(kind.RETURN_TYPES))]
        return self.cache[signature]

    def _signature(self, prompt: Prompt, key: str) -> Any:
        inputs = prompt[key]["inputs"]
        return [
            (name, self._signature(prompt, value[0]) if isinstance(value, list) else value)
            for name, value in sorted(inputs.items())
        ]


@contextmanager
def running(output: Path) -> Iterator[Comfy]:
    """Yield a ComfyUI whose modules can be imported meanwhile."""
    comfy, before = Comfy(output), dict(sys.modules)
    sys.modules.update(comfy.modules())
    try:
        yield comfy
    finally:
        for name in set(sys.modules) - set(before):
            if name.startswith(("comfy", "folder_paths", str(Path(__file__).parents[2]).replace(".", "_x_"))):
                del sys.modules[name]
