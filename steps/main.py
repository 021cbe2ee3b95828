"""The entry point of every step: `python -m steps.main REQUEST.json RESULT.json [--store STORE] [--progress FILE]`.

Reads a StepRequest, writes a StepResult, or a StepFailure in its place. Progress goes to standard output as JSON lines,
{"done": 3, "total": 10, "values": {"loss": 0.1}}, and so does what the library has to say on its way, {"note": "..."};
everything else that is printed goes to standard error.

Exit status: 0 done · 65 bad input or settings, or no room: the same again will fail again · 69 something needed is
missing · 70 the optimization diverged · 75 the store does not answer at the moment · 137 out of memory · 1 anything
else, which may be tried again.

`$DG4D_CATALOG` ("module:name") names another catalog than `steps.catalog:STEPS`; `$DG4D_STORE` and `$DG4D_HOME` say
where the store is when `--store` is not given; `$DG4D_CODE_VERSION` stands for the digest of the source.
"""

import argparse
import ctypes
import functools
import hashlib
import importlib
import importlib.metadata
import importlib.util
import json
import logging
import os
import resource
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, TextIO

from pydantic import BaseModel, ValidationError

from dg4d_lib.diffusion.flop_counter import counting_flops
from dg4d_lib.errors import BackendUnavailable, BadInput, FitDiverged
from steps.contract import (
    EXIT_BAD_INPUT,
    EXIT_DONE,
    EXIT_MISSING,
    EXIT_OUT_OF_MEMORY,
    ArtifactRef,
    ProvenanceRecord,
    StepFailure,
    StepRequest,
    StepResult,
    StepSpec,
)
from steps.profiles import settings_class
from steps.runtime.environment_info import environment_info
from steps.runtime.job import Job, Progress, StepReport
from steps.runtime.weights import require_same
from steps.store.artifact_store import ArtifactMissing, ArtifactStore, StoreUnreachable
from steps.store.files import NO_SPACE, write_atomically
from steps.store.opening import open_store

EXIT_CRASHED = 1
EXIT_DIVERGED = 70
EXIT_UNREACHABLE = 75
EXIT_STATUS = {
    "bad_input": EXIT_BAD_INPUT,
    "missing": EXIT_MISSING,
    "lost": EXIT_MISSING,
    "unreachable": EXIT_UNREACHABLE,
    "diverged": EXIT_DIVERGED,
    "out_of_memory": EXIT_OUT_OF_MEMORY,
    "crashed": EXIT_CRASHED,
}
PROGRESS_EVERY_S = 0.2
M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_MAX = -1, -2, -4  # names of glibc's mallopt
PR_SET_PDEATHSIG = 1  # name of Linux's prctl

Kind = Literal["bad_input", "missing", "lost", "unreachable", "diverged", "out_of_memory", "crashed"]


def catalog() -> dict[str, StepSpec]:
    """Every step by name, without importing a step's code."""
    return dict(_named(os.environ.get("DG4D_CATALOG", "steps.catalog:STEPS")))


