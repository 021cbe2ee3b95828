"""Functions on arrays that run in a process of their own, because their libraries may crash or leak."""

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

EXIT_MISSING = 69  # the child needs something that is not installed
EXIT_REFUSED = 65  # the task has no solution


def run_in_subprocess(module: str, task: str, arrays: Mapping[str, NDArray[Any]]) -> Arrays:
    """Run `python -m MODULE`, which calls `serve`, on arrays and return its results.

    Args:
        module: full name.
        task: verb phrase for messages, such as "clean the mesh".
        arrays: by name.

    Raises:
        BackendUnavailable: the child needs something that is not installed.
        DG4DError: the child refused the task, or died.
    """
    with tempfile.TemporaryDirectory(prefix="dg4d-mesh-") as folder:
        given, made = Path(folder) / "given.npz", Path(folder) / "made.npz"
        _write(given, arrays)
        command = [sys.executable, "-P", "-m", module, str(given), str(made)]
        child = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
        if child.returncode == EXIT_MISSING:
            raise BackendUnavailable(child.stderr.strip())
        if child.returncode == EXIT_REFUSED:
            raise DG4DError(child.stderr.strip())
        if child.returncode != 0 or not made.exists():
            raise DG4DError(_death_message(child, task))
        with np.load(made) as results:
            return dict(results)


def serve(work: Callable[[Arrays], Arrays]) -> None:
    """Read the arrays, do the work, write the results and exit: the main function of the child.

    No destructor is called, because those of the libraries that run here may crash (see `unwrap`).
    """
    given, made = sys.argv[1:]
    status, message = 0, ""
    with np.load(given) as arrays:
        content = dict(arrays)
    try:
        _write(Path(made), work(content))
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


def _death_message(child: subprocess.CompletedProcess[str], task: str) -> str:
    code = child.returncode
    how = f"was stopped by {signal.Signals(-code).name}" if code < 0 else f"ended with status {code}"
    last = "; ".join(child.stderr.strip().splitlines()[-3:]) or "it said nothing"
    return f"the process to {task} {how} ({last}); run it again, or lower mesh.grid or mesh.max_faces"
