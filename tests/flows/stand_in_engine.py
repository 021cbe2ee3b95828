"""A program that takes the place of podman: its "containers" are processes of a session of their own.

Like a real engine's, they outlive the program that was asked to run them, until they are removed or end; what they see
of the environment is what was handed over; they die with 137 when they are killed. Isolation is left to real ones.
"""

import itertools
import json
import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

HERE = Path(__file__).parent
IMAGE, CONTENT = "dg4d/cpu", "a" * 64


def install(folder: Path) -> Path:
    """Write the program `podman` into a folder; it notes in `asked` there what it was asked."""
    program = folder / "podman"
    program.write_text(
        f"#!{sys.executable}\nimport sys\nsys.path[:0] = {[str(HERE), *filter(None, sys.path)]!r}\n"
        f"from stand_in_engine import main\nsys.exit(main({str(folder)!r}, sys.argv[1:]))\n"
    )
    program.chmod(0o755)
    return program


def asked(folder: Path) -> list[list[str]]:
    """What it was asked so far."""
    return [json.loads(line) for line in (folder / "asked").read_text().splitlines()]


def main(place: str, words: list[str]) -> int:
    folder = Path(place)
    with (folder / "asked").open("a") as file:
        file.write(json.dumps(words) + "\n")
    match words:
        case ["image", "inspect", name] if name == IMAGE:
            sys.stdout.write(json.dumps([{"Id": f"sha256:{CONTENT}", "RepoDigests": []}]))
        case ["rm", "--force", name]:
            with suppress(OSError, ValueError):
                os.killpg(int((folder / name).read_text()), signal.SIGKILL)
        case ["run", *_]:
            return _run(folder, words)
        case _:
            return 125
    return 0


def _run(folder: Path, words: list[str]) -> int:
    environment = {name: os.environ[name] for name in ("PATH", "PYTHONPATH", "DG4D_CATALOG", "FAKE_LOG")}  # the image's
    for flag, value in itertools.pairwise(words):
        if flag == "--env":
            name, given, content = value.partition("=")
            environment[name] = content if given else os.environ[name]
    arguments = words[words.index(CONTENT) + 1 :]
    process = subprocess.Popen(
        [sys.executable, "-m", "steps.main", *arguments], env=environment, start_new_session=True
    )
    (folder / words[words.index("--name") + 1]).write_text(str(process.pid))
    status = process.wait()
    return 128 - status if status < 0 else status
