"""Still pictures: broken ones, hostile ones, and sound ones that are unusual."""

import functools
import struct
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from numpy import ndarray
from PIL import Image, ImageCms, PngImagePlugin

from tests.hostile.formats import (
    HUGE,
    PNG_SIGNATURE,
    SIZE,
    animation,
    apng,
    bmp,
    chunk,
    claimed_png,
    cut,
    disc,
    flipped,
    gif,
    gray_rows,
    gray_tiff,
    ihdr,
    noise,
    opaque,
    png,
    psd,
    riff,
    saved,
    subject,
    tiff,
    vp8x,
    webp_frame,
    webp_parts,
    zeros_png,
)
from tests.hostile.jpegs import JPEGS
from tests.hostile.samples import (
    frames_zip,
    moving_gif,
    moving_webp,
    noise_png,
    sound_jpeg,
    sound_png,
    sound_webp,
)

Make = Callable[[], bytes]


def written(suffix: str, kind: str = "uint8", pixels: tuple[str, ...] = (), **attributes: object) -> bytes:
    """Encode the disc with OpenImageIO; `pixels` names channels of linear light, else they are RGBA."""
    image = disc().astype(np.float32) / 255
    if pixels:
        image = np.repeat(image[..., :1], len(pixels), axis=2)
    return _written(suffix, image, kind, pixels, attributes)


def _written(
    suffix: str, image: ndarray, kind: str, names: tuple[str, ...] = (), attributes: dict[str, object] | None = None
) -> bytes:
    spec = oiio.ImageSpec(image.shape[1], image.shape[0], image.shape[2], kind)
    if names:
        spec.channelnames = names
        spec.alpha_channel = names.index("A") if "A" in names else -1
    for name, value in (attributes or {}).items():
        spec.attribute(name, value)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{suffix}"
        output = oiio.ImageOutput.create(str(path))
        assert output, oiio.geterror()
        assert output.open(str(path), spec), output.geterror()
        assert output.write_image(np.ascontiguousarray(image, np.float32)) and output.close(), output.geterror()
        return path.read_bytes()


def exr(
    kind: str = "half", value: float | None = None, everywhere: bool = False, channels: int = 4, **attributes: object
) -> bytes:
    """Encode the disc as OpenEXR, a quarter of it or all with another value, perhaps with more channels."""
    image = disc().astype(np.float32) / 255
    image[..., :3] *= image[..., 3:]
    if value is not None:
        image[slice(None) if everywhere else slice(0, 32), :, :3] = value
    names = ("R", "G", "B", "A")
    if channels > 4:
        image = np.concatenate([image, np.zeros((SIZE, SIZE, channels - 4), np.float32)], 2)
        names += tuple(f"extra.{i:04d}" for i in range(channels - 4))
    return _written(".exr", image, kind, names, attributes)


def exr_claiming(width: int, height: int) -> bytes:
    """Return an EXR whose windows claim a size, at the place where the sound one says 64 x 64."""
    content = exr()
    old = struct.pack("<iiii", 0, 0, SIZE - 1, SIZE - 1)
    return content.replace(old, struct.pack("<iiii", 0, 0, width - 1, height - 1))


# PNG


def icc_bomb() -> bytes:
    """Return a PNG whose color profile inflates to 256 MiB."""
    packer = zlib.compressobj(9)
    profile = b"".join([packer.compress(bytes(2**20)) for _ in range(256)] + [packer.flush()])
    rows = chunk(b"IDAT", zlib.compress(gray_rows()))
    return png(ihdr(), chunk(b"iCCP", b"bomb\0\0" + profile), rows)


def text_bomb() -> bytes:
    """Return a PNG with 50 compressed comments of 4 MiB."""
    comment = chunk(b"zTXt", b"Comment\0\0" + zlib.compress(bytes(2**22), 9))
    return png(ihdr(), *[comment] * 50, chunk(b"IDAT", zlib.compress(gray_rows())))


