"""Files that are neither pictures nor videos, and places that are not files."""

import gzip
import io
import os
import pickle
import socket
import sqlite3
import stat
import struct
import tarfile
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from tests.hostile.formats import disc, opaque, riff, saved, subject
from tests.hostile.samples import frames_zip, sound_png

Make = Callable[[], bytes]
Place = Callable[[Path], None]


def database() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        connection = sqlite3.connect(Path(folder) / "a.db")
        connection.execute("create table t (x)")
        connection.commit()
        connection.close()
        return (Path(folder) / "a.db").read_bytes()


def _tar() -> bytes:
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w") as archive:
        info = tarfile.TarInfo("0.png")
        info.size = len(sound_png())
        archive.addfile(info, io.BytesIO(sound_png()))
    return file.getvalue()


def _array() -> bytes:
    file = io.BytesIO()
    np.save(file, opaque(disc()))
    return file.getvalue()


PDF = b"%PDF-1.4\n1 0 obj<</Type/Catalog/OpenAction<</S/JavaScript/JS(alert(1))>>>>endobj\ntrailer<</Root 1 0 R>>\n"
SVG = b'<?xml version="1.0"?><!DOCTYPE svg [<!ENTITY x SYSTEM "file:///etc/passwd">]><svg><image href="http://127.0.0.1/"/>&x;</svg>'
PLAYLIST = b"#EXTM3U\n#EXT-X-MEDIA-SEQUENCE:0\n#EXTINF:10.0,\nfile:///etc/passwd\n#EXT-X-ENDLIST\n"

OTHERS: dict[str, Make] = {
    "other: nothing": lambda: b"",
    "other: one byte": lambda: b"\x89",
    "other: zeros": lambda: bytes(5000),
    "other: ones": lambda: b"\xff" * 5000,
    "other: noise": lambda: np.random.default_rng(7).integers(0, 255, 5000, np.uint8).tobytes(),
    "other: text": lambda: b"once upon a time there was a newt",
    "other: text of 16 bits": lambda: "once upon a time there was a newt".encode("utf-16"),
    "other: a program": lambda: b"\x7fELF\x02\x01\x01" + bytes(500),
    "other: a program of Windows": lambda: b"MZ" + bytes(58) + struct.pack("<I", 64) + b"PE\0\0" + bytes(500),
    "other: a script": lambda: b"#!/bin/sh\nrm -rf /\n",
    "other: a page": lambda: b"<!DOCTYPE html><html><script>alert(1)</script></html>",
    "other: SVG": lambda: SVG,
    "other: SVG, gzipped": lambda: gzip.compress(SVG, mtime=0),
    "other: PDF": lambda: PDF,
    "other: PDF and zip": lambda: PDF + frames_zip(),
    "other: page and zip": lambda: b"<html>" + frames_zip(),
    "other: PostScript": lambda: b"%!PS-Adobe-3.0 EPSF-3.0\n(/etc/passwd) (r) file\n",
    "other: ImageMagick's language": lambda: (
        b"push graphic-context\nviewbox 0 0 640 480\nfill 'url(https://127.0.0.1/\"|ls \"-la)'\n"
    ),
    "other: a database": database,
    "other: a playlist": lambda: PLAYLIST,
    "other: a list of FFmpeg": lambda: b"ffconcat version 1.0\nfile /etc/passwd\n",
    "other: a session description": lambda: (
        b"v=0\no=- 0 0 IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 96\na=rtpmap:96 H264/90000\n"
    ),
    "other: DASH": lambda: b'<?xml version="1.0"?><MPD><Period><BaseURL>file:///etc/passwd</BaseURL></Period></MPD>',
    "other: subtitles": lambda: b"1\n00:00:00,000 --> 00:00:01,000\nhello\n",
    "other: a pickle": lambda: pickle.dumps({"x": 1}),
    "other: an array": _array,
    "other: a tar": _tar,
    "other: gzip": lambda: gzip.compress(sound_png(), mtime=0),
    "other: gzip of 32 MiB": lambda: gzip.compress(bytes(2**25), mtime=0),
    "other: 7z": lambda: b"7z\xbc\xaf\x27\x1c\0\x04" + bytes(100),
    "other: RAR": lambda: b"Rar!\x1a\x07\x01\0" + bytes(100),
    "other: a sound": lambda: riff(
        b"WAVE", (b"fmt ", struct.pack("<HHIIHH", 1, 1, 8000, 16000, 2, 16)), (b"data", bytes(1000))
    ),
    "other: MP3": lambda: b"ID3\x04\0\0\0\0\0\0" + b"\xff\xfb\x90\0" * 100,
    "other: RIFF of nothing": lambda: riff(b"EVIL"),
    "other: a mesh": lambda: b"glTF" + struct.pack("<II", 2, 12),
    "other: splats": lambda: b"ply\nformat ascii 1.0\nelement vertex 1\nend_header\n0\n",
    "other: a certificate": lambda: b"-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n",
    "other: an icon": lambda: saved(subject("RGBA"), "ICO", sizes=[(64, 64)]),
    "other: Targa": lambda: saved(subject(), "TGA"),
    "other: PCX": lambda: saved(subject(), "PCX"),
    "other: SGI": lambda: saved(subject(), "SGI"),
    "other: DDS": lambda: saved(subject("RGBA"), "DDS"),
    "other: PBM": lambda: saved(Image.new("1", (64, 64)), "PPM"),
    "other: a float map": lambda: b"PF\n64 64\n-1.0\n" + bytes(64 * 64 * 12),
    "other: a bare JPEG 2000 stream": lambda: b"\xff\x4f\xff\x51" + bytes(200),
    "other: FITS": lambda: b"SIMPLE  =                    T" + b" " * 2850,
    "other: DPX": lambda: b"SDPX" + bytes(2048),
    "other: byte order mark alone": lambda: b"\xef\xbb\xbf",
}


def _device(path: Path) -> None:
    os.mknod(path, 0o666 | stat.S_IFCHR, os.makedev(1, 5))  # /dev/zero, without end


def _socket(path: Path) -> None:
    server = socket.socket(socket.AF_UNIX)
    server.bind(str(path))
    server.close()


def _loop(path: Path) -> None:
    path.symlink_to(path)


def _two_loops(path: Path) -> None:
    other = path.with_name(f"{path.name}.other")
    path.symlink_to(other)
    other.symlink_to(path)


def _huge(path: Path) -> None:
    """Make a sparse file beyond what is read; it takes no room on disk."""
    with path.open("wb") as file:
        file.write(sound_png())
        file.truncate(9 * 2**30)


PLACES: dict[str, Place] = {
    "place: nothing there": lambda path: None,
    "place: a folder": lambda path: path.mkdir(),
    "place: a pipe": os.mkfifo,
    "place: a socket": _socket,
    "place: a device": _device,
    "place: a link to a device": lambda path: path.symlink_to("/dev/zero"),
    "place: a link to nothing": lambda path: path.symlink_to("nowhere"),
    "place: a link to itself": _loop,
    "place: two links to each other": _two_loops,
    "place: a link to a folder": lambda path: path.symlink_to("."),
    "place: an empty file": lambda path: path.write_bytes(b""),
    "place: 9 GiB": _huge,
}
