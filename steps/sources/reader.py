"""Reader of source files, recognized by content: a picture, a video, or a zip of numbered pictures."""

import shutil
import time
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.input_settings import SubjectSettings
from dg4d_lib.video.downscaling import downscale_in_bands
from steps.sources.clips import (
    MOST_DECODED,
    MOST_DECODING_S,
    MOST_FRAMES,
    Clip,
    KeptFrames,
    sampled_frames,
    thinned_rate,
    uneven_note,
)
from steps.sources.decode_limit import DecodeLimit
from steps.sources.decoder_errors import damage_is_bad_input
from steps.sources.gif import check_first_frame
from steps.sources.media_types import (
    ALLOWED,
    SNIFFED_BYTES,
    check_no_scene,
    container_of,
    frame_suffix,
    is_animated_png,
    is_frame_name,
    is_zip,
    still_suffix,
)
from steps.sources.stills import StillPicture, read_still
from steps.sources.webp import AnimatedWebp, is_animated

FOLDER_FPS = 12.0  # assumed for numbered pictures: drawn animation usually holds a drawing for two frames of 24
STILL_FPS = 1.0  # placeholder, as a picture is never played
OPAQUE_ALPHA = 250 / 255  # alpha channels at or above this everywhere are ignored
MOST_ENTRY_BYTES = 512 * 2**20  # of one unpacked picture of a zip
NAMED_AT_MOST = 8  # missing frames that a message lists
MOST_DIGITS = 18  # of a frame number; cameras write time stamps of up to 17
NAME_SHOWN = 40  # characters of a long name in a message


@dataclass(frozen=True)
class Source:
    """A decoded source file.

    Attributes:
        frames: straight sRGB and alpha in [0, 1], upright; a picture is one frame.
        has_alpha: True if some pixel is not opaque.
        fps: frames per second after sampling, which keeps the speed of the motion.
        kind: picture or video.
        size: width and height of the upright file in pixels, before shrinking.
        count: frames of the file, of which `frames` may be a part.
        notes: sentences for the report about dropped frames and assumptions.
    """

    frames: Float[Tensor, "t h w 4"]
    has_alpha: bool
    fps: float
    kind: Literal["picture", "video"]
    size: tuple[int, int]
    count: int
    notes: tuple[str, ...] = ()


def read_source(
    path: Path, scratch: Path, max_frames: int, max_decode_gb: float = SubjectSettings().max_decode_gb
) -> Source:
    """Decode a user's file.

    Args:
        path: file with any name.
        scratch: existing folder for links and unpacked pictures.
        max_frames: number of frames to keep of a video, as `sampled_frames` chooses them; at least 2.
        max_decode_gb: memory limit in GiB, which includes the decoded frames.

    Raises:
        BadInput: the file is empty, broken, too small, too large, or of an unknown format.
    """
    if not path.is_file():
        raise BadInput(f"{path.name} is not a file; give {ALLOWED}")
    if path.stat().st_size == 0:
        raise BadInput(f"the file is empty (0 bytes); give {ALLOWED}")
    with path.open("rb") as file:
        head = file.read(SNIFFED_BYTES)
    limit = DecodeLimit(max_decode_gb)
    with limit.enforced("the file"), damage_is_bad_input("the file"):
        return _decode(path, head, scratch, max_frames, limit)


def _decode(path: Path, head: bytes, scratch: Path, max_frames: int, limit: DecodeLimit) -> Source:
    """Decode a file by its first bytes; a file that is also valid in another format is not refused."""
    if is_zip(head):
        return _read_zip(path, scratch, max_frames, limit)
    if is_animated(head):
        return _read_webp(path, max_frames, limit)
    container = "apng" if is_animated_png(head) else container_of(head)
    if container:
        return _read_clip(path, container, max_frames, limit)
    link = scratch / f"source{still_suffix(head)}"  # read_still selects the decoder by the suffix
    link.unlink(missing_ok=True)
    link.symlink_to(path.resolve())
    picture = read_still(link, "the picture", limit)
    return _picture(picture.pixels[None], picture.has_alpha, picture.size, picture.notes)


