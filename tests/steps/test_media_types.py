import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
from media_files import disc, save, save_clip, save_zip, walk

from dg4d_lib.errors import BadInput
from steps.sources.media_types import check_arrays, check_media, check_still, is_text

SECRETS = {
    "passwd": b"root:x:0:0:root:/root:/bin/bash\n",
    "key": b"-----BEGIN OPENSSH PRIVATE KEY-----\nb3BlbnNzaC1rZXktdjEAAAAABG5vbmUAAAA\n",
    "environ": b"HOME=/root\0PATH=/usr/bin\0TOKEN=secret\0",
    "database": b"SQLite format 3\0" + bytes(range(256)) * 8,
    "program": b"\x7fELF\x02\x01\x01" + bytes(64),
    "word that a box is called": b"the free software song\n",
    "letters of a bitmap": b"BM password: hunter2\n",
    "letters of a bitmap in a binary": b"BM" + bytes(range(255, 0, -1)),
    "letters of a pixmap": b"P6 and P5 are passwords\n",
    "letters of a sequence": b"8BPS OggS\n",
    "letters of a stream": (b"G" + b"o" * 187) * 3,
    "pickle": b"\x80\x04\x95" + bytes(40),
}


@pytest.mark.parametrize("content", SECRETS.values(), ids=SECRETS)
def test_a_file_that_is_no_medium_is_refused_with_what_may_be_given(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(BadInput, match=r"whatever its name says; give pictures \(PNG"):
        check_media(tmp_path / "a.png")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".bmp", ".exr", ".hdr", ".webp", ".ppm"])
def test_pictures_are_recognized_whatever_they_are_called(tmp_path: Path, suffix: str) -> None:
    save(tmp_path / f"a{suffix}", disc()[..., :3]).rename(tmp_path / "secret.txt")
    check_media(tmp_path / "secret.txt")
    check_still(tmp_path / "secret.txt")


def test_a_pixmap_that_is_text_from_end_to_end_is_a_picture(tmp_path: Path) -> None:
    (tmp_path / "a.ppm").write_bytes(b"P6 # gray\n32 32\n255\n" + b"@" * 3072)
    check_media(tmp_path / "a.ppm")


@pytest.mark.parametrize(
    ("name", "codec", "pixels"),
    [
        ("a.mp4", "libx264", "yuv420p"),
        ("a.mov", "png", "rgba"),
        ("a.mkv", "ffv1", "bgra"),
        ("a.webm", "libvpx", "yuv420p"),
        ("a.avi", "mpeg4", "yuv420p"),
        ("a.ts", "mpeg2video", "yuv420p"),
        ("a.gif", "gif", "rgb8"),
        ("a.apng", "apng", "rgba"),
    ],
)
def test_videos_are_recognized_and_are_no_stills(tmp_path: Path, name: str, codec: str, pixels: str) -> None:
    path = save_clip(tmp_path / name, walk(3), codec, pixels, 25)
    check_media(path)
    if name != "a.apng":  # its first frame is a PNG like any other
        with pytest.raises(BadInput, match=rf"^{name}: the file is"):
            check_still(path)


def test_a_zip_of_frames_is_recognized_with_what_systems_add(tmp_path: Path) -> None:
    path = save_zip(tmp_path / "a.zip", {"0.png": disc(), "1.png": disc(), "__MACOSX/._0.png": disc()}, tmp_path)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("Thumbs.db", b"x")
        archive.writestr(".DS_Store", b"x")
    check_media(path)


def packed(*entries: tuple[str, bytes]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in entries:
            archive.writestr(name, content)
    return file.getvalue()


PNG = b"\x89PNG\r\n\x1a\n"
ZIPS = {
    "holds no pictures": packed(),
    "holds 1 picture;": packed(("0.png", PNG)),
    "holds 'word/document.xml'": packed(("0.png", PNG), ("1.png", PNG), ("word/document.xml", b"<xml>")),
    "the frame 1.png: the file is a text file": packed(("0.png", PNG), ("1.png", b"root:x:0:0")),
    "the frame 1.png is empty": packed(("0.png", PNG), ("1.png", b"")),
    "broken or encrypted": packed(("0.png", PNG), ("1.png", PNG))[:-30],
}


@pytest.mark.parametrize(("says", "content"), ZIPS.items(), ids=ZIPS)
def test_other_zips_are_refused(tmp_path: Path, says: str, content: bytes) -> None:
    (tmp_path / "a.zip").write_bytes(content)
    with pytest.raises(BadInput, match=says):
        check_media(tmp_path / "a.zip")


def test_numpy_archives_are_told_from_other_zips(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", vertices=np.zeros((2, 3, 3)), faces=np.zeros((1, 3), int))
    check_arrays(tmp_path / "a.npz")
    (tmp_path / "b.npz").write_bytes(packed(("vertices.npy", b"root:x:0:0")))
    with pytest.raises(BadInput, match=r"vertices\.npy is not an array"):
        check_arrays(tmp_path / "b.npz")
    (tmp_path / "c.npz").write_bytes(SECRETS["passwd"])
    with pytest.raises(BadInput, match="not a NumPy archive"):
        check_arrays(tmp_path / "c.npz")


@pytest.mark.parametrize("cut", range(8, 13))
def test_text_that_is_cut_within_a_letter_is_text(cut: int) -> None:
    assert is_text("fuchs 🦊🦊".encode()[:cut])
    assert not is_text(b"\xff" + b"fuchs")
