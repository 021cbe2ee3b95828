"""Contact sheets: layout, driving video in the first row, readable captions."""

from dataclasses import replace

import pytest
import torch
import trimesh

from dg4d_lib.asset_settings import PackSettings
from dg4d_lib.assets.rendering.sheet import PANEL, draw_contact_sheet, draw_video_sheet
from dg4d_lib.deformation.framewise import Framewise
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.rasterizer.reference import rasterize
from dg4d_lib.video.driving import DrivingVideo

SIZE = 48
GAP = 2
SETTINGS = PackSettings(sheet_size=SIZE, sheet_frames=3, sheet_azimuths_deg=(0.0, 180.0))


def footage(frames: int) -> DrivingVideo:
    """A green square."""
    alpha = torch.zeros(frames, 64, 64, 1)
    alpha[:, 16:48, 16:48] = 1
    return DrivingVideo(torch.tensor((0.0, 1.0, 0.0)).expand(frames, 64, 64, 3), alpha, 10.0)


@pytest.fixture
def sheet(red_dot: Gaussians, slide: Framewise) -> torch.Tensor:
    return draw_contact_sheet(red_dot, slide, footage(5), rasterize, SETTINGS, red_dot.means[None])


def tile(sheet: torch.Tensor, row: int, column: int, rows: int = 3, columns: int = 3) -> torch.Tensor:
    """Tiles end one gap before the lower right corner."""
    bottom = sheet.shape[0] - GAP - (rows - 1 - row) * (SIZE + GAP)
    right = sheet.shape[1] - GAP - (columns - 1 - column) * (SIZE + GAP)
    return sheet[bottom - SIZE : bottom, right - SIZE : right]


def test_the_first_row_is_the_footage(sheet: torch.Tensor) -> None:
    for column in range(3):
        picture = tile(sheet, 0, column)
        torch.testing.assert_close(picture[24, 24], torch.tensor([0.0, 1.0, 0.0]))
        torch.testing.assert_close(picture[0, 0], torch.tensor(PANEL), atol=1 / 255, rtol=0)


def test_columns_are_the_first_the_middle_and_the_last_frame(sheet: torch.Tensor) -> None:
    """The dot slides along +x: to the right seen from the front, to the left seen from behind."""
    columns = torch.arange(SIZE) - (SIZE - 1) / 2
    for row, sign in ((1, 1), (2, -1)):
        places = []
        for column in range(3):
            redness = (tile(sheet, row, column)[..., 0] - tile(sheet, row, column)[..., 1]).clamp_min(0).sum(0)
            places.append(float((redness * columns).sum() / redness.sum()))
        focal = SIZE / 2 / 0.4568  # tan(49.1 / 2 degrees)
        assert places == pytest.approx([0, sign * focal * 0.25 / 2, sign * focal * 0.5 / 2], abs=0.6)


def test_margins_hold_captions_and_gaps_are_white(sheet: torch.Tensor) -> None:
    left = sheet.shape[1] - 3 * (SIZE + GAP)
    top = sheet.shape[0] - 3 * (SIZE + GAP)
    assert sheet[:top, left:].min() < 0.6
    for row in range(3):
        first = top + row * (SIZE + GAP)
        assert sheet[first : first + SIZE, : left - GAP].min() < 0.6
    assert sheet[top:, left + SIZE : left + SIZE + GAP].min() == 1
    assert sheet[-GAP:].min() == 1


def test_long_captions_are_not_cut_off(red_dot: Gaussians, slide: Framewise) -> None:
    short = draw_contact_sheet(
        red_dot, slide, footage(2), rasterize, PackSettings(sheet_size=32, sheet_azimuths_deg=(0,)), red_dot.means[None]
    )
    long = draw_contact_sheet(
        red_dot,
        slide,
        footage(2),
        rasterize,
        PackSettings(sheet_size=32, sheet_azimuths_deg=(-123.456,)),
        red_dot.means[None],
    )
    assert long.shape[1] > short.shape[1]
    for page in (short, long):
        assert page[:, 0].min() == 1
        assert page[0].min() == 1


def test_a_short_video_has_a_column_per_frame(red_dot: Gaussians, slide: Framewise) -> None:
    two = draw_contact_sheet(red_dot, slide, footage(2), rasterize, SETTINGS, red_dot.means[None])
    three = draw_contact_sheet(red_dot, slide, footage(3), rasterize, SETTINGS, red_dot.means[None])
    assert three.shape[1] - two.shape[1] == SIZE + GAP


def test_equal_assets_give_equal_sheets(sheet: torch.Tensor, red_dot: Gaussians, slide: Framewise) -> None:
    assert torch.equal(draw_contact_sheet(red_dot, slide, footage(5), rasterize, SETTINGS, red_dot.means[None]), sheet)


def test_rows_of_the_lit_mesh_come_last(red_dot: Gaussians, slide: Framewise) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.3)
    vertices, faces = torch.tensor(ball.vertices, dtype=torch.float32), torch.tensor(ball.faces)
    mesh = TexturedMesh(vertices, faces, torch.full((len(vertices), 2), 0.5), torch.full((4, 4, 3), 0.5))
    wanted = SETTINGS.model_copy(update={"sheet_mesh_azimuths_deg": (90.0,)})
    sheet = draw_contact_sheet(red_dot, slide, footage(5), rasterize, wanted, red_dot.means[None], lambda frame: mesh)
    shown = tile(sheet, 3, 1, rows=4)[..., 0]
    torch.testing.assert_close(shown[0, 0], torch.tensor(PANEL[0]), atol=1 / 255, rtol=0)
    assert shown[19, 20] > 0.54  # the light comes from the upper left
    assert 0.24 < shown[28, 28] < 0.45


def test_several_videos_are_rows_in_the_given_order() -> None:
    second = footage(5)
    blue = DrivingVideo(torch.tensor((0.0, 0.0, 1.0)).expand(5, 64, 64, 3), second.alpha, 10.0)
    page = draw_video_sheet([footage(5), blue], ["1 sway: 0.90", "2 bend: 0.50"], SIZE, 3)
    for column in range(3):
        torch.testing.assert_close(tile(page, 0, column, rows=2)[24, 24], torch.tensor([0.0, 1.0, 0.0]))
        torch.testing.assert_close(tile(page, 1, column, rows=2)[24, 24], torch.tensor([0.0, 0.0, 1.0]))


def test_what_comes_near_from_behind_is_whole_and_all_tiles_have_one_scale(
    red_dot: Gaussians, slide: Framewise
) -> None:
    high = replace(red_dot, means=torch.tensor([[0.0, 0.5, -1.0]]))  # 27 degrees up from behind, where 25 are shown
    sheet = draw_contact_sheet(high, slide, footage(5), rasterize, SETTINGS, high.means[None])
    redness = (tile(sheet, 2, 0)[..., 0] - tile(sheet, 2, 0)[..., 1]).clip(0)
    assert redness.max() > 0.5
    greenness = (tile(sheet, 0, 0)[..., 1] - tile(sheet, 0, 0)[..., 0]) > 0.5
    assert int(greenness.any(0).sum()) < SIZE // 2  # the footage's square, half of the width of its frame
