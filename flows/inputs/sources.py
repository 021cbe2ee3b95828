"""Admission of users' pictures, videos, frames, words and banks to the store: checked by content first."""

import tempfile
import zipfile
from pathlib import Path

from dg4d_lib.errors import BadInput
from flows.engine.merging import add
from steps.catalog import BANK, SOURCE, TEXT
from steps.contract import ArtifactRef
from steps.sources.banks import BANK_JSON, check_sheet, read_index
from steps.sources.media_types import PICTURE_SUFFIXES, check_media, check_still
from steps.store.artifact_store import ArtifactStore
from steps.store.files import room_for

PICTURES = frozenset(PICTURE_SUFFIXES)
VIDEOS = frozenset([".mp4", ".m4v", ".mov", ".webm", ".mkv", ".avi", ".gif"])
ALWAYS_MOVING = VIDEOS - {".gif"}  # a GIF may be one picture
LONGEST_TEXT = 1000  # characters
LARGEST_FILE_BYTES = 8 * 2**30  # of a picture or a video, which is copied into the store before it is decoded


def inside(folder: Path, name: str, what: str) -> Path:
    """A file or folder that somebody else's list names, in or below the folder of that list.

    Args:
        folder: of the list.
        name: as the list has it.
        what: how messages call it.

    Raises:
        BadInput: it leads out of the folder, by "..", as an absolute path, or by a link.
    """
    path = folder / name
    try:
        stays = "\0" not in name and path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):  # a circle of links
        stays = False
    if not stays:
        raise BadInput(
            f"{what} {name!r} leads out of the folder {folder}: what it names must lie there or below, and links may "
            "not lead out; copy the file there"
        )
    return path


def check_file(path: Path) -> None:
    """Refuse what is no picture, video or zip of frames, before any work.

    Raises:
        BadInput: says what it is and what to give.
    """
    if not path.exists():
        raise BadInput(f"{path} does not exist; give a picture or a video")
    if path.is_dir():
        raise BadInput(
            f"{path} is a folder; give one file, or `dg4d batch {path} -o DIR` for everything in it, "
            f"or `--video {path}` if it holds the frames of a video"
        )
    if not path.is_file():
        raise BadInput(f"{path} is not a regular file; give a picture or a video")
    if path.stat().st_size == 0:
        raise BadInput(f"{path} is empty (0 bytes); give a picture or a video")
    if path.stat().st_size > LARGEST_FILE_BYTES:
        raise BadInput(f"{path} has {path.stat().st_size} bytes; at most {LARGEST_FILE_BYTES} are read: shorten it")
    try:
        check_media(path)
    except BadInput as error:
        raise BadInput(f"{path}: {error}") from error


def check_video(path: Path) -> None:
    """Refuse what is no video: a file as above, or a folder with at least two pictures.

    Raises:
        BadInput: says what it is and what to give.
    """
    if not path.is_dir():
        check_file(path)
    elif len(frames := frames_of(path)) < 2:
        raise BadInput(
            f"{path} holds {len(frames) or 'no'} picture{'s' * (len(frames) != 1)}; a folder of frames needs two or "
            "more, numbered in the order in which they play"
        )
    else:
        _check_files(path, frames)
        for frame in frames:
            check_still(frame)


def check_bank(path: Path) -> None:
    """Refuse a folder without a sound `bank.json`, or without the sheets that it names.

    Raises:
        BadInput: says what is missing or wrong.
    """
    _files_of_bank(path)


def check_text(text: str) -> None:
    """Refuse words that say nothing, or too many.

    Raises:
        BadInput: says what to give.
    """
    if not text.strip():
        raise BadInput('--text is empty; say what to make, for example --text "a red dragon"')
    if len(text) > LONGEST_TEXT:
        raise BadInput(f"--text has {len(text)} characters; give at most {LONGEST_TEXT}, models read about 60 words")


def frames_of(folder: Path) -> list[Path]:
    """The pictures directly in a folder, by name."""
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in PICTURES and p.is_file() and p.name[0] != ".")


def put_source(path: Path, store: ArtifactStore) -> ArtifactRef:
    """Keep a picture, a video, or the pictures in a folder of frames; nothing else enters the store.

    Raises:
        BadInput: it is none of these.
        DiskFull: there is no room.
    """
    check_video(path)
    if path.is_dir():
        return _put_files(frames_of(path), path, SOURCE.media_type, store)
    return store.put(path, SOURCE.media_type)


def put_text(text: str, store: ArtifactStore) -> ArtifactRef:
    """Keep words, as `plain` gives them.

    Raises:
        DiskFull: there is no room.
    """
    return store.put_bytes(plain(text).encode(), TEXT.media_type)


def plain(text: str) -> str:
    """Words with single spaces between them."""
    return " ".join(text.split())


def put_bank(path: Path, store: ArtifactStore) -> ArtifactRef:
    """Keep a bank as a stored zip: its `bank.json` and the pictures that it names, and nothing else of the folder.

    Raises:
        BadInput: it is no bank.
        DiskFull: there is no room.
    """
    return _put_files(_files_of_bank(path), path, BANK.media_type, store)


def _files_of_bank(folder: Path) -> list[Path]:
    """Return `bank.json` and every picture that it names, by name.

    Raises:
        BadInput: one is missing, leads out of the folder, or is something else.
    """
    about = folder / BANK_JSON
    if not about.is_file():
        raise BadInput(f"{folder} is not a bank of true views: it has no file {BANK_JSON}")
    _check_files(folder, [about])
    index = read_index(about)
    sheets = {folder / view.file for view in index.views}
    files = sorted({about, *sheets})
    if missing := [file for file in files if not file.is_file()]:
        raise BadInput(f"{about} names {missing[0].relative_to(folder)}, which is not there; copy the picture there")
    _check_files(folder, files)
    for sheet in sorted(sheets):
        check_sheet(sheet, index)
    return files


def _check_files(folder: Path, files: list[Path]) -> None:
    """Refuse links that lead out of a folder, and more than can be meant."""
    for file in files:
        inside(folder, file.relative_to(folder).as_posix(), "the file")
    size = sum(file.stat().st_size for file in files)
    if size > LARGEST_FILE_BYTES:
        raise BadInput(f"the files in {folder} have {size} bytes together; at most {LARGEST_FILE_BYTES} are read")


def _put_files(files: list[Path], folder: Path, media_type: str, store: ArtifactStore) -> ArtifactRef:
    """Equal files under equal names give equal bytes."""
    with tempfile.TemporaryDirectory(prefix="dg4d-source-") as scratch, room_for(Path(scratch)):
        path = Path(scratch) / "files.zip"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
            for file in files:
                add(archive, file.relative_to(folder).as_posix(), file.read_bytes())
        return store.put(path, media_type)
