"""Animated WebP thumbnail: the motion from the input view with a slightly swaying camera."""

import io
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from dg4d_lib.asset_settings import PackSettings
from dg4d_lib.assets.animated import pose_gaussians
from dg4d_lib.assets.rendering.preview import BATCH, render_over, studio_background
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.cameras.viewpoints import widened
from dg4d_lib.deformation.interface import Deformation
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.images import to_bytes
from dg4d_lib.rasterizer.interface import Rasterizer

LARGEST = 256  # maximum side, pixels
FPS = 12  # images per second
SWAY_S, SWAY_DEG = 4.0, 20.0  # minimum period (whole loops of the motion) and amplitude of the camera's sway
MAX_PICTURES = 96  # longer motions have fewer images per second
MAX_BYTES = 1_000_000
QUALITIES = (90, 70, 50, 30)  # tried in this order until the file is below `MAX_BYTES`


def write_webp(
    path: Path,
    gaussians: Gaussians,
    deformation: Deformation,
    frames: int,
    fps: float,
    rasterizer: Rasterizer,
    settings: PackSettings,
    points: Float[Tensor, "t p 3"],
) -> None:
    """Write an endlessly looping animated WebP of up to 256 pixels a side.

    Equal arguments give equal bytes.

    Args:
        path: output file.
        gaussians: the canonical cloud.
        deformation: its motion.
        frames: number of frames of the motion.
        fps: frames per second of the motion.
        rasterizer: the splatting backend.
        settings: size of the previews.
        points: output of `shown_points`, which the pictures hold.

    Raises:
        OSError: the file could not be written.
    """
    duration_s = frames / fps
    loops = max(1, math.ceil(SWAY_S / duration_s))
    count = min(MAX_PICTURES, round(loops * duration_s * FPS))
    phases = torch.arange(count, dtype=torch.float64) / count
    positions = phases * loops * frames % frames
    size = min(LARGEST, settings.preview_size)
    front, background = OrbitCamera(width=size, height=size), studio_background(size)
    swaying = [replace(front, azimuth_deg=SWAY_DEG * math.sin(math.tau * phase)) for phase in phases.tolist()]
    cameras = widened(swaying, points)
    pictures: list[Image.Image] = []
    for start in range(0, count, BATCH):
        part = slice(start, start + BATCH)
        states = pose_gaussians(gaussians, deformation, frames, positions[part])
        renders = render_over(background, states, cameras[part], rasterizer)
        pictures += [Image.fromarray(pixels) for pixels in to_bytes(renders).numpy()]
    ends_ms = [round(1000 * loops * duration_s * (i + 1) / count) for i in range(count)]
    path.write_bytes(_encode(pictures, [end - start for start, end in zip([0, *ends_ms], ends_ms, strict=False)]))


def _encode(pictures: Sequence[Image.Image], durations_ms: list[int]) -> bytes:
    content = io.BytesIO()
    for quality in QUALITIES:
        content = io.BytesIO()
        pictures[0].save(
            content, "WEBP", save_all=True, append_images=pictures[1:], duration=durations_ms, loop=0, quality=quality
        )
        if content.tell() <= MAX_BYTES:
            break
    return content.getvalue()
