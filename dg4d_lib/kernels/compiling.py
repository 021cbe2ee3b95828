"""Numba's `njit`, with an on-disk cache keyed by all source files of a kernel and a log line before compilations.

Numba caches machine code on disk and recompiles a kernel when its file changes. Our kernels also inline functions and
constants from modules that they import, so their cache key includes a digest of these, and of those that they import
in turn if they have kernels themselves. Numba chooses the cache when a kernel is defined, and its own and ours use the
same index files with different keys: if one kernel had either, by the order of imports, each would discard the machine
code of the other. So every kernel of ours is defined by `njit` of this module; ruff refuses Numba's.
"""

import hashlib
import logging
import re
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core import event
from numba.core.caching import InTreeCacheLocator, UserProvidedCacheLocator, UserWideCacheLocator
from numba.core.registry import cpu_target

NOTICE = "compiling the CPU kernels of this step, once per machine"

_ROOT = Path(__file__).parents[2]  # that holds our packages
_IMPORT = re.compile(r"^(?:from|import) ([\w.]+)(?: import (\([^)]*\)|.*))?", re.MULTILINE)
_KERNELS = ("njit", "KERNEL", "INLINE")  # in the source of a module with functions that kernels call
_log = logging.getLogger(__name__)


def njit(**options: Any) -> Callable[[Any], Any]:
    """Return Numba's decorator for these options, with our cache and the compilation notice."""
    _configure_numba()
    return numba.njit(**options)


@cache
def _configure_numba() -> None:
    """Install our cache locators and the compilation notice, once."""
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
        inlined = _digest(Path(self._py_file))
        return (own, inlined) if inlined else own  # others' kernels keep Numba's stamp, with this module or without


class _EnvironmentCache(_SourceDigest, UserProvidedCacheLocator):
    """Cache in $NUMBA_CACHE_DIR."""


class _SourceFolderCache(_SourceDigest, InTreeCacheLocator):
    """Cache beside the source file."""


class _UserCache(_SourceDigest, UserWideCacheLocator):
    """Cache in the user's cache folder, for a source folder that is not writable."""


@cache
def _digest(kernel: Path) -> bytes:
    """Return a digest of the modules whose functions and constants a kernel may inline, empty if there are none."""
    ours = __name__.split(".")[0]
    if not any(module.split(".")[0] == ours for module, _ in _IMPORT.findall(kernel.read_text(encoding="utf-8"))):
        return b""  # a kernel that stands alone, or of another package
    content, found, queue = hashlib.sha256(), set[Path](), [kernel]
    while queue:
        for path in _imported(queue.pop()):
            if path not in found:
                found.add(path)
                if any(word in path.read_text(encoding="utf-8") for word in _KERNELS):
                    queue.append(path)
    for path in sorted(found):
        content.update(str(path.relative_to(_ROOT)).encode() + b"\0" + path.read_bytes())
    return content.digest() if found else b""


def _imported(source: Path) -> Iterator[Path]:
    """Yield the files of the modules of our packages that a file imports."""
    own = source.relative_to(_ROOT).parts[0] if source.is_relative_to(_ROOT) else ""
    for module, names in _IMPORT.findall(source.read_text(encoding="utf-8")):
        if module.split(".")[0] in (own, __name__.split(".")[0]):
            for name in ["", *re.findall(r"\w+", names)]:
                path = _ROOT.joinpath(*module.split("."), name).with_suffix(".py")
                if path.is_file():
                    yield path
