"""Hull of known views on the rays of the input camera."""

import torch
from creatures import PARTS, creature, known_surface, ring, seen

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.shape_prior.expected import expected_volume
from dg4d_lib.shape_prior.field import ShapeField
from dg4d_lib.shape_prior.frustum import SIZE
from dg4d_lib.shape_prior.raymarch import render_volumes
from dg4d_lib.visual_hull.frustum_field import cell_centers, known_field
from dg4d_lib.visual_hull.shape import known_volume


def hull_field() -> ShapeField:
    views = ring(4)
    return known_field(views, known_volume(views), known_surface(views))


def test_matter_lies_inside_the_subject():
    field = hull_field()
    points = cell_centers()
    inside = torch.stack(
        [((points - torch.tensor(center)) / torch.tensor(radii)).norm(dim=-1) < 1 for center, radii, _ in PARTS]
    ).any(0)
    found = field.logits > 0
    assert (found & inside).sum() / inside.sum() > 0.93
    assert (found & inside).sum() / found.sum() > 0.8  # four outlines leave corners


def test_rays_of_the_input_camera_meet_their_pixels():
    points, camera = cell_centers(), OrbitCamera(width=SIZE, height=SIZE)
    matrix = camera.viewmat().float()
    at = points[40, 90] @ matrix[:3, :3].T + matrix[:3, 3]
    pixels = at[:, :2] / at[:, 2:] * camera.focal + SIZE / 2
    torch.testing.assert_close(pixels, torch.tensor([90.5, 40.5]).expand_as(pixels), atol=1e-3, rtol=0)


def test_views_from_behind_show_the_known_colors():
    camera = OrbitCamera(0, 180, width=64, height=64)
    color, alpha = render_volumes([expected_volume(hull_field(), 1.2)], [camera])
    truth = seen(creature(), 180, size=64).cutout
    sure = (truth[..., 3] > 0.99) & (alpha[0, ..., 0] > 0.9)
    assert sure.sum() > 0.6 * (truth[..., 3] > 0.99).sum()
    straight = color[0][sure] / alpha[0][sure]
    assert (straight - truth[..., :3][sure]).abs().mean() < 0.11
