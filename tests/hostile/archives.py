"""Zips: given as sources, unpacked as packages and banks, and files that only look like zips."""

import functools
import io
import stat
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Mapping

from PIL import Image

from tests.hostile.formats import cut, disc, saved, zeros_png
from tests.hostile.samples import frames_zip, sound_png

Make = Callable[[], bytes]


@functools.cache
def frame(number: int, size: int = 64) -> bytes:
    """Return a PNG of the disc on its way."""
    return saved(Image.fromarray(disc(8 + 2 * number, size)), "PNG")


def packed(
    entries: Mapping[str, bytes] | list[tuple[str, bytes]], kind: int = zipfile.ZIP_STORED, comment: bytes = b""
) -> bytes:
    """Return a zip of these entries; a list may name one twice."""
    file = io.BytesIO()
    pairs = entries.items() if isinstance(entries, Mapping) else entries
    with warnings.catch_warnings(), zipfile.ZipFile(file, "w", kind) as archive:
        warnings.simplefilter("ignore")  # about a name that is there twice
        archive.comment = comment
        for name, content in pairs:
            info = zipfile.ZipInfo(name)
            info.compress_type = kind
            archive.writestr(info, content)
    return file.getvalue()


def numbered(count: int, form: str = "{}.png") -> dict[str, bytes]:
    """Return frames under numbered names."""
    return {form.format(i): frame(i % 12) for i in range(count)}


def linked(name: str, target: str, others: Mapping[str, bytes]) -> bytes:
    """Return a zip with a symbolic link, as `zip -y` writes it."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        info = zipfile.ZipInfo(name)
        info.create_system, info.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
        archive.writestr(info, target)
        for other, content in others.items():
            archive.writestr(other, content)
    return file.getvalue()


def named(entries: list[tuple[bytes, bytes]], flags: int = 0, method: int = 0, claimed: int | None = None) -> bytes:
    """Return a stored zip written by hand: any bytes as names, any flags, any claimed size."""
    body, directory = b"", b""
    for name, content in entries:
        size = len(content) if claimed is None else claimed
        facts = struct.pack("<HHHHIIIHH", flags, method, 0, 33, zlib.crc32(content), len(content), size, len(name), 0)
        place = len(body)
        body += b"PK\3\4" + struct.pack("<H", 20) + facts + name + content
        directory += b"PK\1\2" + struct.pack("<HH", 20, 20) + facts + struct.pack("<HHHII", 0, 0, 0, 0, place) + name
    end = struct.pack("<HHHHIIH", 0, 0, len(entries), len(entries), len(directory), len(body), 0)
    return body + directory + b"PK\5\6" + end


def overlapping(count: int, size: int) -> bytes:
    """Return a zip whose entries all share one deflated body, as in the bombs of D. Fifield."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    content = bytes(size)
    body = packer.compress(content) + packer.flush()
    check = zlib.crc32(content)
    local, directory = b"", b""
    for i in range(count):
        name = f"{i}.png".encode()
        facts = struct.pack("<HHHHIIIHH", 0, 8, 0, 33, check, len(body), size, len(name), 0)
        if i == 0:
            local = b"PK\3\4" + struct.pack("<H", 20) + facts + name + body
        directory += b"PK\1\2" + struct.pack("<HH", 20, 20) + facts + struct.pack("<HHHII", 0, 0, 0, 0, 0) + name
    end = struct.pack("<HHHHIIH", 0, 0, count, count, len(directory), len(local), 0)
    return local + directory + b"PK\5\6" + end


def usdz(textures: int = 1) -> bytes:
    """Return a zip as USDZ has it: a scene, and textures beside it."""
    entries = {"scene.usdc": b"PXR-USDC" + bytes(100)}
    return packed(entries | {f"textures/color_{i}.png": sound_png() for i in range(textures)})


def _misplaced() -> bytes:
    """Return a zip whose directory lies about its own place, so that entries begin before the file does."""
    content = frames_zip()
    at = len(content) - 6
    (place,) = struct.unpack_from("<I", content, at)
    return content[:at] + struct.pack("<I", place + 100_000 if place < 100 else place + 50) + content[at + 4 :]


