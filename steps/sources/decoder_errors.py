"""Conversion of decoders' exceptions for damaged files to `BadInput`."""

import lzma
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager

from av.error import FFmpegError

from dg4d_lib.errors import BadInput
from steps.store.files import NO_SPACE

DAMAGED = (  # exceptions of PyAV, OpenImageIO, Pillow, zipfile and our parsers for bytes that break the format
    FFmpegError, OSError, EOFError, SyntaxError, ValueError, LookupError, ArithmeticError, RuntimeError,
    struct.error, zlib.error, lzma.LZMAError, zipfile.BadZipFile, zipfile.LargeZipFile,
)  # fmt: skip


@contextmanager
def damage_is_bad_input(what: str) -> Iterator[None]:
    """Turn decoders' exceptions for damaged files into `BadInput`; a full disk stays an `OSError`.

    Raises:
        BadInput: names the file, the decoder's reason and the remedy.
    """
    try:
        yield
    except MemoryError:  # PyAV's is an FFmpegError too
        raise
    except DAMAGED as error:
        if isinstance(error, OSError) and error.errno in NO_SPACE and not isinstance(error, FFmpegError):
            raise
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        reason = type(error).__name__ if "/" in reason else reason
        raise BadInput(f"{what} is cut off or broken ({reason}); copy or export it again") from error
