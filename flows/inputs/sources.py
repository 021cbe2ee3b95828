"""Admission of users' pictures, videos, frames, texts and view banks to the store, checked by content."""

import shutil
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path

from dg4d_lib.errors import BadInput
from steps.artifacts.archives import EPOCH
from steps.catalog import BANK, SOURCE, TEXT
from steps.contract import ArtifactRef
from steps.sources.banks import BANK_JSON, check_sheet, read_index
from steps.sources.media_types import PICTURE_SUFFIXES, check_media, check_still
from steps.store.artifact_store import ArtifactStore
from steps.store.files import room_for

PICTURES = frozenset(PICTURE_SUFFIXES)
VIDEOS = frozenset([".mp4", ".m4v", ".mov", ".webm", ".mkv", ".avi", ".gif"])
ALWAYS_MOVING = VIDEOS - {".gif"}  # a GIF may hold a single picture
LONGEST_TEXT = 1000  # characters
LARGEST_FILE_BYTES = 8 * 2**30  # of a picture or a video, which is copied into the store before it is decoded


def resolve_inside(folder: Path, name: str, what: str) -> Path:
    """Return the path of a file or folder that a manifest names, in or below the manifest's folder.

    Args:
        folder: of the manifest.
        name: as written in the manifest.
        what: kind of the name, for messages.

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
            f"{what} {name!r} leads out of the folder {folder}; only files in or below it are allowed, also through "
            "links: copy the file there"
        )
    return path


def check_file(path: Path, wanted: str = "give a picture or a video") -> None:
    """Refuse files that are not a picture, a video or a zip of frames.

    Args:
        path: file that is read.
        wanted: advice where it is missing or empty.

    Raises:
        BadInput: says what the file is and what to give.
    """
    if not path.exists():
        raise BadInput(f"{path} does not exist; {wanted}")
    if path.is_dir():
        raise BadInput(
            f"{path} is a folder; give one file, or `dg4d batch {path} -o DIR` for everything in it, "
            f"or `--video {path}` if it holds the frames of a video"
        )
    if not path.is_file():
        raise BadInput(f"{path} is not a regular file; {wanted}")
    size = path.stat().st_size
    if size == 0:
        raise BadInput(f"{path} is empty (0 bytes); {wanted}")
    if size > LARGEST_FILE_BYTES:
        raise BadInput(f"{path} has {size} bytes; at most {LARGEST_FILE_BYTES} are read: shorten it")
    try:
        check_media(path)
    except BadInput as error:
        raise BadInput(f"{path}: {error}") from error


def check_video(path: Path, wanted: str = "give a picture or a video") -> None:
    """Refuse files as `check_file` does, and folders with fewer than two frames.

    Args:
        path: file or folder that is read.
        wanted: advice where it is missing or empty.

    Raises:
        BadInput: says what is wrong and what to give.
    """
    if not path.is_dir():
        check_file(path, wanted)
    elif len(frames := list_frames(path)) < 2:
        raise BadInput(
            f"{path} holds {len(frames) or 'no'} picture{'s' * (len(frames) != 1)}; a folder of frames needs two or "
            "more, numbered in playing order"
        )
    else:
        _check_files(path, frames)
        for frame in frames:
            check_still(frame)


def check_option(path: Path, option: str, wanted: str = "give a video or a folder of frames") -> None:
    """Refuse the file or folder of an option as `check_video` does.

    Args:
        path: file or folder that is read.
        option: that it was given with.
        wanted: advice where it is missing or empty.

    Raises:
        BadInput: names the option; says what is wrong and what to give.
    """
    try:
        check_video(path, wanted)
    except BadInput as error:
        raise BadInput(f"{option}: {error}") from error


def check_still_file(path: Path, option: str) -> None:
    """Refuse anything but one picture.

    Args:
        path: file that is read.
        option: that it was given with.

    Raises:
        BadInput: says what the file is and what to give.
    """
    wanted = "give one gray picture of the first frame (PNG, TIFF, EXR)"
    if path.is_dir():
        raise BadInput(f"{option}: {path} is a folder; {wanted}")
    try:
        check_file(path, wanted)
    except BadInput as error:
        raise BadInput(f"{option}: {error}") from error
    try:
        check_still(path)
    except BadInput as error:
        raise BadInput(f"{option}: {path.name} is not a picture; {wanted}") from error


def check_text(text: str) -> None:
    """Refuse an empty or a long prompt.

    Raises:
        BadInput: says what to give.
    """
    if not text.strip():
        raise BadInput('--text is empty; say what to make, for example --text "a red dragon"')
    if len(text) > LONGEST_TEXT:
        raise BadInput(f"--text has {len(text)} characters; give at most {LONGEST_TEXT}, models read about 60 words")


def list_frames(folder: Path) -> list[Path]:
    """List the pictures directly in a folder, by name."""
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in PICTURES and p.is_file() and p.name[0] != ".")


def put_source(path: Path, store: ArtifactStore) -> ArtifactRef:
    """Store a picture, a video, or a folder of frames.

    Raises:
        BadInput: the path is not one of these.
        DiskFull: the disk is full.
    """
    check_video(path)
    if path.is_dir():
        return put_zip({frame.name: frame for frame in list_frames(path)}, SOURCE.media_type, store)
    return store.put(path, SOURCE.media_type)


def put_still(path: Path, store: ArtifactStore) -> ArtifactRef:
    """Store a picture.

    Raises:
        BadInput: the file is not a picture.
        DiskFull: the disk is full.
    """
    check_still_file(path, "the picture")
    return store.put(path, SOURCE.media_type)


def put_text(text: str, store: ArtifactStore) -> ArtifactRef:
    """Store a prompt, with single spaces between its words."""
    return store.put_bytes(single_spaced(text).encode(), TEXT.media_type)


def single_spaced(text: str) -> str:
    """Join words with single spaces."""
    return " ".join(text.split())


def put_bank(path: Path, store: ArtifactStore) -> ArtifactRef:
    """Store a bank of ground-truth views as a zip of `bank.json` and the pictures that it names.

    Raises:
        BadInput: it is not a bank.
        DiskFull: the disk is full.
    """
    files = check_bank(path)
    return put_zip({file.relative_to(path).as_posix(): file for file in files}, BANK.media_type, store)


def put_zip(files: Mapping[str, Path], media_type: str, store: ArtifactStore) -> ArtifactRef:
    """Store files as an uncompressed zip, in their order; equal files under equal names give equal bytes.

    Raises:
        BadInput: a file cannot be read.
        DiskFull: the disk is full.
    """
    with tempfile.TemporaryDirectory(prefix="dg4d-zip-") as scratch, room_for(Path(scratch)):
        path = Path(scratch) / "files.zip"
        with zipfile.ZipFile(path, "w") as archive:
            for name, file in files.items():
                entry = zipfile.ZipInfo(name, EPOCH)
                entry.external_attr = 0o644 << 16
                try:
                    entry.file_size = file.stat().st_size  # decides on ZIP64
                    source = file.open("rb")
                except OSError as error:
                    raise BadInput(f"{file} cannot be read: {error.strerror}") from error
                with source, archive.open(entry, "w") as target:
                    shutil.copyfileobj(source, target)
        return store.put(path, media_type)


def check_bank(folder: Path) -> list[Path]:
    """Return `bank.json` and every picture that it names, by name.

    Raises:
        BadInput: one is missing, leads out of the folder, or has another format.
    """
    about = folder / BANK_JSON
    if not about.is_file():
        raise BadInput(f"{folder} is not a bank of ground-truth views: it has no file {BANK_JSON}")
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
    """Refuse links that lead out of a folder, and more bytes than are read."""
    for file in files:
        resolve_inside(folder, file.relative_to(folder).as_posix(), "the file")
    size = sum(file.stat().st_size for file in files)
    if size > LARGEST_FILE_BYTES:
        raise BadInput(f"the files in {folder} have {size} bytes together; at most {LARGEST_FILE_BYTES} are read")
