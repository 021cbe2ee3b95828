"""Outcomes that cases of the corpus must have.

A file is accepted as a picture or as a video of so many frames, or refused in a sentence that names the problem. No
case may end in a traceback, with status 1, or with anything half-written.
"""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Accepted:
    """Success: a picture is one frame."""

    kind: Literal["picture", "video"]
    frames: int


@dataclass(frozen=True)
class Refused:
    """A message that matches a pattern, and the exit status."""

    says: str
    status: int = 65


def video(frames: int) -> Accepted:
    """Return the success of a video."""
    return Accepted("video", frames)


PICTURE = Accepted("picture", 1)
BROKEN = Refused("cut off or broken|a broken|cannot be read|is broken|broken or encrypted")
SMALL = Refused("at least 32")
LONG = Refused("crop it")
LARGE = Refused(
    "million are read|claims|may not exceed|exceeds|Maximum supported|invalid image width|invalid channel count|"
    "max_decode_gb"
)
NO_SUBJECT = Refused("no subject|fully transparent|subject is|same everywhere|max_decode_gb")
ONE_FRAME = Refused("only one frame")
NO_FRAME = Refused("no frame")
CODEC = Refused("codec that is not known")
SOUND = Refused("only sound")
CHANGES = Refused("changes its frame size")
TOO_MANY = Refused("more than 9000|at most 9000|too many")
HEIC = Refused("HEIC")
AVIF = Refused("AVIF")
EMPTY = Refused("empty|0 bytes")
USD = Refused("3D scene")
UNKNOWN = Refused("not known here|text file|not a picture")
CLAIMS = Refused(f"{BROKEN.says}|{LARGE.says}")  # whoever looks first: our check of the size, or the decoder
STUMP = Refused(f"{BROKEN.says}|{UNKNOWN.says}")  # of the first bytes of a file, it is a matter of taste
