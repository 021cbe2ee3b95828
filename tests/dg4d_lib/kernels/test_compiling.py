"""Numba cache keys of our kernels, and the notice before a compilation."""

import logging
from pathlib import Path

import pytest

from dg4d_lib.kernels import compiling
from dg4d_lib.mesh import folds

LOCATORS = [compiling._SourceFolderCache, compiling._UserCache]


@pytest.fixture
def stamp(tmp_path, monkeypatch):
    """Return a function that stamps a kernel with this source in a package with these other modules."""
    monkeypatch.setattr(compiling, "_ROOT", tmp_path)
    (tmp_path / "ours").mkdir()

    def make(locator, source: str, head: str = f"import {compiling.__name__}\n", **modules: str):
        compiling._digest.cache_clear()
        for name, text in modules.items():
            (tmp_path / "ours" / f"{name}.py").write_text(text)
        (tmp_path / "ours" / "kernel.py").write_text(head + source)
        return locator(lambda: None, str(tmp_path / "ours" / "kernel.py")).get_source_stamp()

    yield make
    compiling._digest.cache_clear()


@pytest.mark.parametrize("locator", LOCATORS)
@pytest.mark.parametrize(
    "source", ["from ours.size import BLUR", "from ours.size import (\n    BLUR,\n)", "from ours import size"]
)
def test_a_change_of_what_a_kernel_imports_makes_its_machine_code_stale(locator, source, stamp):
    assert stamp(locator, source, size="BLUR = 0.3") == stamp(locator, source, size="BLUR = 0.3")
    assert stamp(locator, source, size="BLUR = 0.3") != stamp(locator, source, size="BLUR = 0.4")


@pytest.mark.parametrize("locator", LOCATORS)
def test_what_an_imported_kernel_imports_counts(locator, stamp):
    source, between = "from ours.turn import turn", "from ours.size import BLUR\n\n@njit\ndef turn(): ..."
    assert stamp(locator, source, turn=between, size="x = 1") != stamp(locator, source, turn=between, size="x = 2")
    plain = "from ours.size import BLUR"
    assert stamp(locator, source, turn=plain, size="x = 1") == stamp(locator, source, turn=plain, size="x = 2")


@pytest.mark.parametrize("locator", LOCATORS)
def test_a_kernel_that_stands_alone_depends_on_its_own_file_only(locator, stamp):
    assert stamp(locator, "x = 1", size="BLUR = 0.3") == stamp(locator, "x = 1", size="BLUR = 0.4")
    others = "from ours.size import BLUR"  # of another package, whose kernels are not called by ours
    assert stamp(locator, others, "", size="BLUR = 0.3") == stamp(locator, others, "", size="BLUR = 0.4")
    assert stamp(locator, "x = 1") != stamp(locator, "x = 22")


def test_the_stamp_of_folds_covers_the_rotations_that_they_inline():
    rotation = Path(compiling.__file__).parents[1] / "geometry" / "rotation.py"
    assert rotation in set(compiling._imported(Path(folds.__file__)))


def test_kernels_use_our_cache_locators():
    kernel = compiling.njit(cache=True)(lambda: None)
    assert isinstance(kernel._cache._impl.locator, compiling._SourceDigest)


def test_compiling_is_logged_once(caplog):
    notice = compiling._CompileNotice()
    with caplog.at_level(logging.INFO, logger="dg4d_lib"):
        notice.on_start(None)
        notice.on_start(None)
    assert [record.message for record in caplog.records] == [compiling.NOTICE]


def test_a_compilation_reaches_one_listener(monkeypatch):
    events = []
    monkeypatch.setattr(compiling._CompileNotice, "on_start", lambda notice, event: events.append(event))
    compiling.njit()(lambda: 1)()
    assert events and len(events) == len(set(map(id, events)))
