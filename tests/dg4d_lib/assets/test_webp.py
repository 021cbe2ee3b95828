"""Animated WebP: real-time loop, file size, input view."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence
from torch import Tensor

from dg4d_lib.asset_settings import PackSettings
from dg4d_lib.assets.rendering import webp
from dg4d_lib.assets.rendering.preview import studio_background
from dg4d_lib.assets.rendering.webp import write_webp
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.deformation.framewise import Framewise
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.rasterizer.interface import Rendering
from dg4d_lib.rasterizer.reference import rasterize
from steps.sources.decode_limit import DecodeLimit
from steps.sources.webp import AnimatedWebp

SETTINGS = PackSettings(preview_size=64)


def frames(path: Path) -> tuple[np.ndarray, list[int]]:
    with Image.open(path) as picture:
        shown = [
            (np.asarray(frame.convert("RGB")) / 255, frame.info["duration"])
            for frame in ImageSequence.Iterator(picture)
        ]
    return np.stack([pixels for pixels, _ in shown]), [duration for _, duration in shown]


@pytest.fixture
def written(tmp_path: Path, red_dot: Gaussians, slide: Framewise) -> Path:
    write_webp(tmp_path / "a.webp", red_dot, slide, 2, 1.0, rasterize, SETTINGS, red_dot.means[None])
    return tmp_path / "a.webp"


def test_it_loops_for_ever_and_in_real_time(written: Path) -> None:
    """The motion lasts two seconds; the camera's four are two loops."""
    _, durations = frames(written)
    assert sum(durations) == 4000
    assert set(durations) <= {83, 84}
    with Image.open(written) as picture:
        assert (picture.format, picture.size, picture.info["loop"]) == ("WEBP", (64, 64), 0)


def test_another_reader_sees_the_same(written: Path) -> None:
    pictures, _ = frames(written)
    with written.open("rb") as file:
        other = AnimatedWebp(file, DecodeLimit(1.0))
        for theirs, ours in zip(other, pictures, strict=True):
            np.testing.assert_allclose(theirs[..., :3] / 255, ours, atol=2 / 255)
        assert other.fps == pytest.approx(12, rel=1e-3)  # times are whole milliseconds


def test_the_object_is_drawn_where_it_is(written: Path) -> None:
    """It slides to the right for a second and back for another, while the camera sways to both sides."""
    pictures, _ = frames(written)
    redness = (pictures[..., 0] - pictures[..., 1] - 0.2).clip(0)  # of the ball, not of what encoding adds
    columns = (redness.sum(1) * np.arange(64)).sum(-1) / redness.sum((1, 2)) - 31.5
    for i in range(48):
        x = 0.5 * (1 - abs(i / 12 % 2 - 1))
        camera = OrbitCamera(0, webp.SWAY_DEG * math.sin(math.tau * i / 48), width=64, height=64)
        view = camera.viewmat() @ torch.tensor([x, 0, 0, 1], dtype=torch.float64)
        assert columns[i] == pytest.approx(camera.focal * float(view[0] / view[2]), abs=1)


def test_colors_survive_the_encoding(written: Path) -> None:
    first = frames(written)[0][0]
    np.testing.assert_allclose(first[:4, :4], studio_background(64)[:4, :4].numpy(), atol=5 / 255)
    assert first[32, 32, 0] > 0.8
    assert first[32, 32, 1:].max() < 0.25


@pytest.mark.parametrize(
    ("count", "fps", "seconds", "most"), [(512, 30.0, 512 / 30, 96), (1, 30.0, 4.0, 48), (1000, 7.0, 1000 / 7, 96)]
)
def test_any_length_is_shown_in_real_time_with_few_pictures(
    tmp_path: Path, red_dot: Gaussians, slide: Framewise, count: int, fps: float, seconds: float, most: int
) -> None:
    beside = replace(red_dot, means=torch.tensor([[0.2, 0.0, 0.0]]))  # the camera's sway shows
    write_webp(tmp_path / "a.webp", beside, slide, count, fps, rasterize, SETTINGS, beside.means[None])
    pictures, durations = frames(tmp_path / "a.webp")
    assert len(pictures) <= most  # equal neighbors become one
    assert sum(durations) == pytest.approx(1000 * seconds, abs=1)


def test_it_is_no_larger_than_256_pixels(tmp_path: Path, red_dot: Gaussians, slide: Framewise) -> None:
    def blank(
        gaussians: Gaussians, cameras: Sequence[OrbitCamera], background: Tensor, means2d_offsets=None
    ) -> Rendering:
        return rendering_of(torch.zeros(len(cameras), cameras[0].height, cameras[0].width, 3))

    write_webp(tmp_path / "a.webp", red_dot, slide, 2, 1.0, blank, PackSettings(preview_size=384), red_dot.means[None])
    with Image.open(tmp_path / "a.webp") as picture:
        assert picture.size == (256, 256)


def test_what_would_be_too_large_is_packed_harder(
    tmp_path: Path, red_dot: Gaussians, slide: Framewise, monkeypatch: pytest.MonkeyPatch
) -> None:
    def noise(
        gaussians: Gaussians, cameras: Sequence[OrbitCamera], background: Tensor, means2d_offsets=None
    ) -> Rendering:
        return rendering_of(torch.rand(len(cameras), 64, 64, 3, generator=torch.Generator().manual_seed(0)))

    def size(limit: int) -> int:
        monkeypatch.setattr(webp, "MAX_BYTES", limit)
        write_webp(tmp_path / "a.webp", red_dot, slide, 2, 1.0, noise, SETTINGS, red_dot.means[None])
        return (tmp_path / "a.webp").stat().st_size

    best = size(10**9)
    smaller = size(best - 1)
    assert size(1) < smaller < best


def test_equal_assets_give_equal_pictures(written: Path, tmp_path: Path, red_dot: Gaussians, slide: Framewise) -> None:
    write_webp(tmp_path / "again.webp", red_dot, slide, 2, 1.0, rasterize, SETTINGS, red_dot.means[None])
    assert (tmp_path / "again.webp").read_bytes() == written.read_bytes()


def rendering_of(color: Tensor) -> Rendering:
    alpha = torch.ones_like(color[..., :1])
    return Rendering(color, alpha, alpha, torch.ones(len(color), 1, dtype=torch.bool))
