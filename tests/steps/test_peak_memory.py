"""Peak memory of decoding and cutting out: below 2 GiB with all libraries, whatever the file says."""

import struct
import sys
import zipfile
import zlib
from pathlib import Path

import av
import numpy as np
import OpenImageIO as oiio
import pytest
from peak_memory import peaks_of

from steps.sources.clips import MOST_WORK

MOST_MIB = 2048
SIDE = 10_900  # pixels; its square is just below stills.MOST_PIXELS
FRAMES = 10  # of the video, whose memory grows with their number; the most that are kept are too slow to cut out here
LIBRARIES_MIB = 450  # of the process before it decodes a video; measured 330 to 480
SEGMENTATION_MIB = 600
SAME = "no subject found"

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="VmHWM is Linux's")


def gray_png(path: Path, side: int, interlaced: bool = False, depth: int = 8, color: int = 0) -> Path:
    """Zeros, packed row by row without holding the picture."""
    channels = {0: 1, 2: 3, 6: 4}[color]
    packer, packed = zlib.compressobj(1), b""
    passes = (
        [(0, 0, 8, 8), (0, 4, 8, 8), (4, 0, 8, 4), (0, 2, 4, 4), (2, 0, 4, 2), (0, 1, 2, 2), (1, 0, 2, 1)]
        if interlaced
        else [(0, 0, 1, 1)]
    )
    for top, left, down, across in passes:
        row = bytes(1 + -(-(side - left) // across) * channels * depth // 8)
        for _ in range(-(-(side - top) // down)):
            packed += packer.compress(row)
    packed += packer.flush()
    header = struct.pack(">IIBBBBB", side, side, depth, color, 0, 0, interlaced)
    chunks = [(b"IHDR", header), (b"IDAT", packed), (b"IEND", b"")]
    body = (struct.pack(">I", len(b)) + n + b + struct.pack(">I", zlib.crc32(n + b)) for n, b in chunks)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(body))
    return path


def still(path: Path, side: int, channels: int, format_: str, tile: int = 0, **attributes: object) -> Path:
    """Write white in bands; with alpha, only a bar of it is visible, so that nothing has to be cut out."""
    spec = oiio.ImageSpec(side, side, channels, format_)
    spec.tile_width = spec.tile_height = tile
    for name, value in attributes.items():
        spec.attribute(name, value)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec), output.geterror()
    rows = tile or 256
    for top in range(0, side, rows):
        band = np.full((min(rows, side - top), side, channels), 255, np.uint8)
        if channels == 4:
            band[:, : side // 3, 3] = band[:, side // 2 :, 3] = 0
        if tile:
            written = output.write_tiles(0, side, top, top + len(band), 0, 1, band)
        else:
            written = output.write_scanlines(top, top + len(band), 0, band)
        assert written, output.geterror()
    output.close()
    return path


def film(path: Path, side: int, frames: int, codec: str, pixels: str) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, 10)
        stream.width = stream.height = side
        stream.pix_fmt = pixels
        for i in range(frames):
            picture = np.full((side, side, 4), 255, np.uint8)
            picture[side // 3 : side // 2, side // 3 + i : side // 2 + i, :3] = 40
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgba")))
        container.mux(stream.encode(None))
    return path


def frames_in_a_zip(path: Path, frame: Path, count: int) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for i in range(count):
            archive.write(frame, f"{i}.png")
    return path


@pytest.mark.slow
def test_large_files_of_every_kind_stay_below_two_gibibytes(tmp_path: Path) -> None:
    interlaced = gray_png(tmp_path / "interlaced.png", 4500, interlaced=True, depth=16, color=6)
    files = {
        "refused": (interlaced, {"max_decode_gb": 0.125}),  # first, before decoders have grown the process
        "interlaced PNG of 16 bits": (interlaced, {}),
        "gray PNG": (gray_png(tmp_path / "gray.png", SIDE), {}),
        "progressive JPEG": (still(tmp_path / "p.jpg", 3600, 3, "uint8", **{"jpeg:progressive": 1}), {}),
        "tiled EXR": (still(tmp_path / "t.exr", 2048, 4, "half", tile=64), {}),
        "EXR of 200 channels": (still(tmp_path / "c.exr", 512, 200, "half"), {}),
        "TIFF of one strip": (still(tmp_path / "s.tif", 2048, 4, "uint16", **{"tiff:RowsPerStrip": 2048}), {}),
        "JPEG 2000": (still(tmp_path / "a.jp2", 2048, 4, "uint8"), {}),
        "JPEG XL": (still(tmp_path / "a.jxl", 1024, 4, "uint8", **{"jpegxl:effort": 1}), {}),
        "animated WebP": (film(tmp_path / "w.webp", 512, 2, "libwebp_anim", "bgra"), {}),
        "GIF": (film(tmp_path / "a.gif", 512, 2, "gif", "rgb8"), {}),
        "video of large frames": (film(tmp_path / "b.mp4", 3072, 2, "libx264", "yuv420p"), {}),
        "video": (film(tmp_path / "a.mp4", 1024, FRAMES, "libx264", "yuv420p"), {}),
        "zip": (frames_in_a_zip(tmp_path / "a.zip", gray_png(tmp_path / "frame.png", 2048), 2), {}),
    }
    peaks = dict(zip(files, peaks_of(list(files.values())), strict=True))
    refused = peaks.pop("refused")
    assert "4500 x 4500 pixels and takes about 0." in refused.outcome
    assert "--set subject.max_decode_gb=" in refused.outcome
    assert refused.mib + 100 < peaks["interlaced PNG of 16 bits"].mib
    assert {kind: peak for kind, peak in peaks.items() if peak.mib > MOST_MIB} == {}
    share = FRAMES * 1024**2 / MOST_WORK
    # an opaque video is segmented: a network, and color models of a few frames
    assert peaks["video"].mib < LIBRARIES_MIB + SEGMENTATION_MIB + share * (MOST_MIB - LIBRARIES_MIB), peaks["video"]
    blank = ("gray PNG", "progressive JPEG", "EXR of 200 channels", "zip")
    ends = dict.fromkeys(peaks, "done") | dict.fromkeys(blank, SAME) | {"interlaced PNG of 16 bits": "transparent"}
    assert {kind: peak for kind, peak in peaks.items() if ends[kind] not in peak.outcome} == {}
