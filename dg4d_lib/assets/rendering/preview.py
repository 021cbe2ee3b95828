"""Preview videos: an animated asset with an orbiting camera, its lit mesh beside it, or a turntable of a static one."""

from collections.abc import Callable, Sequence
from fractions import Fraction
from math import ceil
from pathlib import Path
from typing import NamedTuple, cast

import av
import torch
from av.video.reformatter import ColorRange, Colorspace
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.asset_settings import PackSettings
from dg4d_lib.assets.animated import pose_gaussians
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.cameras.viewpoints import turntable, widened
from dg4d_lib.deformation.interface import Deformation
from dg4d_lib.errors import BackendUnavailable
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.images import to_bytes
from dg4d_lib.mesh.render import LitRenderer
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.rasterizer.interface import Rasterizer

SMOOTH_FPS = 20  # slower motions are also sampled between their frames, so that the orbit looks smooth
MAX_PICTURES = 600  # limit for sampling between frames; longer videos still have all their own frames
ELEVATION_DEG = 10.0  # of the camera
TURN_S = 5  # duration of a turntable, seconds
PROBES, OPAQUE = 32, 0.5  # frames, at most, and opacity of the Gaussians, that pictures have to hold
PREVIEW_SAMPLES = 2  # of meshes, per pixel along each axis
BATCH = 8  # images per rasterizer call; bounds memory
CODECS = {  # best first; without `cpu-independent`, x264's lookahead changed the bytes of one video in ten
    "libx264": {"crf": "18", "preset": "medium", "x264-params": "cpu-independent=1"},
    "mpeg4": {"qscale": "3"},
}
MAX_DENOMINATOR = 65535  # of frame rates below 1; the numerators are smaller, and mpeg4 takes no larger ones
BT709 = 1  # color primaries, transfer and matrix, as numbered in H.273
CENTER, CORNER = (0.975, 0.975, 0.98), (0.84, 0.85, 0.87)  # colors of the background


Background = Float[Tensor, "s s 3"]
Pictures = Float[Tensor, "b h w 3"]


class Orbit(NamedTuple):
    """Layout of a video in which the camera goes round once.

    Attributes:
        pictures: their number.
        fps: pictures per second.
        size: of a panel, pixels.
        panels: beside each other.
    """

    pictures: int
    fps: float
    size: int
    panels: int