def code_version(spec: StepSpec) -> str:
    """Twelve digits that change with any source file of the library, of the steps, or of the step's own module.

    A process reads them once, for what it imported stays; a step in a process of its own refuses a request that was
    made for other code. An image in which the code cannot change may say `$DG4D_CODE_VERSION` instead, for example its
    own digest.
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


def request_version(spec: StepSpec) -> str:
    """What `StepRequest.version` should be for this step with the code that is installed here."""
    return f"{spec.version}+{code_version(spec)}"


def perform(
    request: StepRequest, store: ArtifactStore, progress: Progress | None = None
) -> tuple[StepResult | StepFailure, BaseException | None]:
    """Run one step in this process.

    Args:
        request: what to do.
        store: where its inputs are and its outputs go.
        progress: told how far the step is.

    Returns:
        The result and nothing, or why there is none and the error itself.
    """
    with tempfile.TemporaryDirectory(prefix="dg4d-step-", ignore_cleanup_errors=True) as folder:
        scratch = Path(folder)
        pictures = scratch / "pictures"
        try:
            pictures.mkdir()
            return _perform(request, store, progress or (lambda done, total, values: None), scratch), None
        except (Exception, SystemExit) as error:
            failure = StepFailure(
                step=request.step, kind=kind_of(error), message=_message(error), pictures=_kept(pictures, store)
            )
            return failure, error


def kind_of(error: BaseException) -> Kind:
    """Which of the contract's failures an exception is."""
    kind: Kind = "crashed"
    match error:
        case BadInput():
            kind = "bad_input"
        case OSError() if error.errno in NO_SPACE:
            kind = "bad_input"
        case StoreUnreachable():
            kind = "unreachable"
        case ArtifactMissing():
            kind = "lost"
        case BackendUnavailable():
            kind = "missing"
        case FitDiverged():
            kind = "diverged"
        case MemoryError():
            kind = "out_of_memory"
        case RuntimeError() if type(error).__name__ == "OutOfMemoryError" or "can't allocate memory" in str(error):
            kind = "out_of_memory"  # torch: CUDA, CPU
    return kind