ZIPS: dict[str, Make] = {
    "zip: empty": lambda: packed({}),
    "zip: magic alone": lambda: b"PK\3\4",
    "zip: cut at a half": lambda: cut(frames_zip(), 0.5),
    "zip: no directory": lambda: frames_zip()[: frames_zip().index(b"PK\1\2")],
    "zip: directory outside the file": lambda: frames_zip()[:-6] + b"\xff\xff\xff\x7f\0\0",
    "zip: an entry outside the file": _misplaced,
    "zip: 65,535 entries that are not there": lambda: frames_zip()[:-14] + b"\xff\xff\xff\xff" + frames_zip()[-10:],
    "zip: one frame": lambda: packed(numbered(1)),
    "zip: no picture": lambda: packed({"notes.txt": b"hello"}),
    "zip: a folder alone": lambda: packed({"frames/": b""}),
    "zip: 9,001 frames": lambda: packed({f"{i}.png": b"" for i in range(9001)}),
    "zip: frames of text": lambda: packed({"0.png": b"no picture at all", "1.png": b"nor this"}),
    "zip: frames without bytes": lambda: packed({"0.png": b"", "1.png": b""}),
    "zip: frames that are zips": lambda: packed({"0.png": frames_zip(), "1.png": frames_zip()}),
    "zip: frames that are videos": lambda: packed({"0.png": b"GIF89a" + bytes(50), "1.png": b"GIF89a" + bytes(50)}),
    "zip: a frame cut at a half": lambda: packed({"0.png": frame(0), "1.png": cut(frame(1), 0.5)}),
    "zip: a frame of another size": lambda: packed({"0.png": frame(0), "1.png": frame(1, 96)}),
    "zip: gaps": lambda: packed({f"{i}.png": frame(0) for i in (0, 1, 4, 7)}),
    "zip: gaps of 10^18": lambda: packed({"0.png": frame(0), "999999999999999999.png": frame(1)}),
    "zip: a number of 5,000 digits": lambda: packed({"0.png": frame(0), "9" * 5000 + ".png": frame(1)}),
    "zip: a number twice": lambda: packed({"1.png": frame(0), "01.png": frame(1), "2.png": frame(2)}),
    "zip: a name twice": lambda: packed([("0.png", frame(0)), ("0.png", frame(1)), ("1.png", frame(2))]),
    "zip: numbers and none": lambda: packed({"cover.png": frame(0), "1.png": frame(1), "2.png": frame(2)}),
    "zip: encrypted": lambda: named([(b"0.png", frame(0)), (b"1.png", frame(1))], flags=1),
    "zip: strongly encrypted": lambda: named([(b"0.png", frame(0)), (b"1.png", frame(1))], flags=0x41, method=99),
    "zip: unknown compression": lambda: named([(b"0.png", frame(0)), (b"1.png", frame(1))], method=77),
    "zip: LZMA garbage": lambda: named([(b"0.png", bytes(99)), (b"1.png", bytes(99))], method=14),
    "zip: deflate garbage": lambda: named([(b"0.png", b"\xff" * 99), (b"1.png", b"\xff" * 99)], method=8),
    "zip: bzip2 garbage": lambda: named([(b"0.png", b"\xff" * 99), (b"1.png", b"\xff" * 99)], method=12),
    "zip: an entry without a name": lambda: named([(b"", b"x"), (b"0.png", frame(0)), (b"1.png", b"")]),
    "zip: names that are not UTF-8": lambda: named(
        [(b"\xff\xfe0.png", frame(0)), (b"\xff\xfe1.png", frame(1))], flags=0x800
    ),
    "zip: entries that claim 4 GB": lambda: named([(b"0.png", frame(0)), (b"1.png", frame(1))], claimed=2**32 - 2),
    "zip: bomb of 256 MiB a frame": lambda: overlapping(2, 2**28),
    "zip: bomb of shared bodies": lambda: overlapping(2000, 2**24),
    "zip: frames of 4,000 a side, zeros": lambda: packed({f"{i}.png": zeros_png(4000) for i in range(2)}),
    "zip: USDZ": usdz,
    "zip: USDZ of two textures": lambda: usdz(2),
    "zip: document": lambda: packed({"[Content_Types].xml": b"<Types/>", "word/media/image1.png": sound_png()}),
    "zip: program of Java": lambda: packed(
        {"META-INF/MANIFEST.MF": b"Main-Class: Evil", "Evil.class": b"\xca\xfe\xba\xbe"}
    ),
    "zip: book": lambda: packed(
        {"mimetype": b"application/epub+zip", "cover.jpg": saved(Image.new("RGB", (64, 64)), "JPEG")}
    ),
    "zip: a link in place of a frame": lambda: linked("1.png", "/etc/passwd", {"0.png": frame(0)}),
    "zip: a comment that looks like an end": lambda: packed(numbered(2), comment=b"PK\5\6" + b"x" * 65_000),
    # sound; nothing is ever written under a name of the zip
    "zip: frames above the folder": lambda: packed({"../../0.png": frame(0), "../../1.png": frame(1)}),
    "zip: frames of the root": lambda: packed({"/etc/0.png": frame(0), "/etc/1.png": frame(1)}),
    "zip: frames of drive C": lambda: packed({"C:\\0.png": frame(0), "C:\\1.png": frame(1)}),
    "zip: frames of letters": lambda: packed({"a.png": frame(0), "b.png": frame(1)}),
    "zip: frames of Arabic numbers": lambda: packed({"\u0661.png": frame(0), "\u0662.png": frame(1)}),
    "zip: frames of JPEG called PNG": lambda: packed(
        {f"{i}.png": saved(Image.fromarray(disc(8 + i)).convert("RGB"), "JPEG") for i in range(2)}
    ),
    "zip: deflated": lambda: packed(numbered(3), zipfile.ZIP_DEFLATED),
    "zip: LZMA": lambda: packed(numbered(3), zipfile.ZIP_LZMA),
    "zip: long comment": lambda: packed(numbered(2), comment=b"x" * 65_000),
    "zip: program in front": lambda: b"\x7fELF" + bytes(60) + frames_zip(),
    "zip: hidden files of a Mac": lambda: packed(
        {**numbered(3), "__MACOSX/._0.png": b"x", ".DS_Store": b"x", "._1.png": b"x"}
    ),
}


