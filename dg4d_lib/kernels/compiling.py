"""Numba's on-disk cache, keyed by all source files of a kernel, and a log line before the first compilation.

Numba caches machine code on disk and recompiles a kernel when its file changes. Our kernels also inline functions and
constants from files beside them and from this package, so their cache key includes a digest of both folders.
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

NOTICE = "compiling CPU kernels (about ten seconds, only the first time)"

_HERE = Path(__file__).parent
_log = logging.getLogger(__name__)


@cache
def configure_numba() -> None:
    """Install our cache locators and the compilation notice, once; call this before the first kernel is defined."""
    ours = [f"{__name__}.{locator.__name__}" for locator in (_EnvironmentCache, _SourceFolderCache, _UserCache)]
    locators = ",".join([*ours, "IPythonCacheLocator", "ZipCacheLocator"])  # Numba's own, for kernels of others
    numba.config.CACHE_LOCATOR_CLASSES = locators  # type: ignore[attr-defined]  # missing in its stub
    event.register("numba:compile", _CompileNotice())


def preload_numba() -> None:
    """Import Numba's compiler (0.4 s) before forking, so that forked processes do not each pay for it."""
    cpu_target.typing_context.refresh()
    cpu_target.target_context.refresh()


class _CompileNotice(event.Listener):
    """Listener that logs once per process that kernels are being compiled; cache hits are not logged."""

    def __init__(self) -> None:
        self._logged = False

    def on_start(self, event: Any) -> None:
        if not self._logged:
            self._logged = True
            _log.info(NOTICE)

    def on_end(self, event: Any) -> None:
        pass


class _SourceDigest:
    """Mixin for cache locators: the source stamp covers all files of a kernel."""

    _py_file: str

    def get_source_stamp(self) -> Any:
        """Return the key that cached machine code must match."""
        own = super().get_source_stamp()  # type: ignore[misc]
        source = Path(self._py_file)
        if f"{__package__}.simd" not in source.read_text(encoding="utf-8"):
            return own  # a kernel without our helpers keeps Numba's stamp, whether this module is imported or not
        return own, _digest(source.parent), _digest(_HERE)


class _EnvironmentCache(_SourceDigest, UserProvidedCacheLocator):
    """Cache in $NUMBA_CACHE_DIR."""


class _SourceFolderCache(_SourceDigest, InTreeCacheLocator):
    """Cache beside the source file."""


class _UserCache(_SourceDigest, UserWideCacheLocator):
    """Cache in the user's cache folder, for a source folder that is not writable."""


@cache
def _digest(folder: Path) -> bytes:
    content = hashlib.sha256()
    for path in sorted(folder.glob("*.py")):
        content.update(path.name.encode() + b"\0" + path.read_bytes())
    return content.digest()
