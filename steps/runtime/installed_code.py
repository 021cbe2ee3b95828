"""Catalog and source code of the steps that are installed here."""

import functools
import hashlib
import importlib
import importlib.util
import os
from collections.abc import Iterator
from pathlib import Path

from steps.contract import StepSpec, load_object


def catalog() -> dict[str, StepSpec]:
    """Return every step by name, without importing a step's code."""
    return dict(load_object(os.environ.get("DG4D_CATALOG", "steps.catalog:STEPS")))


def request_version(spec: StepSpec) -> str:
    """Return `StepRequest.version` of this step for the code that is installed here."""
    return f"{spec.version}+{code_version(spec)}"


def code_version(spec: StepSpec) -> str:
    """Return twelve hex digits that change with any source file of the library, the steps, or the step's own module.

    Files are read once per process, as imported code does not change either; a step in another process refuses a
    request that was made for other code. `$DG4D_CODE_VERSION` replaces the digest, for images with fixed code.
    """
    if fixed := os.environ.get("DG4D_CODE_VERSION"):
        return fixed
    content = hashlib.sha256(_source_digest().encode())
    module = spec.entry.partition(":")[0]
    if module.partition(".")[0] not in {"dg4d_lib", "steps"}:
        found = importlib.util.find_spec(module)
        if found is not None and found.origin is not None:
            content.update(Path(found.origin).read_bytes())
    return content.hexdigest()[:12]


@functools.cache
def _source_digest() -> str:
    content = hashlib.sha256()
    for name, path in _source_files():
        content.update(f"{name}\0".encode() + path.read_bytes())
    return content.hexdigest()


def _source_files() -> Iterator[tuple[str, Path]]:
    """Yield name and path of every source file of the library and the steps, without compiled files beside them."""
    for package in ("dg4d_lib", "steps"):
        folder = Path(str(importlib.import_module(package).__file__)).parent
        for path in sorted(folder.rglob("*.py")):
            yield f"{package}/{path.relative_to(folder).as_posix()}", path
