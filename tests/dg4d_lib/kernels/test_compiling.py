"""When kernels are compiled, and what is said about it."""

import logging

import pytest
from numba import njit

from dg4d_lib.kernels import compiling, vectors

PLACES = [compiling._Beside, compiling._Home]


@pytest.fixture
def stamp(tmp_path):
    """The stamp of a kernel with this source beside a file of constants."""

    def made(place, source: str, constants: str):
        compiling._digest.cache_clear()
        (tmp_path / "constants.py").write_text(constants)
        (tmp_path / "kernel.py").write_text(source)
        return place(lambda: None, str(tmp_path / "kernel.py")).get_source_stamp()

    yield made
    compiling._digest.cache_clear()


@pytest.mark.parametrize("place", PLACES)
def test_a_change_beside_a_kernel_makes_its_machine_code_stale(place, stamp):
    source = f"from {vectors.__name__} import KERNEL"
    assert stamp(place, source, "BLUR = 0.3") == stamp(place, source, "BLUR = 0.3")
    assert stamp(place, source, "BLUR = 0.3") != stamp(place, source, "BLUR = 0.4")


@pytest.mark.parametrize("place", PLACES)
def test_a_kernel_that_stands_alone_depends_on_its_own_file_only(place, stamp):
    assert stamp(place, "x = 1", "BLUR = 0.3") == stamp(place, "x = 1", "BLUR = 0.4")
    assert stamp(place, "x = 1", "") != stamp(place, "x = 2", "")


def test_kernels_are_kept_at_these_places():
    kept = njit(cache=True)(lambda: None)
    assert isinstance(kept._cache._impl.locator, compiling._Stamped)


def test_compiling_is_told_once(caplog):
    teller = compiling._Teller()
    with caplog.at_level(logging.INFO, logger="dg4d_lib"):
        teller.on_start(None)
        teller.on_start(None)
    assert [record.message for record in caplog.records] == [compiling.NOTICE]


def test_who_compiles_is_heard(monkeypatch):
    heard = []
    monkeypatch.setattr(compiling._Teller, "on_start", lambda teller, event: heard.append(event))
    njit(lambda: 1)()
    assert heard