def write_preview(
    path: Path,
    gaussians: Gaussians,
    deformation: Deformation,
    frames: int,
    fps: float,
    rasterizer: Rasterizer,
    settings: PackSettings,
    points: Float[Tensor, "t p 3"],
    mesh_at: Callable[[float], TexturedMesh] | None = None,
) -> tuple[str, ...]:
    """Write a silent MP4 (H.264, yuv420p) in which the motion loops `preview_turns` times during one orbit.

    The left half shows the splats, the right half the mesh under a light. The camera's field of view is that of the
    input, or as much larger as it takes to show the whole asset from all sides.

    Equal arguments give equal bytes.

    Args:
        path: output file, ending in .mp4.
        gaussians: the canonical cloud.
        deformation: its motion.
        frames: number of frames of the motion.
        fps: frames per second of the motion.
        rasterizer: the splatting backend.
        settings: size and number of loops.
        points: output of `shown_points`, which the pictures hold.
        mesh_at: mesh at a position of the motion, in frames; None: the splats alone.

    Returns:
        Notes for the report: empty, or the name of the fallback codec.

    Raises:
        BackendUnavailable: this build of FFmpeg has no supported MP4 codec.
        OSError: the file could not be written.
    """
    repeats = max(1, min(ceil(SMOOTH_FPS / fps), MAX_PICTURES // (frames * settings.preview_turns)))
    positions = torch.arange(frames * repeats).repeat(settings.preview_turns) / repeats

    lit = LitRenderer(PREVIEW_SAMPLES)

    def draw(part: slice, cameras: Sequence[OrbitCamera], background: Background) -> Pictures:
        states = pose_gaussians(gaussians, deformation, frames, positions[part])
        splats = render_over(background, states, cameras, rasterizer)
        if mesh_at is None:
            return splats
        meshes = [mesh_at(position) for position in positions[part].tolist()]
        return torch.cat([splats, render_lit_over(background, meshes, cameras, lit)], 2)

    panels = 1 if mesh_at is None else 2
    orbit = Orbit(len(positions), fps * repeats, settings.preview_size, panels)
    return _write_orbit(path, orbit, points, draw)


def write_turntable(
    path: Path, gaussians: Gaussians, rasterizer: Rasterizer, settings: PackSettings
) -> tuple[str, ...]:
    """Write a silent MP4 (H.264, yuv420p) of one orbit around a single state, starting at the input view's azimuth.

    Equal arguments give equal bytes.

    Args:
        path: output file, ending in .mp4.
        gaussians: one state.
        rasterizer: the splatting backend.
        settings: size.

    Returns:
        Notes for the report: empty, or the name of the fallback codec.

    Raises:
        BackendUnavailable: this build of FFmpeg has no supported MP4 codec.
        OSError: the file could not be written.
    """

    def draw(part: slice, cameras: Sequence[OrbitCamera], background: Background) -> Pictures:
        return render_over(background, gaussians, cameras, rasterizer)

    orbit = Orbit(TURN_S * SMOOTH_FPS, SMOOTH_FPS, settings.preview_size, 1)
    return _write_orbit(path, orbit, _opaque(gaussians)[None], draw)


def _write_orbit(
    path: Path,
    orbit: Orbit,
    points: Float[Tensor, "t p 3"],
    draw: Callable[[slice, Sequence[OrbitCamera], Background], Pictures],
) -> tuple[str, ...]:
    """Write a video of one orbit that shows the points; `draw` returns a range of its images over a background."""
    size, count = orbit.size, orbit.pictures
    cameras = widened(turntable(count, OrbitCamera(ELEVATION_DEG, width=size, height=size)), points)
    background, codec = studio_background(size), _codec()
    with Mp4Writer(path, codec, orbit.fps, size, orbit.panels * size) as video:
        for start in range(0, count, BATCH):
            part = slice(start, start + BATCH)
            video.add(draw(part, cameras[part], background))
    return () if codec == "libx264" else (f"{path.name} is encoded with {codec}, since this FFmpeg lacks libx264",)


def shown_points(gaussians: Gaussians, deformation: Deformation, frames: int) -> Float[Tensor, "t p 3"]:
    """Return centers of opaque Gaussians at some frames, which pictures of a motion have to hold."""
    positions = torch.linspace(0, frames - 1, min(PROBES, frames)).round()
    return _opaque(pose_gaussians(gaussians, deformation, frames, positions))


def _opaque(states: Gaussians) -> Float[Tensor, "*t p 3"]:
    return states.means[..., states.opacities > OPAQUE, :]


def write_mp4(path: Path, pictures: Float[Tensor, "t h w 3"], fps: float) -> None:
    """Write images in [0, 1] with even numbers of rows and columns as a silent MP4.

    Raises:
        BackendUnavailable: this build of FFmpeg has no supported MP4 codec.
        OSError: the file could not be written.
    """
    with Mp4Writer(path, _codec(), fps, *pictures.shape[1:3]) as video:
        video.add(pictures)


def _codec() -> str:
    codec = next((name for name in CODECS if name in av.codecs_available), None)
    if codec is None:
        raise BackendUnavailable(
            f"this FFmpeg has none of the codecs {', '.join(CODECS)}; run `pip install --force-reinstall av`"
        )
    return codec


def render_over(
    background: Float[Tensor, "h w 3"], states: Gaussians, cameras: Sequence[OrbitCamera], rasterizer: Rasterizer
) -> Float[Tensor, "b h w 3"]:
    """Render every state from its camera over a background image, without gradients."""
    with torch.no_grad():
        render = rasterizer(states, cameras, states.means.new_zeros(3))
        return torch.addcmul(render.color, 1 - render.alpha, background.to(render.color)).clamp_(0, 1)


def render_lit_over(
    background: Float[Tensor, "h w 3"],
    meshes: Sequence[TexturedMesh],
    cameras: Sequence[OrbitCamera],
    lit: LitRenderer,
) -> Float[Tensor, "b h w 3"]:
    """Render every mesh under a light from its camera over a background image."""
    pictures = (lit.render(mesh, camera) for mesh, camera in zip(meshes, cameras, strict=True))
    return torch.stack([color * alpha + background * (1 - alpha) for color, alpha in pictures])


def studio_background(size: int) -> Float[Tensor, "h w 3"]:
    """Return a light background image with a radial gradient."""
    line = torch.linspace(-1, 1, size)
    distance = (line[:, None].square() + line.square()).div(2).clamp(max=1)[..., None]
    return torch.lerp(torch.tensor(CENTER), torch.tensor(CORNER), distance)


class Mp4Writer:
    """Context manager that encodes an MP4; its bytes do not depend on time, host or number of cores."""

    def __init__(self, path: Path, codec: str, fps: float, height: int, width: int) -> None:
        self._container = av.open(str(path), "w", options={"movflags": "+faststart", "fflags": "+bitexact"})
        rate = Fraction(fps).limit_denominator(1001 if fps >= 1 else MAX_DENOMINATOR)
        self._stream = cast(av.VideoStream, self._container.add_stream(codec, rate, dict(CODECS[codec])))
        context = self._stream.codec_context
        self._stream.height, self._stream.width = height, width
        self._stream.pix_fmt = "yuv420p"
        context.thread_count = 1
        context.flags |= av.codec.context.Flags.bitexact
        context.color_range = ColorRange.MPEG
        context.colorspace = context.color_primaries = context.color_trc = BT709

    def __enter__(self) -> "Mp4Writer":
        return self

    def __exit__(self, *failure: object) -> None:
        if failure[0] is None:
            self._container.mux(self._stream.encode(None))
        self._container.close()

    def add(self, pictures: Float[Tensor, "b h w 3"]) -> None:
        """Append images in [0, 1]."""
        for pixels in to_bytes(pictures).numpy():
            frame = av.VideoFrame.from_ndarray(pixels, "rgb24")
            frame = frame.reformat(format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG)
            self._container.mux(self._stream.encode(frame))
