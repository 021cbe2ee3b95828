"""Peak memory of the first step, in a process of its own: `python peak_memory.py SETTINGS FILE ...` prints lines.

The kernel's high-water mark of resident memory (VmHWM) is reset before every file: one process measures many.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
Settings = Mapping[str, object]


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


def peaks_of(files: Sequence[tuple[Path, Settings]]) -> list[Peak]:
    """Prepare every file in one new process, with its settings of `SubjectSettings`."""
    requests = [text for path, settings in files for text in (json.dumps(settings), str(path))]
    environment = os.environ | {"OMP_WAIT_POLICY": "PASSIVE"}  # threads that spin cost processor time
    child = subprocess.run(
        [sys.executable, __file__, *requests],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env=environment,
        check=False,
    )
    lines = child.stdout.splitlines()
    assert len(lines) == len(files), f"ended with {child.returncode} after {len(lines)} files: {child.stderr[-2000:]}"
    return [Peak(**json.loads(line)) for line in lines]


def measure(path: Path, settings: Settings) -> Peak:
    """Prepare a file in this process."""
    from steps.prepare_subject import run
    from steps.profiles import PREVIEW, revise, step_settings
    from steps.runtime.job import Job

    Path("/proc/self/clear_refs").write_text("5")
    start, outcome = time.monotonic(), "done"
    with tempfile.TemporaryDirectory() as folder:
        names = ("subject.png", "footage.zip", "pose.json", "cutout_gates.json", "picture.png")
        outputs = {name: Path(folder) / name for name in names}
        try:
            run(
                Job(
                    {"source": path},
                    {name.partition(".")[0]: path for name, path in outputs.items()},
                    step_settings("prepare_subject", revise(PREVIEW, {f"subject.{k}": v for k, v in settings.items()})),
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
    for settings, name in zip(sys.argv[1::2], sys.argv[2::2], strict=True):
        sys.stdout.write(json.dumps(asdict(measure(Path(name), json.loads(settings)))) + "\n")
        sys.stdout.flush()
