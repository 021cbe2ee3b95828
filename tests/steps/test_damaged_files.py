"""Files that are cut off or changed anywhere: only `BadInput` comes out of the parsers and decoders."""

import io
import struct
import zipfile
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from media_files import disc, save, save_clip, walk
from PIL import Image

from dg4d_lib.errors import BadInput
from steps.sources import decoder_errors
from steps.sources.decode_limit import GIB, DecodeLimit
from steps.sources.reader import read_source
from steps.sources.still_headers import read_header
from steps.sources.webp import AnimatedWebp, is_animated

FLIPS = 150
Made = tuple[str, bytes]


def survives(folder: Path, content: bytes) -> bool:
    """Return whether a file is read; everything but `BadInput` goes on to the test."""
    (folder / "file").write_bytes(content)
    try:
        read_source(folder / "file", folder, 4)
    except BadInput as error:
        assert str(folder) not in str(error)
        return False
    return True


def flipped(content: bytes, first: int = 0) -> Iterator[bytes]:
    """Change one to three bytes, most often near the beginning, where headers are."""
    random = np.random.default_rng(len(content))
    for _ in range(FLIPS):
        changed = bytearray(content)
        for _ in range(random.integers(1, 4)):
            reach = len(content) if random.random() < 0.3 else min(len(content), first + 200)
            changed[int(random.integers(first, reach))] = int(random.integers(256))
        yield bytes(changed)


@pytest.fixture(scope="module")
def webp(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("webp") / "a.webp"
    return save_clip(path, walk(3), "libwebp_anim", "bgra", lossless="1").read_bytes()


@pytest.fixture(
    scope="module", params=["png", "jpg", "jp2", "jxl", "tif", "exr", "psd", "gif", "apng", "mp4", "zip", "avif"]
)
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("made") / f"a.{request.param}"
    if request.param == "psd":
        head = b"8BPS" + struct.pack(">H6xHIIHH", 1, 3, 64, 64, 8, 3) + bytes(12)
        return head + struct.pack(">H", 0) + disc()[..., :3].transpose(2, 0, 1).tobytes()
    if request.param == "zip":
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for i, frame in enumerate(walk(3)):
                archive.writestr(f"{i}.png", save(path.with_name("frame.png"), frame).read_bytes())
        return path.read_bytes()
    if request.param == "avif":
        Image.fromarray(disc()).save(path)
        return path.read_bytes()
    codecs = {"gif": ("gif", "rgb8"), "apng": ("apng", "rgba"), "mp4": ("libx264", "yuv420p")}
    if request.param in codecs:
        return save_clip(path, walk(3), *codecs[request.param]).read_bytes()
    return save(path, disc()[..., :3], "half" if request.param == "exr" else "uint8").read_bytes()


@pytest.mark.parametrize("length", range(64))
def test_the_beginning_of_a_webp_animation_is_refused(webp: bytes, length: int, tmp_path: Path) -> None:
    assert not survives(tmp_path, webp[:length])


def test_a_webp_animation_may_end_anywhere(webp: bytes, tmp_path: Path) -> None:
    assert is_animated(webp) and survives(tmp_path, webp)
    limit = DecodeLimit(1.0)
    for length in range(len(webp)):
        is_animated(webp[:length])
        try:
            clip = AnimatedWebp(BytesIO(webp[:length]), limit)
        except BadInput:
            continue
        assert len(clip) < 3


def test_changed_bytes_of_a_webp_animation_are_refused_or_read(webp: bytes, tmp_path: Path) -> None:
    outcomes = {survives(tmp_path, content) for content in flipped(webp, first=12)}
    assert False in outcomes


def test_changed_bytes_of_any_format_are_refused_or_read(made: bytes, tmp_path: Path) -> None:
    assert survives(tmp_path, made)
    outcomes = [survives(tmp_path, content) for content in flipped(made)]
    assert False in outcomes


@pytest.mark.parametrize("share", np.linspace(0, 0.98, 15))
def test_a_file_of_any_format_may_end_anywhere(made: bytes, share: float, tmp_path: Path) -> None:
    survives(tmp_path, made[: int(share * len(made))])


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".jp2", ".jxl"])
def test_headers_of_random_bytes_never_raise(suffix: str, tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    starts = {".png": b"\x89PNG\r\n\x1a\n", ".jpg": b"\xff\xd8", ".jp2": b"\xff\x4f\xff\x51", ".jxl": b"\xff\x0a"}
    for length in (*range(60), *random.integers(60, 400, 200)):
        (tmp_path / "a").write_bytes(starts[suffix] + random.bytes(int(length)))
        read_header(tmp_path / "a", suffix)


@pytest.mark.parametrize(("width", "height"), [(64, 64), (48, 72), (640, 480), (1000, 37), (700, 500)])
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".jp2", ".jxl"])
def test_headers_tell_the_size_that_was_written(width: int, height: int, suffix: str, tmp_path: Path) -> None:
    path = save(tmp_path / f"a{suffix}", np.zeros((height, width, 3), np.uint8))
    header = read_header(path, suffix)
    assert header and (header.width, header.height) == (width, height)


@pytest.mark.parametrize("first", [b"IDAT", b"CgBI"])
def test_a_png_with_another_chunk_in_front_tells_no_size(first: bytes, tmp_path: Path) -> None:
    content = save(tmp_path / "a.png", np.zeros((64, 64, 3), np.uint8)).read_bytes()
    chunk = first + b"\x50\0\x20\x06"
    (tmp_path / "a").write_bytes(
        content[:8] + struct.pack(">I", 4) + chunk + struct.pack(">I", zlib.crc32(chunk)) + content[8:]
    )
    assert read_header(tmp_path / "a", ".png") is None
    with pytest.raises(BadInput, match="cannot be read as a picture"):
        read_source(tmp_path / "a", tmp_path, 4)


def test_the_number_of_a_frame_may_not_have_a_thousand_digits(tmp_path: Path) -> None:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for digit in "12":
            archive.writestr(digit * 5000 + ".png", b"x")
    (tmp_path / "file").write_bytes(file.getvalue())
    with pytest.raises(BadInput, match="5000 digits"):
        read_source(tmp_path / "file", tmp_path, 4)


def test_the_first_bytes_decide_what_a_polyglot_is(tmp_path: Path) -> None:
    picture = save(tmp_path / "a.png", disc()).read_bytes()
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        for i, frame in enumerate(walk(3)):
            archive.writestr(f"{i}.png", save(tmp_path / "frame.png", frame).read_bytes())
    frames = (tmp_path / "a.zip").read_bytes()
    (tmp_path / "both").write_bytes(picture + frames)
    assert zipfile.is_zipfile(tmp_path / "both")
    assert read_source(tmp_path / "both", tmp_path, 4).kind == "picture"
    (tmp_path / "both").write_bytes(frames + picture)
    assert read_source(tmp_path / "both", tmp_path, 4).kind == "video"


def test_a_full_disk_is_not_blamed_on_the_file() -> None:
    with pytest.raises(OSError, match="28"), decoder_errors.damage_is_bad_input("the file"):
        raise OSError(28, "No space left on device")


def test_memory_that_runs_out_is_bad_input_and_the_limit_goes_again() -> None:
    import resource

    before = resource.getrlimit(resource.RLIMIT_DATA)
    with pytest.raises(BadInput, match=r"subject.max_decode_gb = 0\.25"), DecodeLimit(0.25).enforced("the file"):
        np.ones(8 * GIB, np.uint8)
    assert resource.getrlimit(resource.RLIMIT_DATA) == before
