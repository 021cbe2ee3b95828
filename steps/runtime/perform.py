"""Execution of one step request in this process."""

import importlib.metadata
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from pydantic import BaseModel, ValidationError

from dg4d_lib.diffusion.flop_counter import count_flops
from dg4d_lib.errors import BadInput
from steps.contract import (
    ArtifactRef,
    ProvenanceRecord,
    StepFailure,
    StepRequest,
    StepResult,
    StepSpec,
    load_object,
    settings_errors,
)
from steps.profiles import settings_class
from steps.runtime.environment_info import environment_info
from steps.runtime.failures import failure_kind, failure_message
from steps.runtime.installed_code import catalog, code_version
from steps.runtime.job import Draw, Job, Progress, StepReport, ignore
from steps.runtime.process_setup import cpu_seconds, peak_memory_mb
from steps.runtime.weights import check_unchanged
from steps.store.artifact_store import ArtifactStore, StoreUnreachable


def perform(
    request: StepRequest,
    store: ArtifactStore,
    progress: Progress | None = None,
    show: Callable[[Draw], None] = ignore,
) -> tuple[StepResult | StepFailure, BaseException | None]:
    """Run one step in this process.

    Args:
        request: step, inputs, settings and seed.
        store: source of its inputs and destination of its outputs.
        progress: callback of the step's progress.
        show: callback for pictures of the work so far.

    Returns:
        The result and None, or the failure and its exception.
    """
    with tempfile.TemporaryDirectory(prefix="dg4d-step-", ignore_cleanup_errors=True) as folder:
        scratch = Path(folder)
        pictures = scratch / "pictures"
        try:
            pictures.mkdir()
            return _perform(request, store, progress or (lambda done, total, values: None), show, scratch), None
        except (Exception, SystemExit) as error:
            failure = StepFailure(
                step=request.step,
                kind=failure_kind(error),
                message=failure_message(error),
                pictures=_store_pictures(pictures, store),
            )
            return failure, error


def _perform(
    request: StepRequest, store: ArtifactStore, progress: Progress, show: Callable[[Draw], None], scratch: Path
) -> StepResult:
    started, start = datetime.now(UTC).isoformat(timespec="milliseconds"), time.perf_counter()
    cpu_before = cpu_seconds()
    spec = _checked_spec(request)
    code = code_version(spec)
    if request.version not in {spec.version, f"{spec.version}+{code}"}:
        raise BadInput(
            f"this request was made for version {request.version} of {spec.name} and the code here is "
            f"{spec.version}+{code}: the code changed in between; run the same command again"
        )
    check_unchanged(request.weights)
    job = Job(
        inputs=_fetch_inputs(request, spec, store, scratch),
        outputs={name: scratch / "out" / f"{name}{port.suffix}" for name, port in spec.outputs.items()},
        settings=_checked_settings(request, spec),
        seed=request.seed,
        progress=progress,
        pictures=scratch / "pictures",
        show=show,
    )
    (scratch / "out").mkdir()
    run: Callable[[Job], StepReport] = load_object(spec.entry)
    with count_flops() as flops:
        report = run(job)
    outputs = _store_outputs(job, spec, store)
    record = ProvenanceRecord(
        step=spec.name,
        code_version=f"{importlib.metadata.version('dg4d')}+{code}",
        request_digest=request.digest(),
        inputs={name: ref.digest for name, ref in request.inputs.items()},
        outputs={name: ref.digest for name, ref in outputs.items()},
        settings=request.settings,
        seed=request.seed,
        flops=flops,
        started=started,
        duration_s=round(time.perf_counter() - start, 3),
        cpu_s=round(cpu_seconds() - cpu_before, 3),
        peak_memory_mb=round(peak_memory_mb(), 1),
        machine=environment_info(),
        **vars(report),
    )
    return StepResult(outputs=outputs, provenance=record)


def _checked_spec(request: StepRequest) -> StepSpec:
    """Return the spec of the requested step after a check of the input names."""
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
    """Return the request's settings as an instance of the step's settings class."""
    try:
        return settings_class(spec).model_validate(request.settings)
    except ValidationError as error:
        raise BadInput(f"settings of {spec.name} refused: {settings_errors(error, request.settings)}") from error


def _fetch_inputs(request: StepRequest, spec: StepSpec, store: ArtifactStore, scratch: Path) -> dict[str, Path]:
    """Copy the inputs out of the store and return their paths by name."""
    folder = scratch / "in"
    folder.mkdir()
    paths = {name: folder / f"{name}{spec.inputs[spec.input_port(name)].suffix}" for name in request.inputs}
    for name, ref in request.inputs.items():
        store.get(ref, paths[name])
    return paths


def _store_outputs(job: Job, spec: StepSpec, store: ArtifactStore) -> dict[str, ArtifactRef]:
    """Put the outputs into the store and return their references by name."""
    missing = [name for name, port in spec.outputs.items() if not port.optional and not job.outputs[name].is_file()]
    if missing:
        raise RuntimeError(f"{spec.name} ended without writing its output {', '.join(missing)}")
    return {
        name: store.put(job.outputs[name], port.media_type)
        for name, port in spec.outputs.items()
        if job.outputs[name].is_file()
    }


def _store_pictures(pictures: Path, store: ArtifactStore) -> dict[str, ArtifactRef]:
    """Put pictures that explain a failure into the store, as many as fit, and return their references by name."""
    stored: dict[str, ArtifactRef] = {}
    with suppress(OSError, BadInput, StoreUnreachable):
        for file in sorted(pictures.glob("*.png")):
            stored[file.stem] = store.put(file, "image/png")
    return stored
