import math

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_fill_holes
from scipy.spatial import ConvexHull

from dg4d_lib.cameras.orbit import RADIUS, OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.mesh_rasterizer.scanlines import NEAR
from dg4d_lib.mesh_rasterizer.zbuffer import interpolate, rasterize_mesh

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
    pose = camera.viewmat()
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
    assert torch.equal(fragments.faces[0].long(), face)
    seen = face >= 0
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


@pytest.mark.parametrize("size", [48, 49])  # the middle lines of the grid run between centers, or through them
def test_the_triangles_of_a_square_share_its_pixels_without_remainder(size):
    camera, count = OrbitCamera(width=size, height=size), 8
    ticks = torch.linspace(-1, 1, count + 1) * 16.2 * RADIUS / camera.focal  # 16.2 pixels to each side
    vertices = torch.stack([*torch.meshgrid(ticks, ticks, indexing="xy"), torch.zeros(count + 1, count + 1)], -1)
    index = torch.arange((count + 1) ** 2).reshape(count + 1, count + 1)
    a, b, c, d = (corner.flatten() for corner in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    faces = torch.cat([torch.stack([a, b, c], -1), torch.stack([b, d, c], -1)])
    covered = [rasterize_mesh(vertices.reshape(-1, 3), face[None], [camera]).faces >= 0 for face in faces]
    times = torch.cat(covered).sum(0)
    assert times.max() == 1
    assert times.sum() == (32 if size == 48 else 33) ** 2


@pytest.mark.parametrize("seed", range(3))
def test_every_pixel_of_a_closed_surface_has_one_triangle_on_each_side(seed):
    vertices = torch.randn(60, 3, generator=torch.Generator().manual_seed(seed)).double()
    vertices = (0.7 * vertices / vertices.norm(dim=-1, keepdim=True)).mul(64).round().div(64)  # centers on edges
    faces = torch.from_numpy(ConvexHull(vertices.numpy()).simplices).long()
    cameras = [OrbitCamera(e, a, width=49, height=49) for e in (-90, -45, 0, 30, 90) for a in (0, 30, 45, 90, 171)]
    whole = rasterize_mesh(vertices, faces, cameras)
    for view, camera in enumerate(cameras):
        corners = vertices[faces]
        normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        outwards = normals * (normals * corners.mean(1)).sum(-1, keepdim=True).sign()
        facing = ((camera.position() - corners[:, 0]) * outwards).sum(-1) > 0
        for side in (faces[facing], faces[~facing]):
            once, again = (rasterize_mesh(vertices, order, [camera]).faces[0] for order in (side, side.flip(0)))
            assert torch.equal(once >= 0, whole.faces[view] >= 0)
            assert torch.equal(once, torch.where(again >= 0, len(side) - 1 - again, -1))  # no choice of two
        covered = whole.faces[view].numpy() >= 0
        assert covered.sum() > 500
        assert np.array_equal(covered, binary_fill_holes(covered))


def test_attributes_on_a_slanted_plane_are_where_the_rays_meet_it():
    camera = OrbitCamera(width=40, height=40)
    corners = torch.tensor([[-1.0, -0.8], [1.0, -0.8], [1.0, 0.8], [-1.0, 0.8]], dtype=torch.float64)
    vertices = torch.cat([corners, 0.9 * corners[:, :1] - 0.7 * corners[:, 1:]], 1)  # z = 0.9 x - 0.7 y
    fragments = rasterize_mesh(vertices, SQUARE_FACES, [camera])
    y, x = torch.meshgrid(*[(torch.arange(40) + 0.5 - 20).double() / camera.focal] * 2, indexing="ij")
    depth = RADIUS / (1 + 0.9 * x + 0.7 * y)  # of the point (x, -y) depth on the plane, RADIUS - z
    expected = torch.stack([x, -y], -1) * depth[..., None]
    seen = fragments.faces[0] >= 0
    assert 300 < seen.sum() < 1600
    places = interpolate(fragments, SQUARE_FACES, corners)[0]
    torch.testing.assert_close(places[seen], expected[seen], atol=1e-6, rtol=0)
    torch.testing.assert_close(fragments.depth[0][seen].double(), depth[seen], atol=1e-6, rtol=0)


def test_in_the_thinnest_triangles_weights_are_weights():
    generator = torch.Generator().manual_seed(2)
    ends = torch.rand(400, 2, 3, generator=generator).double() - 0.5
    share = torch.rand(400, 1, generator=generator).double()
    thin = 10.0 ** (-16 * torch.rand(400, 1, generator=generator).double())
    third = (share * ends[:, 0] + (1 - share) * ends[:, 1]) + thin * torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    vertices = torch.cat([ends, third[:, None]], 1).reshape(-1, 3)
    fragments = rasterize_mesh(
        vertices, torch.arange(1200).reshape(-1, 3), [OrbitCamera(20, 50, width=256, height=256)]
    )
    seen = fragments.faces >= 0
    assert seen.sum() > 100
    weights = fragments.barycentrics[seen]
    assert (weights >= 0).all() and (weights <= 1).all()
    torch.testing.assert_close(weights.sum(-1), torch.ones(len(weights)))
    assert (fragments.depth[seen] > RADIUS - 1).all() and (fragments.depth[seen] < RADIUS + 1).all()


def test_interpolation_recovers_a_linear_function_of_space():
    vertices, faces = soup(5)
    camera = OrbitCamera(10, 30, width=48, height=48)
    fragments = rasterize_mesh(vertices, faces, [camera, camera])
    points = interpolate(fragments, faces, vertices)
    pose = camera.viewmat().float()
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
    with pytest.raises(BadInput, match="same size"):
        rasterize_mesh(square(0.1), SQUARE_FACES, cameras)


def test_another_number_of_states_than_cameras_is_refused():
    with pytest.raises(BadInput, match="3 cameras"):
        rasterize_mesh(torch.stack([square(0.1)] * 2), SQUARE_FACES, [OrbitCamera(width=8, height=8)] * 3)
