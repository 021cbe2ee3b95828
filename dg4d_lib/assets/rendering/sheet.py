"""A contact sheet: what an asset looks like from several sides at several moments, on one page."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from dg4d_lib.asset_settings import PackSettings
from dg4d_lib.assets.animated import pose_gaussians
from dg4d_lib.assets.rendering.preview import BATCH, render_over
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.deformation.interface import Deformation
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.images import resize
from dg4d_lib.rasterizer.interface import Rasterizer
from dg4d_lib.video.driving import DrivingVideo

PAGE, PANEL, INK = (255, 255, 255), (0.945, 0.948, 0.955), (70, 74, 82)
GAP = 1 / 24  # between tiles and around them, in tiles
FONT = 1 / 12  # height of the captions, in tiles
SMALLEST_FONT = 9  # pixels; below it nobody can read


def draw_contact_sheet(
    gaussians: Gaussians,
    deformation: Deformation,
    video: DrivingVideo,
    rasterizer: Rasterizer,
    settings: PackSettings,
) -> Float[Tensor, "h w 3"]:
    """The sheet as a picture in [0, 1].

    Columns are moments, evenly spread from the first to the last frame. The first row is the driving video, then comes
    a row per azimuth of `sheet_azimuths_deg`, seen at elevation 0.

    Args:
        gaussians: at rest.
        deformation: their motion.
        video: that they were fitted to; says the number of frames and the frame rate.
        rasterizer: draws the tiles.
        settings: size of a tile, columns and rows.
    """
    columns = min(settings.sheet_frames, len(video))
    frames = torch.linspace(0, len(video) - 1, columns).round().long()
    panel = torch.tensor(PANEL).expand(settings.sheet_size, settings.sheet_size, 3)
    rows = [_footage(video, frames, settings.sheet_size)]
    states = pose_gaussians(gaussians, deformation, len(video), frames.float())
    for azimuth_deg in settings.sheet_azimuths_deg:
        camera = OrbitCamera(azimuth_deg=azimuth_deg, width=settings.sheet_size, height=settings.sheet_size)
        tiles = [
            render_over(panel, _part(states, part), [camera] * len(part), rasterizer)
            for part in torch.arange(columns).split(BATCH)
        ]
        rows.append(torch.cat(tiles))
    names = ["input", *(f"{azimuth_deg:g}°" for azimuth_deg in settings.sheet_azimuths_deg)]
    return draw_tiles(torch.stack(rows), names, _moments(frames, video.fps))


def draw_video_sheet(
    videos: Sequence[DrivingVideo], names: Sequence[str], size: int, columns: int
) -> Float[Tensor, "h w 3"]:
    """Several videos below each other as a picture in [0, 1]; columns are moments, from the first frame to the last.

    Args:
        videos: all of one length and rate.
        names: of the rows.
        size: pixels of a tile.
        columns: moments, at most.
    """
    frames = torch.linspace(0, len(videos[0]) - 1, min(columns, len(videos[0]))).round().long()
    rows = torch.stack([_footage(video, frames, size) for video in videos])
    return draw_tiles(rows, names, _moments(frames, videos[0].fps))


def draw_tiles(
    tiles: Float[Tensor, "r m s s 3"], names: Sequence[str], headings: Sequence[str]
) -> Float[Tensor, "h w 3"]:
    """Tiles in [0, 1] on a white page, rows named on the left, columns above."""
    size = tiles.shape[2]
    gap = max(2, round(size * GAP))
    font = ImageFont.load_default(max(SMALLEST_FONT, round(size * FONT)))
    probe = ImageDraw.Draw(Image.new("RGB", (1, 1)))
    left = 2 * gap + max(round(probe.textlength(name, font)) for name in names)
    top = 2 * gap + round(probe.textbbox((0, 0), "0.00 s", font)[3])
    sheet = Image.new("RGB", (left + len(headings) * (size + gap), top + len(names) * (size + gap)), PAGE)
    draw = ImageDraw.Draw(sheet)
    for column, heading in enumerate(headings):
        draw.text((left + column * (size + gap) + size // 2, top - gap), heading, INK, font, anchor="ms")
    for row, name in enumerate(names):
        draw.text((left - gap, top + row * (size + gap) + size // 2), name, INK, font, anchor="rm")
        for column in range(len(headings)):
            pixels = (tiles[row, column].detach().cpu() * 255).round().to(torch.uint8).numpy()
            sheet.paste(Image.fromarray(pixels), (left + column * (size + gap), top + row * (size + gap)))
    return torch.from_numpy(np.array(sheet)).float() / 255


def _moments(frames: Tensor, fps: float) -> list[str]:
    return [f"{frame / fps:.2f} s" for frame in frames.tolist()]


def _part(states: Gaussians, wanted: Tensor) -> Gaussians:
    return replace(states, means=states.means[wanted], log_scales=states.log_scales[wanted], quats=states.quats[wanted])


def _footage(video: DrivingVideo, frames: Tensor, size: int) -> Float[Tensor, "m size size 3"]:
    """Frames of the driving video over the panel, resampled to the size of a tile."""
    over = DrivingVideo(video.frames[frames], video.alpha[frames], video.fps).over(torch.tensor(PANEL))
    return resize(over, (size, size)).clamp(0, 1)
