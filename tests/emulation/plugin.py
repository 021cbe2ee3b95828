"""`pytest -p tests.emulation.plugin`: tests on the GPU of `gpu.py`."""

import os

import pytest

from tests.emulation import gpu
from tests.emulation.build import ARITHMETICS


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--arithmetic", choices=ARITHMETICS, default="fast", help="how gsplat's kernels round")


@pytest.hookimpl(tryfirst=True)
def pytest_load_initial_conftests(early_config: pytest.Config, parser: pytest.Parser, args: list[str]) -> None:
    """Before a conftest imports torch."""
    os.environ["OMP_NUM_THREADS"] = "1"  # as in tests/conftest.py, which comes later
    try:
        gpu.begin(early_config.known_args_namespace.arithmetic)
    except RuntimeError as error:
        raise pytest.UsageError(str(error)) from error


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Tests that met no kernel prove nothing."""
    if session.testscollected and not (gpu.present and gpu.present.launches):
        session.exitstatus = pytest.ExitCode.INTERNAL_ERROR


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    assert gpu.present
    meaning = "" if gpu.present.launches else ": nothing is proven"
    terminalreporter.write_line(
        f"gsplat's kernels were launched {gpu.present.launches} times{meaning}; torch computed "
        f"{gpu.present.computed:,} times on {gpu.NAME}"
    )
