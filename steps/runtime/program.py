"""Program that performs the step of a request file and writes its result file (`python -m steps.main`)."""

import argparse
import sys
import traceback
from pathlib import Path

from pydantic import ValidationError

from dg4d_lib.errors import BadInput
from steps.contract import EXIT_DONE, EXIT_STATUS, StepFailure, StepRequest, StepResult
from steps.runtime.failures import failure_kind
from steps.runtime.messages import note_lines, notes_to, picture_lines, progress_file, progress_lines
from steps.runtime.perform import perform
from steps.runtime.process_setup import die_with, prepare_process, set_process_name
from steps.store.files import write_atomically
from steps.store.opening import open_store


def main(arguments: list[str] | None = None) -> int:
    """Run the step of a request file and write its result file; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m steps.main", description="Run one step: files in, files out.")
    parser.add_argument("request", type=Path, help="a StepRequest as JSON")
    parser.add_argument("result", type=Path, help="where to write the StepResult or StepFailure")
    parser.add_argument(
        "--store", help="artifact store: a folder or s3://BUCKET/PREFIX (default: $DG4D_STORE, else $DG4D_HOME/store)"
    )
    parser.add_argument("--progress", type=Path, help="write progress here instead of to standard output")
    parser.add_argument(
        "--parent", help="exit with this process id; -: exit when standard input is closed (inside containers)"
    )
    given = parser.parse_args(arguments)
    if given.parent is not None:
        die_with(given.parent)
    prepare_process()
    with progress_file(given.progress) as file:
        try:
            request = StepRequest.model_validate_json(given.request.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, ValidationError) as trouble:
            failure = StepFailure(step="", kind="bad_input", message=f"{given.request} is not a StepRequest: {trouble}")
            return _finish(failure, None, given.result)
        set_process_name(f"dg4d {request.step}")
        with notes_to(note_lines(file)):
            outcome, error = perform(request, open_store(given.store), progress_lines(file), picture_lines(file))
        return _finish(outcome, error, given.result)


def _finish(outcome: StepResult | StepFailure, error: BaseException | None, path: Path) -> int:
    """Write the result file and return the exit status."""
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
        return status or EXIT_STATUS[failure_kind(trouble)]
    return status
