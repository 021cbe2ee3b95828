"""When kernels are compiled: after a change in any source they are made of, and people are told.

Numba keeps machine code on disk and compiles again when the file of a kernel changed. Our kernels are made of several
files: what they inline, and constants, lie beside them or in this package. So the stamp of such a kernel is a digest of
both folders.
"""

import hashlib
import logging
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core import event
from numba.core.caching import InTreeCacheLocator, UserProvidedCacheLocator, UserWideCacheLocator
from numba.core.registry import cpu_target

NOTICE = "compiling kernels for this processor: some ten seconds, once"

_HERE = Path(__file__).parent
_log = logging.getLogger(__name__)


def prepare() -> None:
    """Set Numba up; to be called before the first kernel is defined."""
    ours = [f"{__name__}.{place.__name__}" for place in (_Given, _Beside, _Home)]
    places = ",".join([*ours, "IPythonCacheLocator", "ZipCacheLocator"])  # Numba's others, for code that is not ours
    numba.config.CACHE_LOCATOR_CLASSES = places  # type: ignore[attr-defined]
    event.register("numba:compile", _Teller())


def load() -> None:
    """Have Numba import what it would for its first kernel, .4 s that forks of this process need not spend."""
    cpu_target.typing_context.refresh()
    cpu_target.target_context.refresh()


class _Teller(event.Listener):
    """Says once per process that kernels are being compiled; loading them from the disk is not worth a word."""

    def __init__(self) -> None:
        self._told = False

    def on_start(self, event: Any) -> None:
        if not self._told:
            self._told = True
            _log.info(NOTICE)

    def on_end(self, event: Any) -> None:
        pass


class _Stamped:
    """A place for machine code whose stamp covers all sources of a kernel."""

    _py_file: str

    def get_source_stamp(self) -> Any:
        """The digest that must be the same for machine code to be used."""
        own = super().get_source_stamp()  # type: ignore[misc]
        source = Path(self._py_file)
        if f"{__package__}.simd" not in source.read_text(encoding="utf-8"):
            return own  # it stands alone: as Numba would have it, whether this module is imported or not
        return own, _digest(source.parent), _digest(_HERE)


class _Given(_Stamped, UserProvidedCacheLocator):
    """In $NUMBA_CACHE_DIR."""


class _Beside(_Stamped, InTreeCacheLocator):
    """Beside the source."""


class _Home(_Stamped, UserWideCacheLocator):
    """In the user's cache folder, where the source may not be written to."""


@cache
def _digest(folder: Path) -> bytes:
    content = hashlib.sha256()
    for path in sorted(folder.glob("*.py")):
        content.update(path.name.encode() + b"\0" + path.read_bytes())
    return content.digest()