def _picture(
    frames: Float[Tensor, "1 h w 4"], has_alpha: bool, size: tuple[int, int], notes: tuple[str, ...] = ()
) -> Source:
    return Source(frames, has_alpha and _is_transparent(frames), STILL_FPS, "picture", size, 1, notes)


def _video(
    frames: Float[Tensor, "t h w 4"],
    has_alpha: bool,
    fps: float,
    count: int,
    size: tuple[int, int],
    notes: tuple[str, ...] = (),
) -> Source:
    kept = frames.shape[0]
    if kept < count:
        notes = (*notes, f"{kept} of the video's {count} frames are used, evenly spaced; they play at the same speed.")
    rate = thinned_rate(fps, count, kept)
    return Source(frames, has_alpha and _is_transparent(frames), rate, "video", size, count, notes)


def _is_transparent(frames: Float[Tensor, "t h w 4"]) -> bool:
    return bool((frames[..., 3] < OPAQUE_ALPHA).any())


def _read_clip(path: Path, container: str, max_frames: int, limit: DecodeLimit) -> Source:
    if container == "gif":
        check_first_frame(path)
    clip = Clip(path, container, limit)
    if clip.count == 1 and container in ("gif", "apng"):
        return _picture(*clip.read([0]), clip.size)
    _need_two(clip.count, "the video")
    frames, has_alpha = clip.read(sampled_frames(clip.count, max_frames))
    lost = clip.announced - clip.count
    notes = (f"The video declares {clip.announced} frames; {clip.count} can be read.",) if lost > 1 else ()
    return _video(frames, has_alpha, clip.fps, clip.count, clip.size, (*notes, *clip.notes))


def _read_webp(path: Path, max_frames: int, limit: DecodeLimit) -> Source:
    limit.require_file(path, "the WebP animation")
    with path.open("rb") as file:
        clip = AnimatedWebp(file, limit)
        kept = KeptFrames(sampled_frames(len(clip), max_frames), "the WebP animation")
        for i, frame in enumerate(clip):
            if i in kept:
                kept.add(i, downscale_in_bands(frame, kept.side))
    size = clip.width, clip.height
    if len(clip) == 1:
        return _picture(kept.frames, True, size)
    return _video(kept.frames, True, clip.fps, len(clip), size, uneven_note(clip.times))


def _need_two(count: int, what: str) -> None:
    if count < 2:
        raise BadInput(
            f"{what} has {'no frame' if count == 0 else 'only one frame'}; a video needs at least two: "
            "give a longer one, or a picture"
        )


def _read_zip(path: Path, scratch: Path, max_frames: int, limit: DecodeLimit) -> Source:
    try:
        with zipfile.ZipFile(path) as archive:
            check_no_scene(archive.namelist())
            frame_files = (info for info in archive.infolist() if not info.is_dir() and is_frame_name(info.filename))
            entries = _numbered(list(frame_files))
            frames, any_alpha, size, notes = _zipped_frames(archive, entries, scratch, max_frames, limit)
    except (zipfile.BadZipFile, RuntimeError, NotImplementedError, EOFError) as error:
        raise BadInput("the zip of frames is broken or encrypted; pack it again") from error
    note = f"A folder of frames has no frame rate; {FOLDER_FPS:g} per second are assumed."
    return _video(frames, any_alpha, FOLDER_FPS, len(entries), size, (note, *notes))


