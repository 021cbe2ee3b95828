"""Guard of a worker, with a stand-in for Prefect's worker."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from waiting import wait_until

from flows.processes import start_of
from flows.serving.workers import Worker

GUARD = """
import sys
from pathlib import Path
from flows.serving import workers
workers.python = lambda *_: [sys.executable, "-S", sys.argv[1]]
sys.exit(workers.Worker("pool", Path(sys.argv[2])).guard("http://127.0.0.1:1/api"))
"""
WORKER = """
import signal, subprocess, sys, time
from pathlib import Path

def stop(*_):
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    time.sleep(0.3)
    Path("ended").touch()
    sys.exit(0)

signal.signal(signal.SIGTERM, stop)
run = subprocess.Popen([sys.executable, "-S", "-c", "import time; time.sleep(60)"], start_new_session=True)
Path("run").write_text(str(run.pid))
signal.pause()
"""


@pytest.fixture
def guard(tmp_path: Path) -> "Iterator[subprocess.Popen[bytes]]":
    (tmp_path / "worker.py").write_text(WORKER)
    process = subprocess.Popen([sys.executable, "-c", GUARD, str(tmp_path / "worker.py"), str(tmp_path)])
    try:
        wait_until(lambda: (tmp_path / "run").exists() and (tmp_path / "run").read_text())
        yield process
    finally:
        process.kill()
        process.wait()


def test_a_worker_that_is_stopped_has_time_to_end_and_leaves_no_run(
    guard: "subprocess.Popen[bytes]", tmp_path: Path
) -> None:
    run = int((tmp_path / "run").read_text())
    assert start_of(run)
    assert Worker("pool", tmp_path).stop()
    assert guard.wait(60) == 0
    assert (tmp_path / "ended").exists()
    wait_until(lambda: not start_of(run))
