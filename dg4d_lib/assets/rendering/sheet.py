"""Contact sheets: tiles of an asset from several azimuths at several frames, and of driving videos."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from dg4d_lib.asset_settings import PackSettings
from dg4d_lib.assets.animated import pose_gaussians
from dg4d_lib.assets.rendering.preview import BATCH, render_lit_over, render_over
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.cameras.viewpoints import widened
from dg4d_lib.deformation.interface import Deformation
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.images import resize, to_bytes
from dg4d_lib.mesh.render import LitRenderer
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.rasterizer.interface import Rasterizer
from dg4d_lib.video.driving import DrivingVideo

PAGE, PANEL, INK = (255, 255, 255), (0.945, 0.948, 0.955), (70, 74, 82)
GAP = 1 / 24  # between and around tiles, in tiles
FONT = 1 / 12  # height of the captions, in tiles
SMALLEST_FONT = 9  # minimum readable height, pixels


def draw_contact_sheet(
    gaussians: Gaussians,
    deformation: Deformation,
    video: DrivingVideo,
    rasterizer: Rasterizer,
    settings: PackSettings,
    points: Float[Tensor, "t p 3"],
    mesh_at: Callable[[int], TexturedMesh] | None = None,
) -> Float[Tensor, "h w 3"]:
    """Draw the contact sheet of an asset as an image in [0, 1].

    Columns are frames, evenly spaced from the first to the last. The first row shows the driving video, the next ones
    the splats at one azimuth of `sheet_azimuths_deg` each, the last ones the lit mesh at one of
    `sheet_mesh_azimuths_deg` each, all at elevation 0 and in one scale, at which nothing leaves a tile.

    Args:
        gaussians: the canonical cloud.
        deformation: its motion.
        video: driving video; determines the number of frames and the frame rate.
        rasterizer: the splatting backend.
        settings: size of a tile, columns and rows.
        points: output of `shown_points`, which the tiles hold.
        mesh_at: mesh at a frame; None: no rows of meshes.
    """
    columns, size = min(settings.sheet_frames, len(video)), settings.sheet_size
    frames = torch.linspace(0, len(video) - 1, columns).round().long()
    panel = torch.tensor(PANEL).expand(size, size, 3)
    states = pose_gaussians(gaussians, deformation, len(video), frames.float())
    azimuths_deg = (0.0, *settings.sheet_azimuths_deg, *settings.sheet_mesh_azimuths_deg)
    views = [OrbitCamera(azimuth_deg=azimuth_deg, width=size, height=size) for azimuth_deg in azimuths_deg]
    front, *cameras = widened(views, points)
    rows = [_video_tiles(video, frames, size, views[0].tan_half_fov[0] / front.tan_half_fov[0])]
    of_splats, of_meshes = cameras[: len(settings.sheet_azimuths_deg)], cameras[len(settings.sheet_azimuths_deg) :]
    for camera in of_splats:
        tiles = [
            render_over(panel, states.states(part), [camera] * len(part), rasterizer)
            for part in torch.arange(columns).split(BATCH)
        ]
        rows.append(torch.cat(tiles))
    names = ["input", *(f"{azimuth_deg:g}°" for azimuth_deg in settings.sheet_azimuths_deg)]
    if mesh_at is not None:
        meshes = [mesh_at(int(frame)) for frame in frames]
        lit = LitRenderer()
        rows += [render_lit_over(panel, meshes, [camera] * columns, lit) for camera in of_meshes]
        names += [f"mesh {azimuth_deg:g}°" for azimuth_deg in settings.sheet_mesh_azimuths_deg]
    return draw_tiles(torch.stack(rows), names, _timestamps(frames, video.fps))


def draw_video_sheet(
    videos: Sequence[DrivingVideo], names: Sequence[str], size: int, columns: int
) -> Float[Tensor, "h w 3"]:
    """Draw several videos in rows as an image in [0, 1]; columns are frames, from the first to the last.

    Args:
        videos: videos of equal length and frame rate.
        names: captions of the rows.
        size: side of a tile, pixels.
        columns: maximum number of frames.
    """
    frames = torch.linspace(0, len(videos[0]) - 1, min(columns, len(videos[0]))).round().long()
    rows = torch.stack([_video_tiles(video, frames, size) for video in videos])
    return draw_tiles(rows, names, _timestamps(frames, videos[0].fps))


def draw_tiles(
    tiles: Float[Tensor, "r m s s 3"], names: Sequence[str], headings: Sequence[str]
) -> Float[Tensor, "h w 3"]:
    """Draw tiles in [0, 1] on a white page, with row names on the left and headings above the columns."""
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
            sheet.paste(
                Image.fromarray(to_bytes(tiles[row, column]).numpy()),
                (left + column * (size + gap), top + row * (size + gap)),
            )
    return torch.from_numpy(np.array(sheet)).float() / 255


def _timestamps(frames: Tensor, fps: float) -> list[str]:
    return [f"{frame / fps:.2f} s" for frame in frames.tolist()]


def _video_tiles(video: DrivingVideo, frames: Tensor, size: int, scale: float = 1.0) -> Float[Tensor, "m size size 3"]:
    """Composite frames of the video over the panel color and resize them to a part of the side of tiles."""
    over = DrivingVideo(video.frames[frames], video.alpha[frames], video.fps).over(torch.tensor(PANEL))
    tiles, side = torch.tensor(PANEL).expand(len(frames), size, size, 3).clone(), max(1, round(scale * size))
    first = (size - side) // 2
    tiles[:, first : first + side, first : first + side] = resize(over, (side, side)).clamp(0, 1)
    return tiles
