"""Array functions in a child process, for native libraries that may crash or leak."""

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dg4d_lib.errors import BackendUnavailable, DG4DError

Arrays = dict[str, NDArray[Any]]

EXIT_MISSING = 69  # a dependency is not installed (EX_UNAVAILABLE of sysexits.h)
EXIT_REFUSED = 65  # the task has no solution (EX_DATAERR of sysexits.h)


def run_in_subprocess(module: str, task: str, arrays: Mapping[str, NDArray[Any]]) -> Arrays:
    """Run `python -m MODULE`, which must call `serve`, on arrays and return its results.

    Args:
        module: full name of the module.
        task: verb phrase for error messages, such as "clean the mesh".
        arrays: inputs by name.

    Raises:
        BackendUnavailable: a dependency of the child is not installed.
        DG4DError: the child rejected the task or crashed.
    """
    with tempfile.TemporaryDirectory(prefix="dg4d-mesh-") as folder:
        inputs, outputs = Path(folder) / "inputs.npz", Path(folder) / "outputs.npz"
        _write(inputs, arrays)
        command = [sys.executable, "-P", "-m", module, str(inputs), str(outputs)]
        child = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
        if child.returncode == EXIT_MISSING:
            raise BackendUnavailable(child.stderr.strip())
        if child.returncode == EXIT_REFUSED:
            raise DG4DError(child.stderr.strip())
        if child.returncode != 0 or not outputs.exists():
            raise DG4DError(_crash_message(child, task))
        with np.load(outputs) as results:
            return dict(results)


def serve(work: Callable[[Arrays], Arrays]) -> None:
    """Read the arrays, do the work, write the results and exit; the main function of the child.

    The process exits without running destructors, because those of the libraries used here may hang (see `unwrap`).
    """
    inputs, outputs = sys.argv[1:]
    status, message = 0, ""
    with np.load(inputs) as arrays:
        content = dict(arrays)
    try:
        _write(Path(outputs), work(content))
    except BackendUnavailable as error:
        status, message = EXIT_MISSING, str(error)
    except DG4DError as error:
        status, message = EXIT_REFUSED, str(error)
    sys.stderr.write(message)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def _write(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    np.savez(path, allow_pickle=False, **dict(arrays))


def _crash_message(child: subprocess.CompletedProcess[str], task: str) -> str:
    code = child.returncode
    end = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"exited with status {code}"
    last_lines = "; ".join(child.stderr.strip().splitlines()[-3:]) or "no output"
    return f"the process to {task} {end} ({last_lines}); run it again, or lower mesh.grid or mesh.max_faces"
