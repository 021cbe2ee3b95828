"""Peak memory of the first step, measured in a process of its own: `python peak_memory.py FILE...` prints a line each.

The kernel's high-water mark of resident memory (VmHWM) is reset before every file: one process measures many.
"""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Peak:
    """One run of `prepare_subject`.

    Attributes:
        mib: most resident memory of the process, libraries included.
        outcome: "done", or class and message of the exception.
        seconds: on the clock.
    """

    mib: float
    outcome: str
    seconds: float


def peaks_of(files: Sequence[Path], **settings: object) -> list[Peak]:
    """Prepare every file in one new process, with these settings of `SubjectSettings`."""
    command = [sys.executable, __file__, json.dumps(settings), *map(str, files)]
    child = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    lines = child.stdout.splitlines()
    assert len(lines) == len(files), f"ended with {child.returncode} after {len(lines)} files: {child.stderr[-2000:]}"
    return [Peak(**json.loads(line)) for line in lines]


def measure(path: Path, settings: dict[str, object]) -> Peak:
    """Prepare a file in this process."""
    from dg4d_lib.settings import SubjectSettings
    from steps.job import Job
    from steps.prepare_subject import run

    Path("/proc/self/clear_refs").write_text("5")
    start, outcome = time.monotonic(), "done"
    with tempfile.TemporaryDirectory() as folder:
        outputs = {name: Path(folder) / name for name in ("subject.png", "footage.zip", "picture.png")}
        try:
            run(
                Job(
                    {"source": path},
                    {name.partition(".")[0]: path for name, path in outputs.items()},
                    SubjectSettings(**settings),
                    0,
                    lambda *_: None,
                    Path(folder),
                )
            )
        except Exception as error:
            outcome = f"{type(error).__name__}: {error}"
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return Peak(int(status["VmHWM"].split()[0]) / 1024, outcome, time.monotonic() - start)


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    for name in sys.argv[2:]:
        sys.stdout.write(json.dumps(asdict(measure(Path(name), json.loads(sys.argv[1])))) + "\n")
        sys.stdout.flush()
