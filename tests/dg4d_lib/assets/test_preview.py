"""Preview videos: playback, position of the object, determinism."""

import struct
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
import torch
import trimesh

from dg4d_lib.asset_settings import PackSettings
from dg4d_lib.assets.rendering import preview
from dg4d_lib.assets.rendering.preview import studio_background, write_mp4, write_preview, write_turntable
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.deformation.framewise import Framewise
from dg4d_lib.errors import BackendUnavailable
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh import render
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh_rasterizer.texture_cpu import mip_levels
from dg4d_lib.rasterizer.reference import rasterize

SETTINGS = PackSettings(preview_size=64, preview_turns=2)
FRAMES, FPS = 3, 7.0  # sampled three times per frame: 21 fps


def film(path: Path) -> tuple[np.ndarray, Fraction]:
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
        assert stream.average_rate is not None
        return np.stack(pictures) / 255, stream.average_rate


@pytest.fixture
def written(tmp_path: Path, red_dot: Gaussians, slide: Framewise) -> Path:
    path = tmp_path / "preview.mp4"
    assert write_preview(path, red_dot, slide, FRAMES, FPS, rasterize, SETTINGS, red_dot.means[None]) == ()
    return path


def test_the_film_has_every_position_of_every_loop_at_a_smooth_rate(written: Path) -> None:
    pictures, rate = film(written)
    assert pictures.shape == (FRAMES * 3 * 2, 64, 64, 3)
    assert rate == 21


def boxes(content: bytes) -> list[str]:
    """The names of the boxes of an MP4, in their order."""
    names, start = [], 0
    while start < len(content):
        size, name = struct.unpack_from(">I4s", content, start)
        names.append(name.decode())
        start += size
    return names


def test_browsers_can_play_it_and_begin_before_all_is_loaded(written: Path) -> None:
    """They want H.264 in 4:2:0, and the index before the pictures."""
    with av.open(str(written)) as container:
        assert [stream.type for stream in container.streams] == ["video"]
        context = container.streams.video[0].codec_context
        assert (context.name, context.pix_fmt) == ("h264", "yuv420p")
    names = boxes(written.read_bytes())
    assert names[0] == "ftyp"
    assert names.index("moov") < names.index("mdat")


