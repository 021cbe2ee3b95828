import math
from dataclasses import replace

import pytest
import torch
import trimesh

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.mesh import render
from dg4d_lib.mesh.render import LitRenderer, render_mesh
from dg4d_lib.mesh.textured import TexturedMesh

SIZE = 32
CAMERA = OrbitCamera(width=SIZE, height=SIZE)
HALF = 2 * math.tan(math.radians(CAMERA.fov_y_deg) / 2)  # half the picture's height in the plane of the origin


@pytest.fixture
def board() -> TexturedMesh:
    """A square that faces the input camera and covers the middle half of its picture; the texture has four colors."""
    corners = torch.tensor([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
    uvs = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    quarters = torch.tensor([[[1.0, 0, 0], [0, 1, 0]], [[0, 0, 1], [1, 1, 0]]])
    texture = quarters.repeat_interleave(16, 0).repeat_interleave(16, 1)
    return TexturedMesh(0.5 * HALF * corners, torch.tensor([[0, 3, 2], [0, 2, 1]]), uvs, texture)


def test_an_edge_between_smoothing_groups_is_hard() -> None:
    box = trimesh.creation.box()
    corners = torch.tensor(box.triangles.reshape(-1, 3), dtype=torch.float32)
    faces = torch.arange(36).reshape(12, 3)
    flat = torch.tensor(box.face_normals, dtype=torch.float32)
    sides = (flat @ torch.tensor([1.0, 2.0, 3.0])).round().long().repeat_interleave(3)
    mesh = TexturedMesh(corners, faces, torch.zeros(36, 2), torch.ones(1, 1, 3))
    smooth = render.smooth_normals(mesh)
    assert (smooth * flat.repeat_interleave(3, 0)).sum(1).max() < 0.9
    hard = render.smooth_normals(replace(mesh, smoothing_groups=sides))
    torch.testing.assert_close(hard, flat.repeat_interleave(3, 0))


def test_the_top_left_of_the_texture_is_the_top_left_of_the_picture(board: TexturedMesh) -> None:
    color, alpha = render_mesh(board, [CAMERA])
    for (row, column), expected in {(9, 9): (1, 0, 0), (9, 22): (0, 1, 0), (22, 9): (0, 0, 1)}.items():
        torch.testing.assert_close(color[0, row, column], torch.tensor(expected, dtype=torch.float32))
    assert alpha[0, 8:24, 8:24].min() == 1
    assert alpha.sum() == 16 * 16


def test_partly_covered_pixels_keep_their_color(board: TexturedMesh) -> None:
    pixel = 2 * HALF / SIZE
    shifted = board.vertices.new_tensor([pixel / 3, 0, 0]).expand_as(board.vertices)
    color, alpha = render_mesh(board, [CAMERA], shifted)
    assert alpha[0, 10, 8, 0] == pytest.approx(2 / 3)
    torch.testing.assert_close(color[0, 10, 8], torch.tensor([1.0, 0, 0]))


def test_every_camera_can_have_a_state_of_its_own(board: TexturedMesh) -> None:
    away = torch.zeros(2, 4, 3)
    away[1] += 10
    _, alpha = render_mesh(board, [CAMERA, CAMERA], away)
    assert alpha[0].sum() > 0
    assert alpha[1].sum() == 0


def test_what_is_not_covered_is_zero_and_finite(board: TexturedMesh) -> None:
    color, alpha = render_mesh(board, [CAMERA])
    assert (color[alpha[..., 0] == 0] == 0).all()


def test_the_picture_is_differentiable_in_the_texture(board: TexturedMesh) -> None:
    texture = board.texture.clone().requires_grad_()
    color, _ = render_mesh(TexturedMesh(board.vertices, board.faces, board.uvs, texture), [CAMERA])
    color.sum().backward()
    assert texture.grad is not None
    assert texture.grad.sum() == pytest.approx(3 * 16 * 16, rel=1e-4)


def test_fine_textures_come_out_as_their_mean(board: TexturedMesh) -> None:
    """Eight texels a sample; single texels would be off by a third."""
    noise = torch.rand(256, 256, 3, generator=torch.Generator().manual_seed(0))
    color, _ = render_mesh(TexturedMesh(board.vertices, board.faces, board.uvs, noise), [CAMERA])
    mean = noise.reshape(16, 16, 16, 16, 3).mean((1, 3))
    assert (color[0, 8:24, 8:24] - mean).square().mean().sqrt() < 0.02


@pytest.mark.parametrize(("height", "width"), [(32, 32), (100, 64), (37, 50)])
def test_kernels_draw_what_operators_with_gradients_draw(height: int, width: int) -> None:
    """A ball with noise as texture, from near, where it is magnified, and as small as a few pixels."""
    ball = trimesh.creation.icosphere(3, 0.5)
    vertices = torch.from_numpy(ball.vertices).float()
    uvs = torch.stack([vertices[:, 0] + 0.5, 0.5 - vertices[:, 1]], 1)
    texture = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(0))
    mesh = TexturedMesh(vertices, torch.from_numpy(ball.faces).int(), uvs, texture)
    graded = replace(mesh, texture=texture.clone().requires_grad_())
    cameras = [replace(CAMERA, azimuth_deg=30, fov_y_deg=fov_y_deg) for fov_y_deg in (20, 150)]
    for supersampling in (1, 3):
        drawn = render_mesh(mesh, cameras, supersampling=supersampling)
        expected = render_mesh(graded, cameras, supersampling=supersampling)
        lit, lit_expected = (LitRenderer(supersampling).render(one, cameras[0]) for one in (mesh, graded))
        for one, other in zip((*drawn, *lit), (*expected, *lit_expected), strict=True):
            assert one.max() > 0.1
            torch.testing.assert_close(one, other.detach(), atol=2e-5, rtol=0)


def test_coordinates_that_are_no_numbers_read_the_first_texel(board: TexturedMesh) -> None:
    """And those far outside of the texture its border."""
    for value in (math.nan, -math.inf, -1e30):
        color, alpha = render_mesh(replace(board, uvs=torch.full_like(board.uvs, value)), [CAMERA])
        torch.testing.assert_close(color[alpha[..., 0] == 1].unique(dim=0), torch.tensor([[1.0, 0, 0]]))


def test_a_moving_mesh_is_prepared_once_and_drawn_as_afresh(
    board: TexturedMesh, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It bends, its seam opens, and its texture changes: only then are seams or mip levels found anew."""
    split = replace(
        board,
        vertices=board.vertices[[0, 3, 2, 0, 2, 1]],
        faces=torch.arange(6, dtype=torch.int32).reshape(2, 3),
        uvs=board.uvs[[0, 3, 2, 0, 2, 1]],
    )
    bend, opening = torch.zeros(2, 6, 3)
    bend[5], opening[3:] = torch.tensor([0.0, 0.0, 0.2]), torch.tensor([0.1, 0.0, 0.3])
    states = [replace(split, vertices=split.vertices + share * bend) for share in (0, 1, 2)]
    states += [replace(split, vertices=split.vertices + opening), replace(split, texture=1 - split.texture)]
    expected = [LitRenderer().render(state, CAMERA) for state in states]
    calls: list[str] = []
    for name in ("group_vertices", "mip_levels"):
        function = getattr(render, name)
        monkeypatch.setattr(render, name, lambda *given, of=function, by=name: calls.append(by) or of(*given))
    renderer = LitRenderer()
    for state, pictures in zip(states, expected, strict=True):
        for one, other in zip(renderer.render(state, CAMERA), pictures, strict=True):
            assert torch.equal(one, other)
    assert calls == ["group_vertices", "mip_levels", "group_vertices", "mip_levels"]


def test_light_leaves_no_dark_border() -> None:
    """A white ball under the light, over gray: no pixel of its lit side is darker than the gray."""
    ball = trimesh.creation.icosphere(4, 0.5)
    vertices = torch.from_numpy(ball.vertices).float()
    faces, uvs = torch.from_numpy(ball.faces).int(), torch.full((len(vertices), 2), 0.5)
    mesh = TexturedMesh(vertices, faces, uvs, torch.ones(4, 4, 3))
    color, alpha = LitRenderer().render(mesh, replace(CAMERA, elevation_deg=5))
    upper_left = (color * alpha + 0.6 * (1 - alpha))[: SIZE // 2, : SIZE // 2]
    assert alpha[: SIZE // 2, : SIZE // 2].max() == 1 and upper_left.min() > 0.59