def _rows() -> bytes:
    return chunk(b"IDAT", zlib.compress(gray_rows()))


def _palette_png(entries: int, last: int) -> bytes:
    rows = np.full((SIZE, SIZE + 1), last, np.uint8)
    rows[:, 0] = 0
    rows[16:48, 17:49] = 0
    colors = (
        [ihdr(color=3), chunk(b"PLTE", bytes([40, 40, 40] + [255] * 3 * (entries - 1)))] if entries else [ihdr(color=3)]
    )
    return png(*colors, chunk(b"IDAT", zlib.compress(rows.tobytes())))


def _exif_png(exif: bytes) -> bytes:
    return png(ihdr(), chunk(b"eXIf", exif), _rows())


def _icc(space: str) -> bytes:
    return ImageCms.ImageCmsProfile(ImageCms.createProfile(space)).tobytes()


def _interlaced() -> bytes:
    """Return a gray PNG in Adam7 order."""
    rows = gray_rows()
    pixels = np.frombuffer(rows, np.uint8).reshape(SIZE, SIZE + 1)[:, 1:]
    passes = ((0, 8, 0, 8), (0, 8, 4, 8), (4, 8, 0, 4), (0, 4, 2, 4), (2, 4, 0, 2), (0, 2, 1, 2), (1, 2, 0, 1))
    data = b"".join(
        b"".join(b"\0" + row.tobytes() for row in pixels[top::down, left::right]) for top, down, left, right in passes
    )
    return png(ihdr(rest=(0, 0, 1)), chunk(b"IDAT", zlib.compress(data)))


