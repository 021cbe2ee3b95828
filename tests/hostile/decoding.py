"""Decoding in a child process, so that a crash, a hang or a memory bomb is a result and not the end of the tests.

`python -m tests.hostile.decoding FOLDER` answers requests on standard input, a JSON line each, with a JSON line each.
"""

import contextlib
import json
import os
import resource
import selectors
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Literal

ROOM_BYTES = 12 * 2**30  # of address space beyond what the child starts with: a bomb ends in it, not the machine
HANGS_S = 120.0  # without an answer
SIZE = 64  # pixels of the cut-out; decoding is what is tested

Kind = Literal["picture", "video", "done", "refused", "broke", "crashed", "hung"]


@dataclass(frozen=True)
class Outcome:
    """Result of one request.

    Attributes:
        kind: `done` is success of a reader that gives no frames; `broke` is an exception that no user should see.
        frames: of a picture or a video.
        says: message of the refusal, or the end of the traceback.
        seconds: processor time.
        peak_mb: highest resident memory while it ran, MiB; 0 where it is not known.
        left: files that stayed in the folder for temporary files, or outputs of a refused file.
    """

    kind: Kind
    frames: int = 0
    says: str = ""
    seconds: float = 0.0
    peak_mb: float = 0.0
    left: list[str] = field(default_factory=list)

    @property
    def sound(self) -> bool:
        """Accepted, or refused in a sentence, with nothing left behind."""
        return self.kind in ("picture", "video", "done", "refused") and not self.left


