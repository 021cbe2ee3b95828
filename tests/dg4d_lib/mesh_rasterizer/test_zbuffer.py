import math

import pytest
import torch

from dg4d_lib.cameras.orbit import RADIUS, OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.mesh_rasterizer.zbuffer import NEAR, interpolate, rasterize_mesh

SQUARE_FACES = torch.tensor([[0, 1, 2], [0, 2, 3]])


def square(half: float, z: float = 0.0) -> torch.Tensor:
    return torch.tensor([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])


def soup(seed: int, count: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    centers = torch.rand(count, 1, 3, generator=generator) - 0.5
    corners = centers + 0.8 * (torch.rand(count, 3, 3, generator=generator) - 0.5)
    return corners.reshape(-1, 3), torch.arange(3 * count).reshape(-1, 3)


def shoot(vertices, faces, camera):
    """Every pixel's ray against every triangle (Moeller and Trumbore), nearest hit: face, weights, camera z."""
    pose = camera.world_to_camera()
    points = vertices.double() @ pose[:3, :3].T + pose[:3, 3]
    x = (torch.arange(camera.width) + 0.5 - camera.width / 2) / camera.focal
    y = (torch.arange(camera.height) + 0.5 - camera.height / 2) / camera.focal
    rays = torch.stack([*torch.meshgrid(x, y, indexing="xy"), torch.ones(camera.height, camera.width)], -1).double()
    a, b, c = points[faces].unbind(1)
    e1, e2 = b - a, c - a
    p = torch.linalg.cross(rays[:, :, None], e2[None, None])
    inverse = 1 / (p * e1).sum(-1)
    u = -(p * a).sum(-1) * inverse
    q = torch.linalg.cross(-a, e1)
    v = (rays[:, :, None] * q).sum(-1) * inverse
    z = (q * e2).sum(-1) * inverse
    hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (z > 0)
    depth, face = torch.where(hit, z, math.inf).min(-1)
    u, v = (w.gather(-1, face[..., None])[..., 0] for w in (u, v))
    return torch.where(depth.isfinite(), face, -1), torch.stack([1 - u - v, u, v], -1), depth


@pytest.mark.parametrize(
    "camera", [OrbitCamera(20, 130, width=48, height=32), OrbitCamera(-60, -75, 1.5, width=40, height=40)]
)
def test_pixels_see_what_their_rays_hit(camera):
    vertices, faces = soup(3)
    fragments = rasterize_mesh(vertices, faces, [camera])
    face, weights, depth = shoot(vertices, faces, camera)
    same = fragments.faces[0] == face
    assert same.float().mean() > 0.998  # a center on an edge may fall to either side
    seen = same & (face >= 0)
    assert 0.15 < seen.float().mean() < 0.95
    torch.testing.assert_close(fragments.barycentrics[0][seen].double(), weights[seen], atol=1e-5, rtol=0)
    torch.testing.assert_close(fragments.depth[0][seen].double(), depth[seen], atol=1e-5, rtol=0)


def test_a_square_that_faces_the_camera_covers_its_pixels():
    camera = OrbitCamera(width=64, height=64)
    half = 10.2 * RADIUS / camera.focal  # 10.2 pixels on the screen: centers at 0.5 ... 9.5 from the middle are inside
    fragments = rasterize_mesh(square(half), SQUARE_FACES, [camera])
    expected = torch.full((64, 64), -1) >= 0
    expected[22:42, 22:42] = True
    assert torch.equal(fragments.faces[0] >= 0, expected)
    torch.testing.assert_close(fragments.depth[0], expected * RADIUS, atol=1e-6, rtol=0)
    torch.testing.assert_close(fragments.barycentrics[0].sum(-1), expected.float())


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_nearer_triangle_wins(order):
    vertices = torch.cat([square(0.3, 0.0), square(0.2, 0.1)])
    parts = [SQUARE_FACES, SQUARE_FACES + 4]
    faces = torch.cat([parts[i] for i in order])
    fragments = rasterize_mesh(vertices, faces, [OrbitCamera(width=32, height=32)])
    middle = faces[fragments.faces[0, 16, 16]]
    assert (middle >= 4).all()
    assert fragments.depth[0, 16, 16] == pytest.approx(RADIUS - 0.1)


def test_of_equally_near_triangles_the_first_wins():
    faces = torch.cat([SQUARE_FACES, SQUARE_FACES.flip(1)])
    fragments = rasterize_mesh(square(0.4), faces, [OrbitCamera(width=32, height=32)])
    assert fragments.faces.max() == 1


def test_up_in_the_world_is_up_in_the_picture_and_right_is_right():
    vertices = torch.tensor([[0.0, 0.4, 0.0], [0.2, 0.4, 0.0], [0.2, 0.6, 0.0]])
    fragments = rasterize_mesh(vertices, torch.tensor([[0, 1, 2]]), [OrbitCamera(width=64, height=64)])
    rows, columns = torch.nonzero(fragments.faces[0] >= 0).T
    assert rows.max() < 24
    assert columns.min() >= 32


def test_each_camera_draws_its_own_state():
    states = torch.stack([square(0.3), square(0.3) + torch.tensor([0.2, 0.0, 0.0])])
    cameras = [OrbitCamera(width=32, height=32), OrbitCamera(0, 40, width=32, height=32)]
    both = rasterize_mesh(states, SQUARE_FACES, cameras)
    for i, camera in enumerate(cameras):
        alone = rasterize_mesh(states[i], SQUARE_FACES, [camera])
        assert torch.equal(both.faces[i], alone.faces[0])
        assert torch.equal(both.barycentrics[i], alone.barycentrics[0])


def test_what_crosses_the_near_plane_is_not_drawn():
    camera = OrbitCamera(width=32, height=32)
    near = square(0.05, RADIUS - NEAR + 0.01)
    assert (rasterize_mesh(near, SQUARE_FACES, [camera]).faces == -1).all()
    assert (rasterize_mesh(near - torch.tensor([0.0, 0.0, 0.02]), SQUARE_FACES, [camera]).faces >= 0).any()


@pytest.mark.parametrize("value", [0.0, 1e30, math.nan, math.inf])
def test_degenerate_triangles_draw_nothing(value):
    vertices = torch.full((3, 3), value)
    fragments = rasterize_mesh(vertices, torch.tensor([[0, 1, 2]]), [OrbitCamera(width=16, height=16)])
    assert (fragments.faces == -1).all()
    assert (fragments.barycentrics == 0).all() and (fragments.depth == 0).all()


def test_a_fan_has_no_cracks():
    angles = torch.linspace(0, 2 * math.pi, 38)[:-1]
    rim = torch.stack([angles.cos(), angles.sin(), 0 * angles], -1) * 0.6
    vertices = torch.cat([torch.tensor([[0.013, -0.007, 0.0]]), rim])
    index = torch.arange(37)
    faces = torch.stack([0 * index, 1 + index, 1 + (index + 1) % 37], -1)
    camera = OrbitCamera(width=101, height=101)
    covered = rasterize_mesh(vertices, faces, [camera]).faces[0] >= 0
    center = (torch.arange(101) - 50) * RADIUS / camera.focal
    inside = center[:, None] ** 2 + center[None] ** 2 < (0.6 * math.cos(math.pi / 37)) ** 2 - 1e-6
    assert covered[inside].all()


def test_interpolation_recovers_a_linear_function_of_space():
    vertices, faces = soup(5)
    camera = OrbitCamera(10, 30, width=48, height=48)
    fragments = rasterize_mesh(vertices, faces, [camera, camera])
    points = interpolate(fragments, faces, vertices)
    pose = camera.world_to_camera().float()
    depth = (points @ pose[2, :3] + pose[2, 3]) * (fragments.faces >= 0)
    torch.testing.assert_close(depth, fragments.depth, atol=1e-5, rtol=0)
    assert (points[fragments.faces < 0] == 0).all()
    batched = interpolate(fragments, faces, torch.stack([vertices, 2 * vertices]))
    torch.testing.assert_close(batched, torch.stack([points[0], 2 * points[1]]))


def test_interpolation_hands_gradients_to_the_attributes():
    colors = torch.rand(4, 3, dtype=torch.float64, requires_grad=True)
    fragments = rasterize_mesh(square(0.4), SQUARE_FACES, [OrbitCamera(width=16, height=16)])
    interpolate(fragments, SQUARE_FACES, colors).sum().backward()
    covered = (fragments.faces >= 0).sum()
    assert colors.grad.sum(0) == pytest.approx(covered.item(), abs=1e-4)


@pytest.mark.parametrize("cameras", [[], [OrbitCamera(width=8, height=8), OrbitCamera(width=9, height=8)]])
def test_cameras_of_different_sizes_are_refused(cameras):
    with pytest.raises(BadInput, match="one size"):
        rasterize_mesh(square(0.1), SQUARE_FACES, cameras)


def test_another_number_of_states_than_cameras_is_refused():
    with pytest.raises(BadInput, match="3 cameras"):
        rasterize_mesh(torch.stack([square(0.1)] * 2), SQUARE_FACES, [OrbitCamera(width=8, height=8)] * 3)
