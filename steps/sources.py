"""What users hand in: a picture, a video, or a zip of numbered pictures; told apart by content, never by name."""

import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.video.framing import shrink
from steps.clips import LARGEST_SIDE, MOST_FRAMES, Clip, evenly_spaced, thinned_rate, work_side
from steps.media_types import ALLOWED, SNIFFED_BYTES, container_of, is_animated_png, is_frame_name, is_zip, still_suffix
from steps.stills import decode_still, read_still
from steps.webp import AnimatedWebp, is_animated

FOLDER_FPS = 12.0  # pictures in a folder have no rate; drawn animation usually holds a drawing for two frames of 24
STILL_FPS = 1.0  # of a picture; it is never played
MOST_ENTRY_BYTES = 512 * 2**20  # of one unpacked picture of a zip
NAMED_AT_MOST = 8  # missing frames that a message lists


@dataclass(frozen=True)
class Source:
    """A user's file, decoded.

    Attributes:
        frames: straight sRGB and alpha in [0, 1], upright; a picture is one frame.
        has_alpha: whether the alpha says anything; without it, it is 1 everywhere.
        fps: frames per second of what is left after sampling; the duration stays.
        kind: what it was.
        notes: sentences for the report: what was left out or assumed.
    """

    frames: Float[Tensor, "t h w 4"]
    has_alpha: bool
    fps: float
    kind: Literal["picture", "video"]
    notes: tuple[str, ...] = ()


def read_source(path: Path, scratch: Path, max_frames: int) -> Source:
    """Decode whatever a user gave.

    Args:
        path: the file; its name does not matter.
        scratch: an existing folder for links and unpacked pictures.
        max_frames: frames that are kept of a video, evenly spaced, the first and the last among them; at least 2.

    Raises:
        BadInput: it is empty, broken, too small, too large, or nothing that can be read; says what to do.
    """
    if not path.is_file():
        raise BadInput(f"{path.name} is not a file; give {ALLOWED}")
    if path.stat().st_size == 0:
        raise BadInput(f"the file is empty (0 bytes); give {ALLOWED}")
    with path.open("rb") as file:
        head = file.read(SNIFFED_BYTES)
    if is_zip(head):
        return _read_zip(path, scratch, max_frames)
    if is_animated(head):
        return _read_webp(path, scratch, max_frames)
    container = "apng" if is_animated_png(head) else container_of(head)
    if container:
        return _read_clip(path, container, max_frames)
    picture, has_alpha = read_still(_link(path, still_suffix(head), scratch), "the picture")
    return _picture(picture[None], has_alpha)


def _picture(frames: Float[Tensor, "1 h w 4"], has_alpha: bool, notes: tuple[str, ...] = ()) -> Source:
    return Source(frames, has_alpha and _says_something(frames), STILL_FPS, "picture", notes)


def _video(
    frames: Float[Tensor, "t h w 4"], has_alpha: bool, fps: float, count: int, notes: tuple[str, ...] = ()
) -> Source:
    kept = frames.shape[0]
    if kept < count:
        notes = (*notes, f"{kept} of the video's {count} frames are used, evenly spaced; it lasts as long as before.")
    return Source(frames, has_alpha and _says_something(frames), thinned_rate(fps, count, kept), "video", notes)


def _says_something(frames: Float[Tensor, "t h w 4"]) -> bool:
    """Whether an alpha channel is more than decoration: some pixel is not opaque."""
    return bool((frames[..., 3] < 250 / 255).any())


def _read_clip(path: Path, container: str, max_frames: int) -> Source:
    clip = Clip(path, container)
    if clip.count < 2 and container in ("gif", "apng") and clip.count:
        return _picture(*clip.read([0]))
    _need_two(clip.count, "the video")
    frames, has_alpha = clip.read(evenly_spaced(clip.count, max_frames))
    lost = clip.announced - clip.count
    notes = (f"The video promises {clip.announced} frames; {clip.count} can be read.",) if lost > 1 else ()
    return _video(frames, has_alpha, clip.fps, clip.count, notes)


def _read_webp(path: Path, scratch: Path, max_frames: int) -> Source:
    clip = AnimatedWebp(path.read_bytes(), scratch)
    wanted = evenly_spaced(len(clip), max_frames)
    frames = [shrink(frame[None], work_side(len(wanted)))[0] for i, frame in enumerate(clip) if i in wanted]
    if len(clip) == 1:
        return _picture(frames[0][None], True)
    _need_two(len(clip), "the WebP animation")
    return _video(torch.stack(frames), True, clip.fps, len(clip))


