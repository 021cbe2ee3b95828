"""Numba cache keys of our kernels, and the notice before a compilation."""

import logging

import pytest
from numba import njit

from dg4d_lib.kernels import compiling, simd

LOCATORS = [compiling._SourceFolderCache, compiling._UserCache]


@pytest.fixture
def stamp(tmp_path):
    """Return a function that stamps a kernel with this source beside a file of constants."""

    def make(locator, source: str, constants: str):
        compiling._digest.cache_clear()
        (tmp_path / "constants.py").write_text(constants)
        (tmp_path / "kernel.py").write_text(source)
        return locator(lambda: None, str(tmp_path / "kernel.py")).get_source_stamp()

    yield make
    compiling._digest.cache_clear()


@pytest.mark.parametrize("locator", LOCATORS)
def test_a_change_beside_a_kernel_makes_its_machine_code_stale(locator, stamp):
    source = f"from {simd.__name__} import KERNEL"
    assert stamp(locator, source, "BLUR = 0.3") == stamp(locator, source, "BLUR = 0.3")
    assert stamp(locator, source, "BLUR = 0.3") != stamp(locator, source, "BLUR = 0.4")


@pytest.mark.parametrize("locator", LOCATORS)
def test_a_kernel_that_stands_alone_depends_on_its_own_file_only(locator, stamp):
    assert stamp(locator, "x = 1", "BLUR = 0.3") == stamp(locator, "x = 1", "BLUR = 0.4")
    assert stamp(locator, "x = 1", "") != stamp(locator, "x = 2", "")


def test_kernels_use_our_cache_locators():
    kernel = njit(cache=True)(lambda: None)
    assert isinstance(kernel._cache._impl.locator, compiling._SourceDigest)


def test_compiling_is_logged_once(caplog):
    notice = compiling._CompileNotice()
    with caplog.at_level(logging.INFO, logger="dg4d_lib"):
        notice.on_start(None)
        notice.on_start(None)
    assert [record.message for record in caplog.records] == [compiling.NOTICE]


def test_a_compilation_reaches_one_listener(monkeypatch):
    compiling.configure_numba()  # as every module with kernels does
    events = []
    monkeypatch.setattr(compiling._CompileNotice, "on_start", lambda notice, event: events.append(event))
    njit(lambda: 1)()
    assert events and len(events) == len(set(map(id, events)))
