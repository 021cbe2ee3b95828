"""Files as users hand them in, made on the spot."""

import struct
import zipfile
import zlib
from pathlib import Path

import av
import numpy as np
import OpenImageIO as oiio
from numpy import ndarray

SIZE = 64


def disc(left: int = 12, size: int = SIZE, color: tuple[int, int, int] = (200, 60, 30)) -> ndarray:
    """A straight RGBA picture of a disc of radius 16 whose leftmost pixel is `left`; transparent white around it."""
    rows, columns = np.mgrid[:size, :size]
    inside = (rows - size // 2) ** 2 + (columns - left - 16) ** 2 < 16**2
    picture = np.full((size, size, 4), 255, np.uint8)
    picture[inside, :3] = color
    picture[..., 3] = 255 * inside
    return picture


def opaque(picture: ndarray) -> ndarray:
    """The same over white, without alpha."""
    alpha = picture[..., 3:] / 255
    return np.round(picture[..., :3] * alpha + 255 * (1 - alpha)).astype(np.uint8)


def save(path: Path, pixels: ndarray, format_: str = "uint8", **attributes: object) -> Path:
    """Write with OpenImageIO; alpha is straight."""
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], format_)
    if pixels.shape[2] == 2:
        spec.channelnames = ("Y", "A")
        spec.alpha_channel = 1
    spec.attribute("oiio:UnassociatedAlpha", 1)
    for name, value in attributes.items():
        spec.attribute(name, value)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec) and output.write_image(np.ascontiguousarray(pixels)) and output.close()
    return path


def save_palette(path: Path, picture: ndarray) -> Path:
    """A PNG of two palette entries, the first transparent."""

    def chunk(name: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    inside = picture[..., 3] > 0
    rows = b"".join(b"\0" + row.astype(np.uint8).tobytes() for row in inside)
    header = struct.pack(">IIBBBBB", picture.shape[1], picture.shape[0], 8, 3, 0, 0, 0)
    palette = bytes([255, 255, 255]) + picture[inside][0, :3].tobytes()
    parts = [
        (b"IHDR", header),
        (b"PLTE", palette),
        (b"tRNS", b"\0\xff"),
        (b"IDAT", zlib.compress(rows)),
        (b"IEND", b""),
    ]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts))
    return path


def png_header(path: Path, width: int, height: int) -> Path:
    """A PNG that announces a size and holds next to nothing."""
    save(path, np.zeros((1, 1, 3), np.uint8))
    content = bytearray(path.read_bytes())
    content[16:24] = struct.pack(">II", width, height)
    content[29:33] = struct.pack(">I", zlib.crc32(bytes(content[12:29])))
    path.write_bytes(content)
    return path


def walk(count: int) -> list[ndarray]:
    """A disc that goes to the right, two pixels a frame."""
    return [disc(6 + 2 * i) for i in range(count)]


def save_clip(
    path: Path,
    frames: list[ndarray],
    codec: str,
    pixel_format: str,
    fps: int = 10,
    header: dict[str, object] | None = None,
    **options: str,
) -> Path:
    """Encode RGBA frames with PyAV; `header` holds attributes of the codec's context."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, fps, options)
        stream.width, stream.height, stream.pix_fmt = frames[0].shape[1], frames[0].shape[0], pixel_format
        for name, value in (header or {}).items():
            setattr(stream.codec_context, name, value)
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgba")))
        container.mux(stream.encode(None))
    return path


def save_zip(path: Path, entries: dict[str, ndarray], scratch: Path) -> Path:
    """Pictures in a stored zip, under their names."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, pixels in entries.items():
            archive.writestr(name, save(scratch / "entry.png", pixels).read_bytes())
    return path