def _need_two(count: int, what: str) -> None:
    if count < 2:
        raise BadInput(
            f"{what} has {'no frame' if count == 0 else 'only one frame'}; a video needs at least two: "
            "give a longer one, or a picture"
        )


def _read_zip(path: Path, scratch: Path, max_frames: int) -> Source:
    try:
        with zipfile.ZipFile(path) as archive:
            entries = _numbered(
                [info for info in archive.infolist() if not info.is_dir() and is_frame_name(info.filename)]
            )
            wanted = evenly_spaced(len(entries), max_frames)
            side = min(LARGEST_SIDE, work_side(len(wanted)))
            frames: list[Tensor] = []
            size, any_alpha = None, False
            for i, info in enumerate(entries):
                picture, has_alpha = _zipped_picture(archive, info, scratch)
                size = size or picture.shape
                if picture.shape != size:
                    raise BadInput(
                        f"the frames have different sizes: {info.filename} is {picture.shape[1]} x {picture.shape[0]} "
                        f"pixels, {entries[0].filename} is {size[1]} x {size[0]}; export all at one size"
                    )
                if i in wanted:
                    frames.append(shrink(picture[None], side)[0])
                    any_alpha = any_alpha or has_alpha
    except (zipfile.BadZipFile, RuntimeError, NotImplementedError, EOFError) as error:
        raise BadInput("the zip of frames is broken or encrypted; pack it again") from error
    note = f"A folder of frames has no frame rate; {FOLDER_FPS:g} per second are assumed."
    return _video(torch.stack(frames), any_alpha, FOLDER_FPS, len(entries), (note,))


def _numbered(entries: list[zipfile.ZipInfo]) -> list[zipfile.ZipInfo]:
    """Entries in the order of the number at the end of their names; of their names where none has a number."""
    _need_two(len(entries), "the folder of frames")
    if len(entries) > MOST_FRAMES:
        raise BadInput(
            f"the folder of frames has {len(entries)} pictures; at most {MOST_FRAMES} are read: leave some out"
        )
    found = {info.filename: re.search(r"(\d+)$", Path(info.filename).stem) for info in entries}
    if not any(found.values()):
        return sorted(entries, key=lambda info: info.filename)
    without = sorted(name for name, number in found.items() if number is None)
    if without:
        raise BadInput(
            f"the frame {without[0]} has no number at the end of its name while others do; rename or remove it"
        )
    by_number: dict[int, zipfile.ZipInfo] = {}
    for info in entries:
        match = found[info.filename]
        number = int(match.group(1)) if match else 0
        if number in by_number:
            raise BadInput(
                f"{by_number[number].filename} and {info.filename} have the same number; keep one sequence per folder"
            )
        by_number[number] = info
    first, last = min(by_number), max(by_number)
    if last - first + 1 != len(by_number):
        gaps = [number for number in range(first, min(last, first + 10**6)) if number not in by_number]
        listed = ", ".join(f"{number}" for number in gaps[:NAMED_AT_MOST])
        more = f" and {len(gaps) - NAMED_AT_MOST} more" if len(gaps) > NAMED_AT_MOST else ""
        raise BadInput(
            f"frames are missing between {first} and {last}: {listed}{more}; add them, or number without gaps"
        )
    return [by_number[number] for number in sorted(by_number)]


def _zipped_picture(
    archive: zipfile.ZipFile, info: zipfile.ZipInfo, scratch: Path
) -> tuple[Float[Tensor, "h w 4"], bool]:
    if info.file_size > MOST_ENTRY_BYTES:
        raise BadInput(f"{info.filename} unpacks to {info.file_size} bytes; at most {MOST_ENTRY_BYTES} are read")
    content = archive.read(info)
    if not content:
        raise BadInput(f"the frame {info.filename} is empty (0 bytes); export it again")
    target = scratch / f"frame{still_suffix(content[:SNIFFED_BYTES])}"
    target.write_bytes(content)
    picture = decode_still(target, f"the frame {info.filename}")
    target.unlink()
    return picture


def _link(path: Path, suffix: str, scratch: Path) -> Path:
    """The same file under a name that tells its format."""
    link = scratch / f"source{suffix}"
    link.unlink(missing_ok=True)
    link.symlink_to(path.resolve())
    return link