def _zipped_frames(
    archive: zipfile.ZipFile, entries: list[zipfile.ZipInfo], scratch: Path, max_frames: int, limit: DecodeLimit
) -> tuple[Float[Tensor, "t h w 4"], bool, tuple[int, int], tuple[str, ...]]:
    """Decode every frame, so that none is broken; return the selected ones, True if one has alpha, size and notes."""
    kept, any_alpha = KeptFrames(sampled_frames(len(entries), max_frames), "the folder of frames"), False
    notes: tuple[str, ...] = ()
    first, pixels, start = (0, 0), 0, time.monotonic()
    for i, info in enumerate(entries):
        picture = _zipped_picture(archive, info, scratch, limit, kept.side)
        width, height = picture.size
        first = first if i else picture.size
        if picture.size != first:
            raise BadInput(
                f"the frames have different sizes: {info.filename} is {width} x {height} "
                f"pixels, {entries[0].filename} is {first[0]} x {first[1]}; export all at one size"
            )
        pixels += width * height
        if pixels > MOST_DECODED or time.monotonic() - start > MOST_DECODING_S:
            raise BadInput(
                f"the folder of frames has more than {MOST_DECODED // 10**9} billion pixels in all, or takes more than "
                f"{MOST_DECODING_S:g} s to read; leave some frames out, or export them smaller"
            )
        if i in kept:
            kept.add(i, picture.pixels)
            any_alpha, notes = any_alpha or picture.has_alpha, notes or picture.notes
    return kept.frames, any_alpha, first, notes


def _numbered(entries: list[zipfile.ZipInfo]) -> list[zipfile.ZipInfo]:
    """Sort entries by the number at the end of their names; by name where none has a number."""
    _need_two(len(entries), "the folder of frames")
    if len(entries) > MOST_FRAMES:
        raise BadInput(
            f"the folder of frames has {len(entries)} pictures; at most {MOST_FRAMES} are read: leave some out"
        )
    by_number: dict[int, zipfile.ZipInfo] = {}
    without: list[zipfile.ZipInfo] = []
    same = None
    for info in entries:
        number = _number_at_end(Path(info.filename).stem)
        if number is None:
            without.append(info)
        elif by_number.setdefault(number, info) is not info:
            same = same or (by_number[number].filename, info.filename)
    without.sort(key=lambda info: info.filename)
    if not by_number:
        return without
    if without:
        name = without[0].filename
        raise BadInput(f"the frame {name} has no number at the end of its name while others do; rename or remove it")
    if same:
        raise BadInput(f"{same[0]} and {same[1]} have the same number; keep one sequence per folder")
    first, last = min(by_number), max(by_number)
    if last - first + 1 != len(by_number):
        gaps = [number for number in range(first, min(last, first + 10**6)) if number not in by_number]
        listed = ", ".join(f"{number}" for number in gaps[:NAMED_AT_MOST])
        more = f" and {len(gaps) - NAMED_AT_MOST} more" if len(gaps) > NAMED_AT_MOST else ""
        raise BadInput(
            f"frames are missing between {first} and {last}: {listed}{more}; add them, or number without gaps"
        )
    return [by_number[number] for number in sorted(by_number)]


def _number_at_end(name: str) -> int | None:
    digits = name[len(name.rstrip("0123456789")) :]
    if len(digits) > MOST_DIGITS:
        raise BadInput(
            f"the number at the end of the frame's name {name[:NAME_SHOWN]}... has {len(digits)} digits; "
            f"at most {MOST_DIGITS} are read: rename it"
        )
    return int(digits) if digits else None


def _zipped_picture(
    archive: zipfile.ZipFile, info: zipfile.ZipInfo, scratch: Path, limit: DecodeLimit, longest: int
) -> StillPicture:
    """Unpack one frame into `scratch` and decode it as `read_still` does."""
    if info.file_size > MOST_ENTRY_BYTES:
        raise BadInput(f"{info.filename} unpacks to {info.file_size} bytes; at most {MOST_ENTRY_BYTES} are read")
    with archive.open(info) as content:
        head = content.read(SNIFFED_BYTES)
        target = scratch / f"frame{frame_suffix(info.filename, head)}"
        with target.open("wb") as file:
            file.write(head)
            shutil.copyfileobj(content, file)
    picture = read_still(target, f"the frame {info.filename}", limit, longest)
    target.unlink()
    return picture