def main(arguments: list[str] | None = None) -> int:
    """Run the step of a request file and write its result file; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m steps.main", description="Run one step: files in, files out.")
    parser.add_argument("request", type=Path, help="a StepRequest as JSON")
    parser.add_argument("result", type=Path, help="where to write the StepResult or StepFailure")
    parser.add_argument(
        "--store", help="of the artifacts: a folder or s3://BUCKET/PREFIX (default: $DG4D_STORE, else $DG4D_HOME/store)"
    )
    parser.add_argument("--progress", type=Path, help="write progress here instead of to standard output")
    parser.add_argument(
        "--parent", help="process without which this one should not live; -: whoever keeps standard input open"
    )
    given = parser.parse_args(arguments)
    if given.parent is not None:
        _die_with(given.parent)
    prepare_process()
    with _progress_file(given.progress) as file:
        try:
            request = StepRequest.model_validate_json(given.request.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, ValidationError) as trouble:
            failure = StepFailure(step="", kind="bad_input", message=f"{given.request} is not a StepRequest: {trouble}")
            return _finish(failure, None, given.result)
        _show(request.step)
        with notes_to(note_lines(file)):
            outcome, error = perform(request, open_store(given.store), progress_lines(file))
        return _finish(outcome, error, given.result)


@contextmanager
def notes_to(say: Callable[[str], None]) -> Iterator[None]:
    """Hand on what the library logs while the block runs, such as that kernels are being compiled."""
    handler = _Notes(logging.INFO)
    handler.say = say
    logger = logging.getLogger("dg4d_lib")
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)


class _Notes(logging.Handler):
    say: Callable[[str], None]

    def emit(self, record: logging.LogRecord) -> None:
        self.say(record.getMessage())


def progress_lines(file: TextIO) -> Progress:
    """A progress callback that writes JSON lines, a few per second, and always the last."""
    last = -PROGRESS_EVERY_S

    def report(done: int, total: int, values: dict[str, float]) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= PROGRESS_EVERY_S or done >= total:
            last = now
            numbers = {name: float(value) for name, value in values.items()}
            file.write(json.dumps({"done": int(done), "total": int(total), "values": numbers}) + "\n")
            file.flush()

    return report


def note_lines(file: TextIO) -> Callable[[str], None]:
    """Writes notes as JSON lines."""

    def say(text: str) -> None:
        file.write(json.dumps({"note": text}) + "\n")
        file.flush()

    return say


def _source_files() -> Iterator[tuple[str, Path]]:
    """Every source file of the library and the steps: its name, and where it is."""
    for package in ("dg4d_lib", "steps"):
        folder = Path(str(importlib.import_module(package).__file__)).parent
        for path in sorted(folder.rglob("*.py")):  # not what compilers leave beside them
            yield f"{package}/{path.relative_to(folder).as_posix()}", path


@functools.cache
def _source_digest() -> str:
    content = hashlib.sha256()
    for name, path in _source_files():
        content.update(f"{name}\0".encode() + path.read_bytes())
    return content.hexdigest()


def _perform(request: StepRequest, store: ArtifactStore, progress: Progress, scratch: Path) -> StepResult:
    started, start = datetime.now(UTC).isoformat(timespec="milliseconds"), time.perf_counter()
    busy = _cpu_seconds()
    spec = _checked_spec(request)
    code = code_version(spec)
    if request.version not in {spec.version, f"{spec.version}+{code}"}:
        raise BadInput(
            f"this request was made for version {request.version} of {spec.name} and the code here is "
            f"{spec.version}+{code}: the code changed in between; run the same command again"
        )
    require_same(request.weights)
    job = Job(
        inputs=_fetched_inputs(request, spec, store, scratch),
        outputs={name: scratch / "out" / f"{name}{port.suffix}" for name, port in spec.outputs.items()},
        settings=_checked_settings(request, spec),
        seed=request.seed,
        progress=progress,
        pictures=scratch / "pictures",
    )
    (scratch / "out").mkdir()
    run: Callable[[Job], StepReport] = _named(spec.entry)
    with counting_flops() as flops:
        facts = run(job)
    outputs = _stored_outputs(job, spec, store)
    record = ProvenanceRecord(
        step=spec.name,
        code_version=f"{_product_version()}+{code}",
        request_digest=request.digest(),
        inputs={name: ref.digest for name, ref in request.inputs.items()},
        outputs={name: ref.digest for name, ref in outputs.items()},
        settings=request.settings,
        seed=request.seed,
        backend=facts.backend,
        weights=facts.weights,
        licenses=facts.licenses,
        notes=facts.notes,
        run_notes=facts.run_notes,
        flops=flops,
        started=started,
        duration_s=round(time.perf_counter() - start, 3),
        cpu_s=round(_cpu_seconds() - busy, 3),
        peak_memory_mb=round(peak_memory_mb(), 1),
        machine=environment_info(),
    )
    return StepResult(outputs=outputs, provenance=record)


def _checked_spec(request: StepRequest) -> StepSpec:
    specs = catalog()
    if request.step not in specs:
        raise BadInput(f"unknown step {request.step!r}; there are: {', '.join(specs)}")
    spec = specs[request.step]
    needed = {name for name, port in spec.inputs.items() if not port.optional}
    if missing := sorted(needed - {spec.input_port(name) for name in request.inputs}):
        raise BadInput(f"{spec.name} needs the input {', '.join(missing)}")
    if unknown := sorted(name for name in request.inputs if not spec.input_port(name)):
        raise BadInput(f"{spec.name} has no input {', '.join(unknown)}; it has: {', '.join(spec.inputs)}")
    return spec


def _checked_settings(request: StepRequest, spec: StepSpec) -> BaseModel:
    try:
        return settings_class(spec).model_validate(request.settings)
    except ValidationError as error:
        lines = [f"{'.'.join(map(str, e['loc']))} = {e['input']!r}: {e['msg']}" for e in error.errors()]
        raise BadInput(f"settings of {spec.name} refused: {'; '.join(lines)}") from error


def _fetched_inputs(request: StepRequest, spec: StepSpec, store: ArtifactStore, scratch: Path) -> dict[str, Path]:
    folder = scratch / "in"
    folder.mkdir()
    paths = {name: folder / f"{name}{spec.inputs[spec.input_port(name)].suffix}" for name in request.inputs}
    for name, ref in request.inputs.items():
        store.get(ref, paths[name])
    return paths


def _stored_outputs(job: Job, spec: StepSpec, store: ArtifactStore) -> dict[str, ArtifactRef]:
    missing = [name for name, port in spec.outputs.items() if not port.optional and not job.outputs[name].is_file()]
    if missing:
        raise RuntimeError(f"{spec.name} ended without writing its output {', '.join(missing)}")
    return {
        name: store.put(job.outputs[name], port.media_type)
        for name, port in spec.outputs.items()
        if job.outputs[name].is_file()
    }


def _kept(pictures: Path, store: ArtifactStore) -> dict[str, ArtifactRef]:
    """The pictures that explain a failure, by name; as many as there is room for."""
    kept: dict[str, ArtifactRef] = {}
    try:
        for file in sorted(pictures.glob("*.png")):
            kept[file.stem] = store.put(file, "image/png")
    except (OSError, BadInput, StoreUnreachable):
        return kept
    return kept


def _message(error: BaseException) -> str:
    if isinstance(error, OSError) and error.errno in NO_SPACE:
        return "the disk is full: free some space and run the same command again; finished steps are kept"
    if kind_of(error) == "out_of_memory":
        said = f" ({error})" if str(error) else ""
        return f"memory ran out: end other programs, or choose smaller settings{said}"
    if kind_of(error) == "crashed":
        where = traceback.extract_tb(error.__traceback__)
        place = f" (at {Path(where[-1].filename).name}:{where[-1].lineno})" if where else ""
        return f"{type(error).__name__}: {error}{place}"
    return str(error) or type(error).__name__


def _finish(outcome: StepResult | StepFailure, error: BaseException | None, path: Path) -> int:
    if error is not None:
        traceback.print_exception(error)
    status = EXIT_DONE
    if isinstance(outcome, StepFailure):
        sys.stderr.write(outcome.message + "\n")
        status = EXIT_STATUS[outcome.kind]
    try:
        write_atomically(path, outcome.model_dump_json(indent=1))
    except (OSError, BadInput) as trouble:
        sys.stderr.write(f"{path} could not be written: {trouble}\n")
        return status or EXIT_STATUS[kind_of(trouble)]
    return status


def _named(name: str) -> Any:
    """The object that "module:name" says."""
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)


def _product_version() -> str:
    try:
        return importlib.metadata.version("dg4d")
    except importlib.metadata.PackageNotFoundError:
        return "0"


def _cpu_seconds() -> float:
    """What this process and those that it started, and that ended, have used of all cores."""
    used = (resource.getrusage(whose) for whose in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(times.ru_utime + times.ru_stime for times in used)


def peak_memory_mb() -> float:
    """The most memory this process ever held, in MiB."""
    try:  # Linux: of this program alone; getrusage also counts what the process was before it became this program
        status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
        return int(status.split("VmHWM:")[1].split()[0]) / 1024
    except (OSError, IndexError):
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / (1024 * 1024 if sys.platform == "darwin" else 1024)


def _progress_file(path: Path | None) -> TextIO:
    """Where progress goes; what else is printed to standard output, by C++ libraries too, goes to standard error."""
    if path is not None:
        return path.open("a", encoding="utf-8")
    sys.stdout.flush()
    own = os.dup(1)
    os.dup2(2, 1)
    return os.fdopen(own, "w", encoding="utf-8")


def prepare_process() -> None:
    """Set what has to be set before torch is imported."""
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # torch's threads would spin after every operation
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # NumPy's would spin too, and its matrices are small
    if not sys.platform.startswith("linux"):
        return
    try:  # keep freed memory: large temporaries would be mapped and unmapped at every operation
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):  # not glibc
        return
    mallopt(M_MMAP_MAX, 0)
    mallopt(M_TRIM_THRESHOLD, 2**31 - 1)
    mallopt(M_TOP_PAD, 256 * 2**20)


def _show(step: str) -> None:
    """Have `top` and `ps` say which step this process does."""
    with suppress(OSError):  # no Linux
        Path("/proc/self/comm").write_text(f"dg4d {step}", encoding="ascii")


def _die_with(parent: str) -> None:
    """Have this process end when its parent ends, however it ends."""
    if parent == "-":
        threading.Thread(target=_end_with_input, daemon=True).start()
        return
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != int(parent):  # it ended before we asked
        sys.exit(EXIT_CRASHED)


def _end_with_input() -> None:
    """The processes of a container end with its first, which is this one; a container's parent is no process in it."""
    while os.read(0, 1):
        pass
    os._exit(EXIT_CRASHED)


if __name__ == "__main__":
    sys.exit(main())