UNPACKED: dict[str, Make] = {
    "unpack: no zip": lambda: b"no zip",
    "unpack: a link out": lambda: linked("asset.glb", "/etc/passwd", {}),
    "unpack: a link, and a file through it": lambda: linked("deep", "/tmp", {"deep/x": b"x"}),
    "unpack: above the folder": lambda: packed({"a": b"", "../b": b"x"}),
    "unpack: above by a way round": lambda: packed({"a/../../b": b"x"}),
    "unpack: of the root": lambda: packed({"/tmp/b": b"x"}),
    "unpack: of a drive": lambda: packed({"C:/b": b"x"}),
    "unpack: backslashes": lambda: named([(b"..\\b", b"x")]),
    "unpack: a line break": lambda: packed({"a\nb": b"x"}),
    "unpack: a name twice": lambda: packed([("a", b"x"), ("a", b"y")]),
    "unpack: a file and a folder of one name": lambda: packed([("a", b"x"), ("a/b", b"y")]),
    "unpack: a name of 300 letters": lambda: packed({"a" * 300: b"x"}),
    "unpack: a path of 300 folders": lambda: packed({"a/" * 300 + "b": b"x"}),
    "unpack: a name of half a character": lambda: named(
        [("a\udce9".encode("utf-8", "surrogatepass"), b"x")], flags=0x800
    ),
    "unpack: encrypted": lambda: named([(b"a", b"x")], flags=1),
    "unpack: 70 GB that share a body": lambda: _claims(17),
    "unpack: bodies that overlap": lambda: overlapping(40, 2**20),
    "unpack: cut at a half": lambda: cut(packed({"a": bytes(5000)}), 0.5),
    "unpack: wrong checksum": lambda: packed({"a": b"content"}).replace(b"content", b"CONTENT"),
    "unpack: deflate garbage": lambda: named([(b"a", b"\xff" * 99)], method=8),
    "unpack: LZMA garbage": lambda: named([(b"a", b"\xff" * 99)], method=14),
    "unpack: an entry without a name": lambda: named([(b"", b"x"), (b"a", b"y")]),
    "unpack: bzip2 garbage": lambda: named([(b"a", b"\xff" * 99)], method=12),
    "unpack: an entry outside the file": _misplaced,
    # sound
    "unpack: empty": lambda: packed({}),
    "unpack: two files": lambda: packed({"b": b"x", "a/c": b"y"}, zipfile.ZIP_DEFLATED),
}


def _claims(count: int) -> bytes:
    """Return entries that claim 4 GiB each."""
    return named([(f"{i}".encode(), b"x") for i in range(count)], claimed=2**32 - 2)
