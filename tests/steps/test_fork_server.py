import subprocess
import sys

LOOKS = """
import importlib, sys, threading
from steps.main import catalog
for spec in catalog().values():
    importlib.import_module(spec.entry.partition(":")[0])
import torch
print(threading.active_count(), torch.cuda.is_initialized(), "pymeshlab" in sys.modules, "torch" in sys.modules)
"""


def test_what_is_imported_before_forks_starts_no_thread_and_no_gpu_and_leaves_pymeshlab_to_its_own_process() -> None:
    said = subprocess.run([sys.executable, "-c", LOOKS], capture_output=True, text=True, check=True).stdout
    assert said.split() == ["1", "False", "False", "True"]


def test_without_a_socket_it_ends_at_once() -> None:
    done = subprocess.run([sys.executable, "-m", "steps.fork_server"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "required: socket" in done.stderr
