"""Memory limit for decoding a user's file: estimates from headers, enforced by a limit of the process."""

import os
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from dg4d_lib.errors import BadInput

GIB = 2**30
PAGE = os.sysconf("SC_PAGE_SIZE")  # bytes
SLACK_BYTES = 192 * 2**20  # for memory that libraries allocate at their first use
THREAD_BYTES = 10 * 2**20  # reserved for a thread's stack and mostly unused; pools have a thread per core
POOLS = 2  # thread pools: torch's and a decoder's


@dataclass(frozen=True)
class DecodeLimit:
    """Memory for decoding one source, its decoded frames included, in GiB; the setting `subject.max_decode_gb`."""

    gb: float

    def require(self, needed: float, what: str, width: int, height: int) -> None:
        """Refuse a picture that needs more bytes, before it is decoded; `what` names it in messages.

        Raises:
            BadInput: says size, estimate, setting and remedy.
        """
        if needed > self.gb * GIB:
            raise BadInput(
                f"{what} is {width} x {height} pixels and takes about {needed / GIB:.2f} GiB of memory to decode; "
                f"subject.max_decode_gb allows {self.gb:g}: give it smaller or as an 8-bit PNG, or raise the setting "
                f"with --set subject.max_decode_gb={_rounded_up(needed / GIB):g}"
            )

    def require_file(self, path: Path, what: str) -> None:
        """Refuse a file that must be in memory as a whole and is larger than the limit.

        Raises:
            BadInput: says size, setting and remedy.
        """
        size = path.stat().st_size / GIB
        if size > self.gb:
            raise BadInput(
                f"{what} has {size:.2f} GiB and must be in memory at once; subject.max_decode_gb allows {self.gb:g}: "
                f"give a smaller file, or raise the setting with --set subject.max_decode_gb={_rounded_up(size):g}"
            )

    @contextmanager
    def enforced(self, what: str) -> Iterator[None]:
        """Make allocations beyond the limit fail in the block, in all threads; Linux only.

        Raises:
            BadInput: memory ran out in the block.
        """
        soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
        most = _data_bytes() + round(self.gb * GIB) + SLACK_BYTES + POOLS * THREAD_BYTES * (os.cpu_count() or 1)
        tightened = sys.platform == "linux" and (soft == resource.RLIM_INFINITY or most < soft)
        if tightened:
            resource.setrlimit(resource.RLIMIT_DATA, (most, hard))
        try:
            yield
        except MemoryError as error:
            raise BadInput(
                f"{what} takes more memory to decode than subject.max_decode_gb = {self.gb:g} allows (GiB): "
                f"give it smaller, or raise the setting with --set subject.max_decode_gb={2 * self.gb:g}"
            ) from error
        finally:
            if tightened:
                resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def _data_bytes() -> int:
    """Return the size of the process's data segment, which `RLIMIT_DATA` bounds."""
    statm = Path("/proc/self/statm")
    return int(statm.read_text().split()[5]) * PAGE if statm.exists() else 0


def _rounded_up(gib: float) -> float:
    return -(-gib * 1.1 // 0.25) * 0.25
