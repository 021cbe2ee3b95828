"""Pictures of the gallery: cut-outs, a flat drawing on paper, and a photograph of a rendered scene."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy import ndarray
from PIL import Image, ImageDraw
from scipy import ndimage

from dg4d_lib.cameras.orbit import OrbitCamera
from examples.drawing import draw
from examples.gallery import creatures, things
from examples.gallery.figures import Figure

SIZE = 512  # pixels
FINE = 4  # samples on a side of a pixel of the drawing
QUALITY = 90  # of WebP and JPEG
PAPER, INK = (250, 246, 236), (42, 34, 58)
SKIN, SHADE, SPOT, BLUSH = (236, 104, 122), (204, 74, 104), (250, 160, 160), (250, 150, 140)
INK_WIDTH = 9.0  # of the outlines, in pixels of the finished drawing
NOISE = 0.008  # standard deviation of the camera noise, of full scale


def write_picture(name: str, path: Path) -> None:
    """Draw one picture of the gallery; its name chooses the subject, the suffix of the path the format."""
    drawn = DRAWN[name]() if name in DRAWN else cutout(FIGURES[name]())
    drawn.save(path, quality=QUALITY, method=6)  # JPEG ignores the method of WebP


def cutout(figure: Figure) -> Image.Image:
    """Draw a figure on a transparent background."""
    picture = draw(figure, 0.0, OrbitCamera(width=SIZE, height=SIZE)).numpy()
    return Image.fromarray((picture * 255).round().astype(np.uint8))


def octopus() -> Image.Image:
    """Draw a flat octopus with outlines on paper."""
    size = SIZE * FINE
    page = Image.new("RGB", (size, size), PAPER)
    pen = ImageDraw.Draw(page)
    arms = [_arm(k) for k in range(6)]
    for color, more in ((INK, INK_WIDTH), (SKIN, 0.0)):
        for arm in arms:
            for x, y, radius in arm:
                _dot(pen, x, y, radius + more, color)
        _oval(pen, (256, 190), (132 + more, 126 + more), color)
    for arm in arms:
        for x, y, radius in arm[10:-6:7]:
            _dot(pen, x, y, radius * 0.42, SPOT)
    _oval(pen, (256, 304), (104, 14), SHADE)
    _oval(pen, (256, 290), (110, 22), SKIN)
    for x, y, radius in ((190, 112, 17), (226, 92, 10), (322, 116, 13), (166, 156, 8)):
        _dot(pen, x, y, radius, SPOT)
    for side in (-1, 1):
        x = 256 + 50 * side
        _dot(pen, x, 208, 37, INK)
        _dot(pen, x, 208, 31, (255, 255, 255))
        _dot(pen, x + 6, 212, 18, INK)
        _dot(pen, x + 12, 204, 6.5, (255, 255, 255))
        _oval(pen, (256 + 92 * side, 252), (17, 11), BLUSH)
    smile = [FINE * v for v in (232, 238, 280, 276)]
    pen.arc(smile, 15, 165, fill=INK, width=round(5 * FINE))
    return page.resize((SIZE, SIZE), Image.Resampling.LANCZOS)


def _arm(number: int) -> list[tuple[float, float, float]]:
    """Return circles along an arm, from the body to its curled tip: x, y, radius in pixels."""
    side = -1 if number < 3 else 1
    rank = number if number < 3 else 5 - number  # 0 is the outermost
    x, y = 256.0 + side * (92 - 40 * rank), 272.0
    angle = math.radians(38 + 24 * rank)
    circles: list[tuple[float, float, float]] = []
    count = 70
    for k in range(count):
        share = k / (count - 1)
        circles.append((x, y, 29 - 19 * share))
        angle += math.radians(0.9 * (1 - 0.6 * rank) - (3.0 + rank) * max(0.0, share - 0.42))
        x += side * math.cos(angle) * (3.15 - 0.25 * rank)
        y += math.sin(angle) * (3.15 - 0.25 * rank)
    return circles


def photograph() -> Image.Image:
    """Render a rubber duck on a table before a wall, as a camera would take it."""
    rows, columns = np.mgrid[0:SIZE, 0:SIZE] / SIZE
    wall = np.array((0.55, 0.66, 0.70)) + (0.16 * (1 - np.hypot(columns - 0.3, rows - 0.2)))[..., None]
    grain = ndimage.gaussian_filter(np.random.default_rng(4).standard_normal((SIZE, SIZE)), (1.2, 40)) * 0.35
    table = np.array((0.74, 0.60, 0.47)) * (0.92 + 0.10 * rows + grain)[..., None]
    edge = np.clip((rows - 0.62) * 60, 0, 1)[..., None]
    scene = ndimage.gaussian_filter(wall * (1 - edge) + table * edge, (2.5, 2.5, 0))
    shadow = np.exp(-(((columns - 0.44) / 0.30) ** 4) - ((rows - 0.748) / 0.034) ** 2)
    scene *= 1 - 0.55 * ndimage.gaussian_filter(shadow, 9)[..., None]
    subject = draw(things.duck(), 0.0, OrbitCamera(width=SIZE, height=SIZE)).numpy()
    scene = scene * (1 - subject[..., 3:]) + subject[..., :3] * subject[..., 3:]
    return _developed(scene)


def _developed(scene: ndarray) -> Image.Image:
    """Return a scene with the falling light, the blur and the noise of a camera."""
    rows, columns = np.mgrid[-1 : 1 : SIZE * 1j, -1 : 1 : SIZE * 1j]
    scene = ndimage.gaussian_filter(scene, (0.6, 0.6, 0)) * (1 - 0.10 * (rows**2 + columns**2))[..., None]
    scene = scene + NOISE * np.random.default_rng(5).standard_normal(scene.shape)
    return Image.fromarray((scene.clip(0, 1) * 255).round().astype(np.uint8))


def _dot(pen: ImageDraw.ImageDraw, x: float, y: float, radius: float, color: tuple[int, int, int]) -> None:
    _oval(pen, (x, y), (radius, radius), color)


def _oval(
    pen: ImageDraw.ImageDraw, center: tuple[float, float], radii: tuple[float, float], color: tuple[int, int, int]
) -> None:
    (x, y), (a, b) = center, radii
    pen.ellipse([FINE * (x - a), FINE * (y - b), FINE * (x + a), FINE * (y + b)], fill=color)


FIGURES: dict[str, Callable[[], Figure]] = {
    "elephant": creatures.elephant,
    "robot": creatures.robot,
    "toucan": creatures.toucan,
    "fish": creatures.fish,
    "cactus": things.cactus,
    "car": things.car,
    "armchair": things.armchair,
    "rings": things.rings,
}
DRAWN: dict[str, Callable[[], Image.Image]] = {"octopus": octopus, "duck": photograph}