class Decoder:
    """A child process that decodes one file after the other; a new one takes the place of one that ended."""

    def __init__(self, folder: Path, hangs_s: float = HANGS_S) -> None:
        self._folder, self._hangs_s = folder, hangs_s
        self._child: subprocess.Popen[str] | None = None

    def __enter__(self) -> "Decoder":
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def ask(self, path: Path, reader: str = "source") -> Outcome:
        """Read a file with one of `READERS`."""
        child = self._child or self._start()
        assert child.stdin and child.stdout
        with contextlib.suppress(BrokenPipeError):
            child.stdin.write(json.dumps({"path": str(path), "reader": reader}) + "\n")
            child.stdin.flush()
        with selectors.DefaultSelector() as ready:
            ready.register(child.stdout, selectors.EVENT_READ)
            if not ready.select(self._hangs_s):
                self._end()
                return Outcome("hung", says=f"no answer in {self._hangs_s:g} s")
        line = child.stdout.readline()
        if line:
            return Outcome(**json.loads(line))
        status = child.wait()
        self._end()
        return Outcome("crashed", says=f"the process ended with status {status}")

    def _start(self) -> "subprocess.Popen[str]":
        self._folder.mkdir(parents=True, exist_ok=True)
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        with (self._folder / "stderr.txt").open("ab") as errors:
            self._child = subprocess.Popen(
                [sys.executable, "-m", "tests.hostile.decoding", str(self._folder)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                env=environment,
                cwd=Path(__file__).parents[2],
            )
        return self._child

    def _end(self) -> None:
        if self._child is None:
            return
        self._child.kill()
        self._child.wait()
        for pipe in (self._child.stdin, self._child.stdout):
            if pipe:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()
        self._child = None


def read_as_source(path: Path, scratch: Path) -> tuple[Kind, int]:
    """Run the step that decodes a source; frames of opaque videos are not segmented by a network, which takes long."""
    from steps.prepare_subject import run
    from steps.profiles import PREVIEW, revise, step_settings
    from steps.runtime.job import Job

    outputs = {
        "subject": scratch / "subject.png",
        "footage": scratch / "footage.zip",
        "pose": scratch / "pose.json",
        "cutout_gates": scratch / "cutout_gates.json",
        "picture": scratch / "picture.png",
    }
    settings = step_settings("prepare_subject", revise(PREVIEW, {"subject.size": SIZE, "subject.matting": "backdrop"}))
    run(Job({"source": path}, outputs, settings, 0, lambda *_: None, scratch))
    if outputs["footage"].exists():
        with zipfile.ZipFile(outputs["footage"]) as footage:
            return "video", sum(name.endswith(".png") for name in footage.namelist())
    return "picture", 1


def read_as_depth(path: Path, scratch: Path) -> tuple[Kind, int]:
    """Run the step that decodes a depth picture, beside a sound cut-out of 64 x 64 pixels."""
    from steps.prepare_subject import run
    from steps.profiles import PREVIEW, revise, step_settings
    from steps.runtime.job import Job
    from tests.hostile.samples import sound_png

    names = ("subject.png", "footage.zip", "pose.json", "depth_field.safetensors", "cutout_gates.json", "picture.png")
    outputs = {name.partition(".")[0]: scratch / name for name in names}
    (scratch / "cat.png").write_bytes(sound_png())
    settings = step_settings("prepare_subject", revise(PREVIEW, {"subject.size": SIZE}))
    run(Job({"source": scratch / "cat.png", "depth": path}, outputs, settings, 0, lambda *_: None, scratch))
    return "done", 1


def read_as_zip(path: Path, scratch: Path) -> tuple[Kind, int]:
    """Unpack a zip that somebody else wrote."""
    from steps.artifacts.archives import unpack

    return "done", len(unpack(path, scratch, "the zip"))


def read_as_bank(path: Path, scratch: Path) -> tuple[Kind, int]:
    """Read a bank of true views: a zip, or a folder that is packed first, as a command does."""
    from steps.fitting.priors import read_bank

    bank = path
    if path.is_dir():
        bank = scratch / "bank.zip"
        with zipfile.ZipFile(bank, "w") as archive:
            for file in sorted(path.rglob("*")):
                if file.is_file():
                    archive.write(file, file.relative_to(path).as_posix())
    (scratch / "bank").mkdir()
    return "done", len(read_bank(bank, scratch / "bank").cameras)


def _read_as_manifest(suffix: str) -> Callable[[Path, Path], tuple[Kind, int]]:
    def read(path: Path, scratch: Path) -> tuple[Kind, int]:
        """Read the items of a manifest and check each of them."""
        from dg4d_lib.errors import DG4DError
        from flows.inputs.manifest import items_of

        manifest = scratch / f"manifest{suffix}"
        shutil.copyfile(path, manifest)
        items = items_of(manifest, scratch / "out", "preview", {}, 0)
        for item in items:
            item.model_dump_json()
            if item.request is not None:
                with contextlib.suppress(DG4DError):
                    item.request.check()
        return "done", len(items)

    return read


def read_as_settings(path: Path, scratch: Path) -> tuple[Kind, int]:
    """Read every line as an argument of `--set`, as a shell hands it over."""
    from flows.inputs.manifest import parse_changes
    from steps.profiles import profile, revise

    pairs = [os.fsdecode(line) for line in path.read_bytes().split(b"\n")]
    changes = parse_changes(pairs)
    revise(profile("preview"), changes)
    return "done", len(changes)


def read_as_scene(path: Path, scratch: Path) -> tuple[Kind, int]:
    """Read a scene file."""
    from flows.commands.compose import read_scene

    return "done", len(read_scene(path).items)


def read_as_record(path: Path, scratch: Path) -> tuple[Kind, int]:
    """Check a package whose record somebody else wrote, and ask for the order that it names."""
    from flows.inputs.conversion_job import job_from_record
    from flows.inputs.package_record import RECORD, record_of
    from flows.packages.publish import is_current
    from flows.packages.verify import verify
    from steps.store.artifact_store import ArtifactStore

    shutil.copyfile(path, scratch / RECORD)
    record = record_of(scratch)
    is_current(scratch, "sha256:0")
    checks = verify(scratch).checks
    if record is not None:
        job_from_record(record, ArtifactStore(scratch / "store"))
    return "done", len(checks)


def read_nothing(path: Path, scratch: Path) -> tuple[Kind, int]:
    """Answer, once everything is imported."""
    return "done", 0


def crash(path: Path, scratch: Path) -> tuple[Kind, int]:
    """End the process as a fault of a native library would."""
    os.kill(os.getpid(), signal.SIGSEGV)
    return "done", 0


READERS: dict[str, Callable[[Path, Path], tuple[Kind, int]]] = {
    "source": read_as_source,
    "depth": read_as_depth,
    "zip": read_as_zip,
    "bank": read_as_bank,
    "csv": _read_as_manifest(".csv"),
    "json": _read_as_manifest(".json"),
    "jsonl": _read_as_manifest(".jsonl"),
    "parquet": _read_as_manifest(".parquet"),
    "settings": read_as_settings,
    "scene": read_as_scene,
    "record": read_as_record,
    "nothing": read_nothing,
    "crash": crash,
}


def _answer(request: dict[str, str], folder: Path) -> Outcome:
    scratch, temporary = folder / "outputs", folder / "temporary"
    for place in (scratch, temporary):
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir()
    tempfile.tempdir = str(temporary)
    with _measured() as figures:
        try:
            kind, frames = READERS[request["reader"]](Path(request["path"]), scratch)
            outcome: dict[str, Any] = {"kind": kind, "frames": frames}
        except BaseException as error:  # whatever it is, it is the result
            outcome = _failure(error)
    left = sorted(str(path.relative_to(folder)) for path in temporary.rglob("*"))
    if request["reader"] == "source" and outcome["kind"] not in ("picture", "video"):
        left += sorted(str(path.relative_to(folder)) for path in scratch.rglob("*"))
    return Outcome(**outcome, **figures, left=left)


def _failure(error: BaseException) -> dict[str, Any]:
    from dg4d_lib.errors import DG4DError

    if isinstance(error, DG4DError):
        return {"kind": "refused", "says": str(error)}
    where = "".join(traceback.format_tb(error.__traceback__))[-2500:]
    return {"kind": "broke", "says": f"{where}{type(error).__name__}: {str(error)[:500]}"}


@contextlib.contextmanager
def _measured() -> Iterator[dict[str, float]]:
    """Measure processor time and the peak of resident memory; the kernel's mark of it is reset first."""
    figures: dict[str, float] = {}
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    start = time.process_time()
    yield figures
    figures["seconds"] = round(time.process_time() - start, 3)
    lines = Path("/proc/self/status").read_text().splitlines()
    figures["peak_mb"] = next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))


def _serve(folder: Path, answers: IO[str]) -> None:
    import av.logging

    for name in ("steps.prepare_subject", "steps.fitting.priors", "steps.artifacts.archives"):
        __import__(name)
    av.logging.set_level(av.logging.PANIC)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + ROOM_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    for line in sys.stdin:
        answers.write(json.dumps(vars(_answer(json.loads(line), folder))) + "\n")
        answers.flush()


if __name__ == "__main__":
    _answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever a library prints is not an answer
    _serve(Path(sys.argv[1]), _answers)
