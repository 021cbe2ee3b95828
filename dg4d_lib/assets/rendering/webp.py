"""A small moving picture for web pages and tables: the motion from the input side, while the camera sways a little."""

import io
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from PIL import Image

from dg4d_lib.asset_settings import PackSettings
from dg4d_lib.assets.animated import pose_gaussians
from dg4d_lib.assets.rendering.preview import BATCH, render_over, studio_background
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.deformation.interface import Deformation
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.rasterizer.interface import Rasterizer

LARGEST = 256  # pixels of a side
FPS = 12  # pictures per second
SWAY_S, SWAY_DEG = 4.0, 20.0  # the camera goes to both sides and back; whole loops of the motion, at least this long
MOST_PICTURES = 96  # a longer motion shows fewer pictures per second
MOST_BYTES = 1_000_000
QUALITIES = (90, 70, 50, 30)  # the first that keeps the file below `MOST_BYTES`, else the last


def write_webp(
    path: Path,
    gaussians: Gaussians,
    deformation: Deformation,
    frames: int,
    fps: float,
    rasterizer: Rasterizer,
    settings: PackSettings,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write an animated WebP without end, up to 256 pixels a side.

    Equal arguments give equal bytes.

    Args:
        path: of the file.
        gaussians: at rest.
        deformation: their motion.
        frames: of the motion.
        fps: frames per second of the motion.
        rasterizer: draws the pictures.
        settings: size of the previews.
        progress: called with pictures done and their number.

    Raises:
        OSError: the file could not be written.
    """
    duration_s = frames / fps
    loops = max(1, math.ceil(SWAY_S / duration_s))
    count = min(MOST_PICTURES, round(loops * duration_s * FPS))
    share = torch.arange(count, dtype=torch.float64) / count
    positions = share * loops * frames % frames
    size = min(LARGEST, settings.preview_size)
    middle, background = OrbitCamera(width=size, height=size), studio_background(size)
    cameras = [replace(middle, azimuth_deg=SWAY_DEG * math.sin(math.tau * turn)) for turn in share.tolist()]
    pictures: list[Image.Image] = []
    for start in range(0, count, BATCH):
        part = slice(start, start + BATCH)
        states = pose_gaussians(gaussians, deformation, frames, positions[part])
        drawn = render_over(background, states, cameras[part], rasterizer)
        pictures += [Image.fromarray(pixels) for pixels in (drawn.cpu() * 255).round().to(torch.uint8).numpy()]
        progress(len(pictures), count)
    ends_ms = [round(1000 * loops * duration_s * (i + 1) / count) for i in range(count)]
    path.write_bytes(_encoded(pictures, [end - start for start, end in zip([0, *ends_ms], ends_ms, strict=False)]))


def _encoded(pictures: Sequence[Image.Image], durations_ms: list[int]) -> bytes:
    content = io.BytesIO()
    for quality in QUALITIES:
        content = io.BytesIO()
        pictures[0].save(
            content, "WEBP", save_all=True, append_images=pictures[1:], duration=durations_ms, loop=0, quality=quality
        )
        if content.tell() <= MOST_BYTES:
            break
    return content.getvalue()
