"""Every test run has a home of its own, and nothing of the user's environment."""

import gc
import os
import resource
import shutil
import signal
import tempfile
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.emulation import gpu

gc.disable()  # until all is imported: it would look through the same modules again and again
_HOME = Path(tempfile.mkdtemp(prefix="dg4d-tests-"))
for _name in tuple(os.environ):
    if _name.startswith(("PREFECT_", "DG4D_")) and not _name.startswith("DG4D_TEST_"):
        del os.environ[_name]
os.environ["OMP_NUM_THREADS"] = "1"  # tests run side by side; spinning threads would slow each other down
os.environ["OMP_WAIT_POLICY"] = "passive"
os.environ["DG4D_HOME"] = str(_HOME)  # before anything imports Prefect, which reads its settings then
os.environ["PREFECT_HOME"] = str(_HOME / "prefect")
os.environ["DO_NOT_TRACK"] = "1"
os.environ["PREFECT_SERVER_ANALYTICS_ENABLED"] = "false"
os.environ["PREFECT_LOGGING_HANDLERS_CONSOLE_LEVEL"] = "CRITICAL"
signal.signal(signal.SIGINT, signal.default_int_handler)  # shells have background jobs ignore it, with all they begin


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


@pytest.fixture
def emulated_gpu() -> Iterator[gpu.Emulated]:
    """The GPU of `make emulation`, which counts; after the test it has memory again."""
    if gpu.present is None:
        pytest.skip("asks an emulated GPU, which `make emulation` has")
    yield gpu.present
    gpu.present.has_memory()


@pytest.fixture
def quick_segmentation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Segment by the distance to the color of the first pixel: the network takes seconds per film."""
    from dg4d_lib.video.segmentation_network import SegmentationNetwork

    def far_from_corner(_: SegmentationNetwork, picture: Any) -> Any:
        return ((picture - picture[0, 0]).abs().amax(-1) * 4).clamp(0, 1)

    monkeypatch.setattr(SegmentationNetwork, "probability", far_from_corner)


@pytest.fixture
def no_room() -> AbstractContextManager[None]:
    """Context in which no file takes a byte, as on a full disk, though files can be created."""

    @contextmanager
    def limited() -> Iterator[None]:
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)

    return limited()


def pytest_unconfigure() -> None:
    gc.unfreeze()
    shutil.rmtree(_HOME, ignore_errors=True)