def test_a_slow_motion_is_not_sampled_without_end(
    tmp_path: Path, red_dot: Gaussians, slide: Framewise, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(preview, "MAX_PICTURES", 25)
    write_preview(tmp_path / "a.mp4", red_dot, slide, FRAMES, 0.5, rasterize, SETTINGS, red_dot.means[None])
    pictures, rate = film(tmp_path / "a.mp4")
    assert (len(pictures), rate) == (24, 2)


def test_colors_survive_the_encoding(written: Path) -> None:
    first = film(written)[0][0]
    np.testing.assert_allclose(first[:4, :4], studio_background(64)[:4, :4].numpy(), atol=4 / 255)
    assert first[32, 32, 0] > 0.85
    assert first[32, 32, 1:].max() < 0.25


def test_the_object_is_drawn_where_it_is(written: Path) -> None:
    """It stands at the center in the first picture, and to the right of it in the last frame of the first loop."""
    redness = (film(written)[0][..., 0] - film(written)[0][..., 1]).clip(0)
    columns = (redness.sum(1) * np.arange(64)).sum(-1) / redness.sum((1, 2))
    camera = OrbitCamera(preview.ELEVATION_DEG, 360 * 6 / 18, width=64, height=64)
    view = camera.viewmat() @ torch.tensor([0.5, 0, 0, 1], dtype=torch.float64)
    expected = 32 + camera.focal * float(view[0] / view[2]) - 0.5
    assert columns[0] == pytest.approx(31.5, abs=0.5)
    assert columns[6] == pytest.approx(expected, abs=1)
    assert abs(expected - 31.5) > 3


def test_the_mesh_is_beside_the_splats(tmp_path: Path, red_dot: Gaussians, slide: Framewise) -> None:
    """A green ball that moves as the red one does."""
    asked: list[float] = []

    def mesh_at(position: float) -> TexturedMesh:
        asked.append(position)
        ball = trimesh.creation.icosphere(2, 0.2)
        vertices = torch.from_numpy(ball.vertices).float() + torch.tensor([0.25 * min(position, 2), 0, 0])
        faces, uvs = torch.from_numpy(ball.faces).int(), torch.full((len(vertices), 2), 0.5)
        return TexturedMesh(vertices, faces, uvs, torch.tensor((0.0, 1.0, 0.0)).expand(4, 4, 3).clone())

    path = tmp_path / "both.mp4"
    write_preview(path, red_dot, slide, FRAMES, FPS, rasterize, SETTINGS, red_dot.means[None], mesh_at=mesh_at)
    pictures, _ = film(path)
    assert pictures.shape == (FRAMES * 3 * 2, 64, 128, 3)
    assert asked[:4] == pytest.approx([0, 1 / 3, 2 / 3, 1])
    places = []
    for half, channel in ((pictures[:, :, :64], 0), (pictures[:, :, 64:], 1)):
        color = (half[..., channel] - half[..., 2] - 0.2).clip(0)
        places.append((color.sum(1) * np.arange(64)).sum(-1) / color.sum((1, 2)))
    np.testing.assert_allclose(places[0][:7], places[1][:7], atol=1)


def test_the_texture_of_a_moving_mesh_is_prepared_once_per_film(
    tmp_path: Path, red_dot: Gaussians, slide: Framewise, monkeypatch: pytest.MonkeyPatch
) -> None:
    ball = trimesh.creation.icosphere(1, 0.2)
    vertices, faces = torch.from_numpy(ball.vertices).float(), torch.from_numpy(ball.faces).int()
    mesh = TexturedMesh(vertices, faces, torch.full((len(vertices), 2), 0.5), torch.ones(4, 4, 3))
    prepared = []
    monkeypatch.setattr(render, "mip_levels", lambda texture: prepared.append(texture) or mip_levels(texture))
    for name in "ab":
        write_preview(
            tmp_path / f"{name}.mp4",
            red_dot,
            slide,
            FRAMES,
            FPS,
            rasterize,
            SETTINGS,
            red_dot.means[None],
            mesh_at=lambda at: replace(mesh, vertices=mesh.vertices + 0.1 * at),
        )
    assert len(prepared) == 2  # once per film


def test_what_comes_near_the_camera_stays_in_the_picture(tmp_path: Path, red_dot: Gaussians) -> None:
    high = replace(red_dot, means=torch.tensor([[0.0, 0.8, -1.0]]))  # 35 degrees up from behind, where 25 are shown
    write_turntable(tmp_path / "turntable.mp4", high, rasterize, SETTINGS)
    pictures, _ = film(tmp_path / "turntable.mp4")
    redness = (pictures[..., 0] - pictures[..., 1]).clip(0)
    rows = (redness[50].sum(1) * np.arange(64)).sum() / redness[50].sum()
    assert redness[50].max() > 0.5 and 1 < rows < 8


def test_equal_assets_give_equal_films(written: Path, tmp_path: Path, red_dot: Gaussians, slide: Framewise) -> None:
    write_preview(tmp_path / "again.mp4", red_dot, slide, FRAMES, FPS, rasterize, SETTINGS, red_dot.means[None])
    assert (tmp_path / "again.mp4").read_bytes() == written.read_bytes()


def test_the_turntable_turns_once_and_nothing_else_moves(tmp_path: Path, red_dot: Gaussians) -> None:
    """A ball beside the axis goes round: right, behind, left, front."""
    beside = replace(red_dot, means=torch.tensor([[0.5, 0.0, 0.0]]))
    assert write_turntable(tmp_path / "turntable.mp4", beside, rasterize, SETTINGS) == ()
    pictures, rate = film(tmp_path / "turntable.mp4")
    assert len(pictures) / rate == preview.TURN_S
    redness = (pictures[..., 0] - pictures[..., 1] - 0.2).clip(0)  # of the ball, not of what encoding adds
    columns = (redness.sum(1) * np.arange(64)).sum(-1) / redness.sum((1, 2)) - 31.5
    focal = OrbitCamera(width=64, height=64).focal
    turn = np.arange(len(pictures)) / len(pictures) * 2 * np.pi
    tilt = np.cos(np.radians(preview.ELEVATION_DEG))
    expected = focal * 0.5 * np.cos(turn) / (2 - tilt * 0.5 * np.sin(turn))
    np.testing.assert_allclose(columns, expected, atol=1)


def test_equal_states_give_equal_turntables(tmp_path: Path, red_dot: Gaussians) -> None:
    for name in "ab":
        write_turntable(tmp_path / f"{name}.mp4", red_dot, rasterize, SETTINGS)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()


def test_without_x264_another_codec_stands_in_and_the_report_says_so(
    tmp_path: Path,
    red_dot: Gaussians,
    slide: Framewise,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(av, "codecs_available", av.codecs_available - {"libx264"})
    (note,) = write_preview(tmp_path / "a.mp4", red_dot, slide, 2, 30.0, rasterize, SETTINGS, red_dot.means[None])
    assert "mpeg4" in note
    assert len(film(tmp_path / "a.mp4")[0]) == 4


def test_without_any_codec_the_backend_is_missing(
    tmp_path: Path,
    red_dot: Gaussians,
    slide: Framewise,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(av, "codecs_available", set())
    with pytest.raises(BackendUnavailable, match="pip install"):
        write_preview(tmp_path / "a.mp4", red_dot, slide, 2, 30.0, rasterize, SETTINGS, red_dot.means[None])


def test_a_failure_while_drawing_is_not_hidden(tmp_path: Path, red_dot: Gaussians, slide: Framewise) -> None:
    def broken(gaussians: Gaussians, cameras: Sequence[OrbitCamera], background, means2d_offsets=None):
        raise ArithmeticError("no picture")

    with pytest.raises(ArithmeticError, match="no picture"):
        write_preview(tmp_path / "a.mp4", red_dot, slide, 2, 30.0, broken, SETTINGS, red_dot.means[None])


@pytest.mark.parametrize("codec", preview.CODECS)
@pytest.mark.parametrize("fps", [24000 / 1001, 7.0, 0.0101, 0.0004])
def test_pictures_become_a_film_of_their_rate_and_colors(
    tmp_path: Path, fps: float, codec: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(preview, "_codec", lambda: codec)
    shades = torch.linspace(0.1, 0.9, 4)[:, None, None, None].expand(4, 32, 32, 3)
    write_mp4(tmp_path / "film.mp4", shades, fps)
    pictures, rate = film(tmp_path / "film.mp4")
    assert float(rate) == pytest.approx(fps, rel=1e-6)
    np.testing.assert_allclose(pictures, shades.numpy(), atol=4 / 255)
