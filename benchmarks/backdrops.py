"""Backdrops for cut-outs: twenty procedural ones, and photographs that scikit-image's wheel carries."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy import ndimage
from skimage import data
from skimage.color import gray2rgb
from skimage.transform import resize
from skimage.util import img_as_float

Backdrop = Float[ndarray, "s s 3"]
PHOTOGRAPHS = (  # files of the wheel; others are downloaded, which a measurement must not need
    "brick", "grass", "gravel", "coffee", "rocket", "astronaut", "chelsea", "hubble_deep_field",
    "immunohistochemistry", "camera", "moon", "coins",
)  # fmt: skip


def photographs(size: int) -> dict[str, Backdrop]:
    """Return the central squares of the photographs, resized."""
    return {name: _central_square(getattr(data, name)(), size) for name in PHOTOGRAPHS}


def procedural(size: int) -> dict[str, Backdrop]:
    """Return twenty backdrops, from plain to busy, the same in every call."""
    random = np.random.default_rng(0)
    y, x = np.mgrid[-1 : 1 : size * 1j, -1 : 1 : size * 1j]

    def clouds(scale: float, octaves: int = 4) -> ndarray:
        """Return fractal noise in [0, 1] whose largest structures span a share of the side."""
        total = np.zeros((size, size))
        for octave in range(octaves):
            noise = ndimage.gaussian_filter(random.standard_normal((size, size)), scale * size / 2**octave, mode="wrap")
            total += noise / noise.std() / 2**octave
        return (total - total.min()) / np.ptp(total)

    def mix(share: ndarray, one: tuple[float, ...], other: tuple[float, ...]) -> Backdrop:
        return share[..., None] * np.array(one) + (1 - share[..., None]) * np.array(other)

    def plain(*color: float) -> Backdrop:
        return np.ones((size, size, 3)) * color

    floor = y > 0.35 + 0.02 * np.sin(9 * x)
    shadow = 1 - 0.35 * np.exp(-((x / 0.5) ** 2 + ((y - 0.75) / 0.12) ** 2))
    makers: dict[str, Callable[[], Backdrop]] = {
        "white": lambda: plain(1, 1, 1),
        "gray": lambda: plain(0.5, 0.5, 0.5),
        "green screen": lambda: plain(0.1, 0.7, 0.2),
        "black": lambda: plain(0.02, 0.02, 0.03),
        "gray with noise": lambda: plain(0.6, 0.6, 0.6) + 0.03 * random.standard_normal((size, size, 3)),
        "ramp": lambda: mix((y + 1) / 2, (0.3, 0.4, 0.6), (0.85, 0.9, 1.0)),
        "vignette": lambda: plain(0.9, 0.85, 0.8) * (1 - 0.35 * (x**2 + y**2) / 2)[..., None],
        "studio with shadow": lambda: plain(0.9, 0.9, 0.92) * shadow[..., None],
        "two walls": lambda: mix((x > 0.1).astype(float), (0.7, 0.6, 0.5), (0.45, 0.4, 0.38)),
        "wall and floor": lambda: mix(floor.astype(float), (0.45, 0.32, 0.2), (0.8, 0.82, 0.78)) * shadow[..., None],
        "soft clouds": lambda: mix(clouds(0.25), (0.4, 0.6, 0.9), (0.95, 0.95, 0.97)),
        "fine clouds": lambda: mix(clouds(0.06), (0.3, 0.35, 0.25), (0.7, 0.72, 0.6)),
        "colored clouds": lambda: np.stack([clouds(0.12) for _ in range(3)], -1),
        "stripes": lambda: mix((np.sin(24 * x + 3 * y) > 0).astype(float), (0.85, 0.85, 0.8), (0.55, 0.6, 0.7)),
        "checks": lambda: mix(((x * 6 % 2 > 1) ^ (y * 6 % 2 > 1)).astype(float), (0.8, 0.75, 0.7), (0.5, 0.45, 0.4)),
        "tiles": lambda: mix(
            ((x * 5 % 1 > 0.06) & (y * 5 % 1 > 0.06)).astype(float), (0.65, 0.7, 0.72), (0.35, 0.36, 0.38)
        ) * (0.9 + 0.1 * clouds(0.1))[..., None],
        "wood": lambda: mix(0.5 + 0.5 * np.sin(60 * x + 14 * clouds(0.15)), (0.55, 0.38, 0.22), (0.42, 0.27, 0.15)),
        "bokeh": lambda: _bokeh(random, x, y),
        "grassy ground": lambda: mix(
            np.clip(clouds(0.01, 2) + 0.4 * (y < -0.2), 0, 1), (0.35, 0.5, 0.2), (0.12, 0.2, 0.08)
        ),
        "dots": lambda: mix(
            (np.hypot(x * 7 % 1 - 0.5, y * 7 % 1 - 0.5) < 0.22).astype(float), (0.75, 0.4, 0.4), (0.93, 0.9, 0.86)
        ),
    }  # fmt: skip
    return {name: make().clip(0, 1) for name, make in makers.items()}


def _bokeh(random: np.random.Generator, x: ndarray, y: ndarray) -> Backdrop:
    """Return blurred lights of several colors over a dark gradient."""
    picture = np.stack([0.1 + 0.05 * (y + 1), 0.1 + 0.04 * (y + 1), 0.16 + 0.06 * (x + 1)], -1)
    for _ in range(24):
        (u, v), radius = random.uniform(-1, 1, 2), random.uniform(0.05, 0.14)
        disc = 1 / (1 + np.exp((np.hypot(x - u, y - v) - radius) / 0.012))
        picture += 0.35 * disc[..., None] * random.uniform(0.3, 1, 3)
    return picture


def _central_square(picture: ndarray, size: int) -> Backdrop:
    color = img_as_float(picture if picture.ndim == 3 else gray2rgb(picture))[..., :3]
    side = min(color.shape[:2])
    top, left = ((length - side) // 2 for length in color.shape[:2])
    square = color[top : top + side, left : left + side]
    return np.asarray(resize(square, (size, size), anti_aliasing=True)).clip(0, 1)