PNGS: dict[str, Make] = {
    "png: signature alone": lambda: PNG_SIGNATURE,
    "png: cut within the header": lambda: noise_png()[:20],
    "png: header alone": lambda: noise_png()[:33],
    "png: cut at a tenth": lambda: cut(noise_png(), 0.1),
    "png: cut at a half": lambda: cut(noise_png(), 0.5),
    "png: cut at nine tenths": lambda: cut(noise_png(), 0.9),
    "png: one byte short of the last pixels": lambda: noise_png()[:-17],
    "png: 1 x 1": lambda: saved(noise(1), "PNG"),
    "png: 31 x 31": lambda: saved(noise(31), "PNG"),
    "png: 2,000 x 40": lambda: saved(Image.new("L", (2000, 40)), "PNG"),
    "png: 20,000 x 10": lambda: claimed_png(20_000, 10),
    "png: 60,000 a side": lambda: claimed_png(60_000, 60_000),
    "png: two billion a side": lambda: claimed_png(HUGE, HUGE),
    "png: four billion a side": lambda: claimed_png(2**32 - 1, 2**32 - 1),
    "png: no width": lambda: claimed_png(0, 64),
    "png: no height": lambda: claimed_png(64, 0),
    "png: 10,900 a side, zeros": lambda: zeros_png(10_900),
    "png: 8,000 a side, zeros of 1 bit": lambda: zeros_png(8_000, depth=1),
    "png: 5,000 a side, zeros of 16-bit RGBA": lambda: zeros_png(5_000, 16, 6, 4),
    "png: 5,400 a side of claims, no pixels": lambda: claimed_png(5_400, 5_400),
    "png: depth 3": lambda: png(ihdr(depth=3), _rows()),
    "png: color type 5": lambda: png(ihdr(color=5), _rows()),
    "png: compression method 1": lambda: png(ihdr(rest=(1, 0, 0)), _rows()),
    "png: interlace method 7": lambda: png(ihdr(rest=(0, 0, 7)), _rows()),
    "png: header with a wrong checksum": lambda: png(chunk(b"IHDR", ihdr()[8:21], checksum=1), _rows()),
    "png: pixels with a wrong checksum": lambda: png(ihdr(), chunk(b"IDAT", zlib.compress(gray_rows()), checksum=1)),
    "png: no pixels": lambda: png(ihdr()),
    "png: pixels before the header": lambda: png(_rows(), ihdr()),
    "png: two headers": lambda: png(ihdr(), ihdr(32, 32), _rows()),
    "png: pixels are not zlib": lambda: png(ihdr(), chunk(b"IDAT", bytes(range(256)))),
    "png: too few pixels": lambda: png(ihdr(), chunk(b"IDAT", zlib.compress(gray_rows()[:100]))),
    "png: chunk of two billion bytes": lambda: png(ihdr(), chunk(b"IDAT", b"x", length=HUGE)),
    "png: chunk of four billion bytes": lambda: png(ihdr(), chunk(b"IDAT", b"x", length=2**32 - 1)),
    "png: no palette": lambda: _palette_png(0, 1),
    "png: empty animation": lambda: apng(0),
    "png: two billion frames": lambda: apng(3, claimed=HUGE),
    "png: frames outside the canvas": lambda: apng(3, offset=40),
    "png: Apple's own form": lambda: png(chunk(b"CgBI", b"\x50\0\x20\x06"), ihdr(), _rows()),
    "png: nothing visible": lambda: saved(Image.new("RGBA", (SIZE, SIZE)), "PNG"),
    "png: a subject of 4 pixels": lambda: saved(Image.fromarray(_dot(4)), "PNG"),
    # sound
    "png: more pixels than fit": lambda: png(ihdr(), chunk(b"IDAT", zlib.compress(gray_rows() + bytes(2**24), 9))),
    "png: profile of 256 MiB": icc_bomb,
    "png: comments of 200 MiB": text_bomb,
    "png: no end": lambda: png(end=False),
    "png: zip behind": lambda: sound_png() + frames_zip(),
    "png: script behind": lambda: sound_png() + b"<script>alert(1)</script>",
    "png: palette index out of range": lambda: _palette_png(2, 200),
    "png: EXIF without end": lambda: _exif_png(b"MM\0*\0\0\0\x08\xff\xff"),
    "png: orientation 99": lambda: _exif_png(b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x63\0\0\0\0\0\0"),
    "png: 1 bit": lambda: saved(subject("1"), "PNG"),
    "png: 16 bits": lambda: saved(Image.fromarray(opaque(disc())[..., 1].astype(np.uint16) * 257), "PNG"),
    "png: palette": lambda: saved(subject("P"), "PNG"),
    "png: gray and alpha": lambda: saved(subject("LA"), "PNG"),
    "png: interlaced": _interlaced,
    "png: profile of Lab, which is not of its mode": lambda: saved(subject(), "PNG", icc_profile=_icc("LAB")),
    "png: profile sRGB": lambda: saved(subject(), "PNG", icc_profile=_icc("sRGB")),
    "png: text of many languages": lambda: saved(subject(), "PNG", pnginfo=_text()),
    "png: 640 x 40": lambda: saved(Image.fromarray(opaque(disc())).resize((640, 40)), "PNG"),
    "png: animation of one frame": lambda: apng(1),
    "png: animation without delays": lambda: apng(3, delay=(0, 0)),
    "png: animation of three frames": lambda: apng(3),
}


def _dot(side: int) -> ndarray:
    picture = np.zeros((SIZE, SIZE, 4), np.uint8)
    picture[30 : 30 + side, 30 : 30 + side] = 255
    return picture


def _text() -> PngImagePlugin.PngInfo:
    info = PngImagePlugin.PngInfo()
    info.add_text("Title", "<script>alert(1)</script>")
    info.add_itxt("Comment", "猫 قط \u202egnp.exe", "zh", "注释", zip=True)
    return info


# JPEG


# TIFF, GIF, WebP


def _float_tiff(value: float) -> bytes:
    image = opaque(disc()).astype(np.float32) / 255
    image[:8] = value
    return _written(".tif", image, "float")


def _deflate_bomb() -> bytes:
    """Return a gray TIFF of 100 million pixels in one strip of deflated zeros."""
    packer = zlib.compressobj(9)
    strip = b"".join([packer.compress(bytes(10_000 * 1000)) for _ in range(10)] + [packer.flush()])
    tags = {256: 10_000, 257: 10_000, 258: 8, 259: 8, 262: 1, 273: 300, 277: 1, 278: 10_000, 279: len(strip)}
    return tiff(tags, bytes(300 - (14 + 12 * len(tags))) + strip)


TIFFS: dict[str, Make] = {
    "tiff: header alone": lambda: b"II*\0\x08\0\0\0",
    "tiff: directory outside the file": lambda: b"II*\0" + struct.pack("<I", HUGE) + bytes(100),
    "tiff: directory in the header": lambda: b"II*\0" + bytes(100),
    "tiff: 65,535 tags": lambda: tiff({256: 64}, count=65_535),
    "tiff: no tags": lambda: tiff({}),
    "tiff: 100,000 a side": lambda: gray_tiff(100_000, 100_000, t279=4096),
    "tiff: 60,000 channels": lambda: gray_tiff(t277=60_000),
    "tiff: no channels": lambda: gray_tiff(t277=0),
    "tiff: a tile of a million a side": lambda: gray_tiff(
        t322=1_000_000, t323=1_000_000, t324=300, t325=1000, t273=None, t278=None, t279=None
    ),
    "tiff: two billion rows in a strip": lambda: gray_tiff(64, HUGE, t278=HUGE, t279=4096),
    "tiff: strips outside the file": lambda: gray_tiff(t273=HUGE),
    "tiff: strips without bytes": lambda: gray_tiff(t279=0),
    "tiff: four billion strips": lambda: gray_tiff(t273=(4, 2**32 - 1, 300), t279=(4, 2**32 - 1, 300), t278=1),
    "tiff: 63 bits": lambda: gray_tiff(t258=63),
    "tiff: no bits": lambda: gray_tiff(t258=0),
    "tiff: unknown compression": lambda: gray_tiff(t259=31_337),
    "tiff: LZW garbage": lambda: gray_tiff(t259=5),
    "tiff: deflate garbage": lambda: gray_tiff(t259=8),
    "tiff: old JPEG": lambda: gray_tiff(t259=6, t513=300, t514=1000),
    "tiff: cut at a half": lambda: cut(saved(noise(), "TIFF"), 0.5),
    "tiff: BigTIFF of a directory of 2^60 tags": lambda: (
        b"II+\0\x08\0\0\0" + struct.pack("<QQ", 16, 2**60) + bytes(200)
    ),
    "tiff: deflate bomb": _deflate_bomb,
    "tiff: 20 x 20": lambda: saved(noise(20), "TIFF"),
    # sound
    "tiff: a directory that follows itself": lambda: gray_tiff()[:118] + struct.pack("<I", 8) + gray_tiff()[122:],
    "tiff: three pages": lambda: saved(subject(), "TIFF", save_all=True, append_images=[subject(), subject("L")]),
    "tiff: CMYK": lambda: saved(subject("CMYK"), "TIFF"),
    "tiff: Lab": lambda: saved(subject("LAB"), "TIFF"),
    "tiff: 1 bit, fax": lambda: saved(subject("1"), "TIFF", compression="group4"),
    "tiff: 16 bits": lambda: written(".tif", "uint16"),
    "tiff: 32 bits": lambda: written(".tif", "uint32"),
    "tiff: float": lambda: _float_tiff(1.0),
    "tiff: float, not a number": lambda: _float_tiff(np.nan),
    "tiff: float, infinite": lambda: _float_tiff(np.inf),
    "tiff: 40 channels": lambda: written(
        ".tif", "uint8", tuple("RGBA") + tuple(f"x{i}" for i in range(36)), **{"oiio:UnassociatedAlpha": 1}
    ),
    "tiff: planes": lambda: written(".tif", "uint8", (), planarconfig="separate"),
    "tiff: tiles": lambda: written(".tif", "uint8", (), **{"tiff:write_exif": 0}),
    "tiff: big-endian": lambda: written(".tif", "uint16", (), endian="big"),
    "tiff: LZW": lambda: saved(subject("RGBA"), "TIFF", compression="tiff_lzw"),
    "tiff: JPEG": lambda: saved(subject(), "TIFF", compression="jpeg"),
    "tiff: palette": lambda: saved(subject("P"), "TIFF"),
}


GIFS: dict[str, Make] = {
    "gif: header alone": lambda: b"GIF89a",
    "gif: no frame": lambda: gif(0),
    "gif: cut within the first frame": lambda: moving_gif()[:200],
    "gif: 65,535 a side": lambda: gif(3, 65_535, 65_535),
    "gif: 20,000 frames": lambda: gif(20_000),
    "gif: no width": lambda: gif(3, 0, 64),
    "gif: code size 0": lambda: gif(3, code_size=0),
    "gif: code size 13": lambda: gif(3, code_size=13),
    "gif: code size 255": lambda: gif(3, code_size=255),
    "gif: frames without data": lambda: gif(3, data=b"\0"),
    "gif: 20 x 20": lambda: gif(3, 20, 20, (0, 0, 20, 20)),
    # sound
    "gif: one frame": lambda: animation("GIF", 1),
    "gif: two frames": lambda: animation("GIF", 2, disposal=2),
    "gif: no delay": lambda: animation("GIF", 4, duration=0, disposal=2),
    "gif: 655 s a frame": lambda: animation("GIF", 3, duration=655_350, disposal=2),
    "gif: script behind": lambda: moving_gif() + b"*/=1;alert(1);//",
    "gif: script in a comment": lambda: _gif_comment(b"</style><script>alert(1)</script>"),
    "gif: zip behind": lambda: moving_gif() + frames_zip(),
    "gif: the oldest form": lambda: saved(subject("P"), "GIF").replace(b"GIF89a", b"GIF87a", 1),
    "gif: no end": lambda: moving_gif()[:-1],
}


def _gif_comment(text: bytes) -> bytes:
    content = moving_gif()
    at = content.index(b"!\xff\x0bNETSCAPE")
    return content[:at] + b"!\xfe" + bytes([len(text)]) + text + b"\0" + content[at:]


def _short_webp(size: int) -> bytes:
    return (riff(b"WEBP", vp8x(64, 64)))[:size]


def _vp8l(width: int, height: int) -> bytes:
    """Return a lossless WebP whose picture claims a size of up to 16,384 a side."""
    parts = dict(webp_parts(saved(subject(), "WEBP", lossless=True)))
    body = parts[b"VP8L"]
    return riff(b"WEBP", (b"VP8L", body[:1] + struct.pack("<I", (width - 1) | (height - 1) << 14) + body[5:]))


WEBPS: dict[str, Make] = {
    **{f"webp: {size} bytes": functools.partial(_short_webp, size) for size in range(12, 31)},
    "webp: no frame": lambda: riff(b"WEBP", vp8x(64, 64), (b"ANIM", bytes(6))),
    "webp: cut at a half": lambda: cut(saved(noise(), "WEBP", lossless=True), 0.5),
    "webp: lossy, cut at a half": lambda: cut(saved(noise(), "WEBP", quality=80), 0.5),
    "webp: animation cut at six tenths": lambda: cut(moving_webp(), 0.6),
    "webp: canvas of 16 million a side": lambda: riff(b"WEBP", vp8x(2**24, 2**24), (b"ANIM", bytes(6)), webp_frame()),
    "webp: canvas of 6,000 a side": lambda: riff(
        b"WEBP", vp8x(6_000, 6_000), (b"ANIM", bytes(6)), webp_frame(), webp_frame()
    ),
    "webp: frame outside the canvas": lambda: riff(
        b"WEBP", vp8x(64, 64), (b"ANIM", bytes(6)), webp_frame(left=32), webp_frame()
    ),
    "webp: frame that is smaller than it says": lambda: riff(
        b"WEBP", vp8x(256, 256), (b"ANIM", bytes(6)), webp_frame(256, 256), webp_frame()
    ),
    "webp: frames without a picture": lambda: riff(
        b"WEBP", vp8x(64, 64), (b"ANIM", bytes(6)), *[(b"ANMF", webp_frame()[1][:16])] * 3
    ),
    "webp: frames of 3 bytes": lambda: riff(b"WEBP", vp8x(64, 64), (b"ANIM", bytes(6)), *[(b"ANMF", b"abc")] * 3),
    "webp: 10,000 frames": lambda: riff(
        b"WEBP", vp8x(64, 64), (b"ANIM", bytes(6)), *[(b"ANMF", webp_frame()[1])] * 10_000
    ),
    "webp: header of 4 bytes": lambda: riff(
        b"WEBP", (b"VP8X", b"\x12\0\0\0"), (b"ANIM", bytes(6)), webp_frame(), webp_frame()
    ),
    "webp: no header": lambda: riff(b"WEBP", webp_frame(), webp_frame()),
    "webp: lossless of 16,384 a side": lambda: _vp8l(16_384, 16_384),
    "webp: lossless of 8,000 a side, no pixels": lambda: _vp8l(8_000, 8_000),
    "webp: no picture": lambda: riff(b"WEBP"),
    # sound
    "webp: one frame": lambda: riff(b"WEBP", vp8x(64, 64), (b"ANIM", bytes(6)), webp_frame()),
    "webp: no delay": lambda: riff(b"WEBP", vp8x(64, 64), (b"ANIM", bytes(6)), *[webp_frame(ms=0)] * 3),
    "webp: a size that lies": lambda: sound_webp()[:4] + struct.pack("<I", 2**32 - 2) + sound_webp()[8:],
    "webp: two frames": lambda: animation("WEBP", 2, lossless=True),
    "webp: lossy with alpha": lambda: saved(subject("RGBA"), "WEBP", quality=80),
    "webp: unknown chunks": lambda: riff(
        b"WEBP",
        vp8x(64, 64, 0),
        (b"EVIL", bytes(99)),
        *[p for p in webp_parts(saved(subject(), "WEBP", lossless=True)) if p[0] == b"VP8L"],
    ),
}


# The others that OpenImageIO reads


OTHERS: dict[str, Make] = {
    "bmp: 60,000 a side": lambda: bmp(60_000, 60_000),
    "bmp: no width": lambda: bmp(0, 64),
    "bmp: cut": lambda: saved(subject(), "BMP")[:2000],
    "bmp: header alone": lambda: saved(subject(), "BMP")[:20],
    "bmp: 9 bits": lambda: bmp(64, 64, 9),
    "bmp: run-length garbage": lambda: bmp(64, 64, 8, 1, b"\xff\xff" * 50_000, 256),
    "bmp: lowest height": lambda: bmp(64, -(2**31)),
    "bmp: 4 billion palette entries": lambda: bmp(64, 64, 8)[:46] + struct.pack("<I", 2**32 - 1) + bmp(64, 64, 8)[50:],
    "exr: cut at a half": lambda: cut(exr(), 0.5),
    "exr: magic alone": lambda: b"v/1\x01",
    "exr: header without end": lambda: exr()[:60] + b"A" * 5000,
    "exr: two billion a side": lambda: exr_claiming(HUGE, HUGE),
    "exr: 10,900 a side of claims": lambda: exr_claiming(10_900, 10_900),
    "exr: window inside out": lambda: exr_claiming(-50, -50),
    "exr: all not a number": lambda: _written(".exr", np.full((SIZE, SIZE, 3), np.nan, np.float32), "float"),
    "exr: bomb of zeros": lambda: _zero_exr(4_000),
    "hdr: header alone": lambda: b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n",
    "hdr: two billion a side": lambda: (
        b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2147483647 +X 2147483647\n" + bytes(100)
    ),
    "hdr: cut": lambda: cut(_written(".hdr", opaque(disc()).astype(np.float32) / 255, "float"), 0.4),
    "hdr: negative size": lambda: b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y -64 +X -64\n" + bytes(16_384),
    "ppm: two billion a side": lambda: b"P6 2147483647 2147483647 255\n" + bytes(100),
    "ppm: no maximum": lambda: b"P6 64 64 0\n" + bytes(64 * 64 * 3),
    "ppm: cut": lambda: saved(subject(), "PPM")[:2000],
    "ppm: endless comment": lambda: b"P6\n#" + b"x" * 500_000,
    "ppm: negative size": lambda: b"P6 -64 -64 255\n" + bytes(64 * 64 * 3),
    "ppm: size of 400 digits": lambda: b"P5 " + b"9" * 400 + b" 64 255\n" + bytes(4096),
    "psd: 300,000 a side": lambda: psd(300_000, 300_000),
    "psd: 60,000 channels": lambda: psd(channels=60_000),
    "psd: cut": lambda: psd()[:5000],
    "psd: header alone": lambda: psd()[:26],
    "jp2: signature alone": lambda: b"\0\0\0\x0cjP  \r\n\x87\n",
    "jp2: cut": lambda: cut(saved(noise(), "JPEG2000"), 0.1),
    "jp2: four billion a side": lambda: _jp2(2**32 - 1, 2**32 - 1),
    "jp2: 10,900 a side of claims": lambda: _jp2(10_900, 10_900),
    "jxl: signature alone": lambda: b"\xff\x0a",
    "jxl: garbage": lambda: b"\xff\x0a" + bytes(range(256)) * 8,
    "jxl: box without a stream": lambda: b"\0\0\0\x0cJXL \r\n\x87\n\0\0\0\x14ftypjxl \0\0\0\0jxl ",
    # sound
    "bmp: from the top": lambda: bmp(64, -64, 24, 0, opaque(disc())[..., ::-1].tobytes()),
    "bmp: 1 bit": lambda: saved(subject("1"), "BMP"),
    "bmp: palette": lambda: saved(subject("P"), "BMP"),
    "exr: a quarter not a number": lambda: exr("float", np.nan),
    "exr: a quarter infinite": lambda: exr("float", np.inf),
    "exr: a quarter negative": lambda: exr("float", -1e30),
    "exr: 200 channels": lambda: exr("half", channels=200),
    "exr: depth alone": lambda: written(".exr", "float", ("Z",)),
    "exr: luminance and alpha": lambda: _written(
        ".exr", (disc().astype(np.float32) / 255)[..., [1, 3]], "half", ("Y", "A")
    ),
    "exr: scan lines of one, zipped": lambda: exr("half", compression="zips"),
    "exr: lossy": lambda: exr("half", compression="dwaa"),
    "hdr: sound": lambda: _written(".hdr", opaque(disc()).astype(np.float32) / 255, "float"),
    "ppm: sound": lambda: saved(subject(), "PPM"),
    "pgm: 16 bits": lambda: b"P5 64 64 65535\n" + (opaque(disc())[..., 1].astype(">u2") * 257).tobytes(),
    "psd: sound": psd,
    "jp2: sound": lambda: saved(subject(), "JPEG2000"),
    "jxl: sound": lambda: _written(".jxl", opaque(disc()).astype(np.float32) / 255, "uint8"),
}


def _zero_exr(side: int) -> bytes:
    return _written(".exr", np.zeros((side, side, 4), np.float32), "half", tuple("RGBA"), {"compression": "zip"})


def _jp2(width: int, height: int) -> bytes:
    content = saved(subject(), "JPEG2000")
    at = content.index(b"\xff\x4f\xff\x51") + 8  # Xsiz and Ysiz follow the capabilities
    return content[:at] + struct.pack(">II", width, height) + content[at + 8 :]


PICTURES: dict[str, Make] = {**PNGS, **JPEGS, **TIFFS, **GIFS, **WEBPS, **OTHERS}
__all__ = ["PICTURES", "flipped", "frames_zip", "moving_gif", "moving_webp", "sound_jpeg", "sound_png", "sound_webp"]
