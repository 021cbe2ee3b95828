import subprocess
import sys

import pytest

LOOKS = """
import sys, threading
from steps.runtime import fork_server
for entry in fork_server._late_imports():
    fork_server._preload(entry)
import torch
print(threading.active_count(), torch.cuda.is_initialized(), "pymeshlab" in sys.modules, "torch" in sys.modules)
before = set(sys.modules)
import numba
from dg4d_lib.adam import Adam
value = torch.zeros(1, requires_grad=True)
adam = Adam([{"params": value, "lr": 0.1}])
value.sum().backward()
adam.step()
numba.njit(lambda: 0)()
print(*{name.partition(".")[0] for name in set(sys.modules) - before})
from dg4d_lib.kernels.compiling import _SourceDigest
kernels = [
    value
    for name, module in list(sys.modules.items()) if name.startswith("dg4d_lib.")
    for value in vars(module).values() if isinstance(value, numba.core.dispatcher.Dispatcher)
]
other = {kernel.__module__ for kernel in kernels if not isinstance(kernel._cache._impl.locator, _SourceDigest)}
print(len(kernels), *sorted(other))
"""


@pytest.fixture(scope="module")
def said() -> list[str]:
    """Return the lines of a fresh process that imports everything the fork server does."""
    return subprocess.run([sys.executable, "-c", LOOKS], capture_output=True, text=True, check=True).stdout.splitlines()


def test_what_is_imported_before_forks_starts_no_thread_and_no_gpu_and_leaves_pymeshlab_to_its_own_process(
    said: list[str],
) -> None:
    then, imported_by_first_calls, _ = said
    assert then.split() == ["1", "False", "False", "True"]
    assert not {"torch", "sympy", "cffi"} & set(imported_by_first_calls.split())


def test_machine_code_of_every_kernel_is_keyed_by_all_its_sources(said: list[str]) -> None:
    kernels, *other_modules = said[2].split()
    assert int(kernels) > 100 and not other_modules


def test_without_a_socket_it_ends_at_once() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "steps.runtime.fork_server"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert "required: socket" in done.stderr
