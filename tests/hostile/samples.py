"""Sound pictures, each encoded once."""

import functools
import io
import zipfile

from PIL import Image

from tests.hostile.formats import (
    animation,
    disc,
    noise,
    saved,
    subject,
)


@functools.cache
def sound_png() -> bytes:
    return saved(subject("RGBA"), "PNG")


@functools.cache
def noise_png() -> bytes:
    return saved(noise(), "PNG")


@functools.cache
def sound_jpeg() -> bytes:
    return saved(subject(), "JPEG", quality=90)


@functools.cache
def noise_jpeg() -> bytes:
    return saved(noise(128), "JPEG", quality=90)


@functools.cache
def sound_webp() -> bytes:
    return saved(subject("RGBA"), "WEBP", lossless=True)


@functools.cache
def moving_webp() -> bytes:
    return animation("WEBP", 5, lossless=True)


@functools.cache
def moving_gif() -> bytes:
    return animation("GIF", 5, disposal=2, loop=0)


@functools.cache
def frames_zip() -> bytes:
    """Return two numbered frames in a zip."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for i in range(2):
            archive.writestr(f"{i}.png", saved(Image.fromarray(disc(8 + 4 * i)), "PNG"))
    return file.getvalue()
