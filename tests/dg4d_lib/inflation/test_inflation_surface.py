import math

import pytest
import torch

from dg4d_lib.cameras.orbit import FOV_Y_DEG, RADIUS, OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.inflation.heights import SWELL
from dg4d_lib.inflation.hints import DepthHint
from dg4d_lib.inflation.render import render_surface
from dg4d_lib.inflation.surface import inflate, resample, sample_surface

SIZE = 64
PIXEL = 2 * RADIUS * math.tan(math.radians(FOV_Y_DEG) / 2) / SIZE
Y, X = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")


def distance(x: float = SIZE / 2, y: float = SIZE / 2) -> torch.Tensor:
    return ((X - x) ** 2 + (Y - y) ** 2).sqrt()


def cutout(mask: torch.Tensor, alpha: float = 1.0) -> torch.Tensor:
    colors = torch.stack([X / SIZE, Y / SIZE, 1 - X / SIZE], -1)
    return torch.cat([colors, alpha * mask.float()[..., None]], -1)


def soft_disc(radius: float) -> torch.Tensor:
    return (radius + 0.5 - distance()).clamp(0, 1)


def noise(share: float) -> torch.Tensor:
    return torch.rand(SIZE, SIZE, generator=torch.Generator().manual_seed(0)) < share


SHAPES = {
    "disc": distance() < 20,
    "donut": (distance() < 25) & (distance() > 11),
    "three parts": (distance(15, 20) < 8) | (distance(45, 20) < 10) | (distance(32, 50) < 5),
    "thin cross": ((X - 32.5).abs() < 1) | ((Y - 32.5).abs() < 1),
    "hair": (distance() < 15) | (noise(0.25) & (distance() < 23)),
    "noise": noise(0.5),
    "half of the picture": X > 32,
    "cropped bust": (distance(32, 20) < 10) | ((Y > 40) & ((X - 32).abs() < 20)),
    "one pixel": (X == 30.5) & (Y == 30.5),
    "checkerboard": (X + Y) % 2 == 0,
    "opaque": X > 0,
}


@pytest.mark.parametrize("name", SHAPES)
def test_every_silhouette_gives_a_closed_finite_surface(name):
    surface = inflate(cutout(SHAPES[name]), SIZE)
    assert surface.vertices.isfinite().all()
    assert ((surface.colors >= 0) & (surface.colors <= 1)).all()
    faces = surface.faces
    sides = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert torch.unique(sides, dim=0).shape == sides.shape  # every side is run through once ...
    forth = {tuple(side) for side in sides.tolist()}
    assert all((b, a) in forth for a, b in forth)  # ... and once in the other direction
    assert volume(surface) > 0


def volume(surface) -> float:
    a, b, c = surface.vertices.double()[surface.faces].unbind(1)
    return (torch.linalg.cross(a, b) * c).sum().item() / 6


def test_faces_look_outwards():
    surface = inflate(cutout(SHAPES["disc"]), SIZE)
    a, b, c = surface.vertices[surface.faces].unbind(1)
    normals = torch.linalg.cross(b - a, c - a)
    outward = (normals * (a + b + c)).sum(-1)
    assert (outward > -1e-9).float().mean() > 0.99


def test_a_disc_becomes_nearly_a_ball():
    radius = 20.0
    surface = inflate(cutout(soft_disc(radius)), SIZE)
    ball = radius * PIXEL
    assert surface.vertices[:, 2].max() == pytest.approx(ball, rel=0.08)
    assert 0.7 < volume(surface) / (4 / 3 * math.pi * ball**3) < 0.9  # perspective makes the near half slimmer


def test_a_long_bar_becomes_a_round_rod():
    half = 6.0
    surface = inflate(cutout((X - 32).abs() < half), SIZE)
    middle = surface.vertices[:, 1].abs() < 0.1
    assert surface.vertices[middle, 2].max() == pytest.approx(SWELL * half * PIXEL, rel=0.06)


def test_heights_scale_with_the_picture():
    small = inflate(cutout(soft_disc(10)), SIZE)
    large = inflate(cutout(soft_disc(20)), SIZE)
    assert large.vertices[:, 2].max() / small.vertices[:, 2].max() == pytest.approx(2, rel=0.05)


def test_the_resolution_changes_the_shape_little():
    coarse, fine = (inflate(cutout(soft_disc(20)), size) for size in (SIZE // 2, SIZE))
    assert volume(coarse) == pytest.approx(volume(fine), rel=0.05)


def test_a_symmetric_picture_gives_a_symmetric_surface():
    surface = inflate(cutout(SHAPES["disc"]), SIZE)
    for axis in range(3):
        mirrored = surface.vertices.clone()
        mirrored[:, axis] *= -1
        assert torch.cdist(surface.vertices, mirrored).min(1).values.max() < 1e-3


@pytest.mark.parametrize("name", ["disc", "donut", "three parts", "cropped bust"])
@pytest.mark.parametrize("turn_deg", [0.0, 25.0])
def test_the_input_view_shows_the_picture(name, turn_deg):
    picture = cutout(SHAPES[name])
    color, coverage = render_surface(
        inflate(picture, SIZE, DepthHint(turn_deg)), [OrbitCamera(width=SIZE, height=SIZE)]
    )
    excess = coverage[0, ..., 0] - picture[..., 3]
    assert excess.min() > -0.51  # half of an edge pixel is cut
    assert (excess > 0.51).sum() <= 0.002 * SIZE**2
    inside = torch.nn.functional.max_pool2d(1 - picture[None, None, ..., 3], 5, 1, 2)[0, 0] == 0
    assert inside.sum() > 100
    torch.testing.assert_close(color[0][inside], picture[inside][:, :3], atol=0.02, rtol=0)


@pytest.mark.parametrize("name", ["disc", "three parts", "half of the picture"])
def test_the_opposite_view_shows_the_mirrored_outline(name):
    surface = inflate(cutout(SHAPES[name]), SIZE)
    front, back = OrbitCamera(width=SIZE, height=SIZE), OrbitCamera(azimuth_deg=180, width=SIZE, height=SIZE)
    _, coverage = render_surface(surface, [front, back])
    differs = (coverage[1] - coverage[0].flip(1)).abs() > 0.26
    assert differs.sum() <= (0 if name == "disc" else 0.005 * SIZE**2)  # what keeps out of sight beside a notch


def test_the_hole_of_a_donut_stays_open():
    surface = inflate(cutout(SHAPES["donut"]), SIZE)
    vertices, faces = len(surface.vertices), len(surface.faces)
    assert vertices - faces // 2 == 0  # Euler's number of a torus
    _, coverage = render_surface(surface, [OrbitCamera(width=SIZE, height=SIZE)])
    assert coverage[0, SIZE // 2, SIZE // 2] == 0


def test_what_the_border_cuts_off_stays_thick_there():
    surface = inflate(cutout(SHAPES["cropped bust"]), SIZE)
    low = surface.vertices[:, 1] < -(SIZE / 2 - 2) * PIXEL * 0.8
    thick = surface.vertices[low, 2].max()
    assert thick > 0.6 * 20 * PIXEL


def test_front_and_back_agree_at_the_rim_and_only_the_front_is_seen():
    surface = inflate(cutout(SHAPES["disc"]), SIZE)
    assert surface.seen.float().mean() == pytest.approx(0.5, abs=0.1)
    assert (surface.vertices[surface.seen, 2] >= 0).all()
    assert (surface.vertices[~surface.seen, 2] < 0).all()
    corners = surface.seen[surface.faces].sum(1)
    across = surface.faces[(corners > 0) & (corners < 3)]
    steps = (surface.colors[across] - surface.colors[across.roll(1, 1)]).abs()
    assert steps.max() < 0.1


def test_the_fringe_of_the_old_background_does_not_color_the_sides():
    mask = soft_disc(20)
    picture = torch.cat([torch.where(mask[..., None] > 0.99, torch.tensor([0.8, 0.2, 0.1]), 1.0), mask[..., None]], -1)
    surface = inflate(picture, SIZE)
    torch.testing.assert_close(surface.colors, torch.tensor([0.8, 0.2, 0.1]).expand_as(surface.colors))


def test_turning_brings_the_right_side_nearer():
    flat, turned = (inflate(cutout(SHAPES["disc"]), SIZE, DepthHint(turn)) for turn in (0.0, 30.0))
    right = flat.vertices[:, 0] > 0.3
    assert (turned.vertices[right, 2] > flat.vertices[right, 2] + 0.1).all()


def test_a_translucent_subject_has_the_shape_of_the_opaque_one():
    clear, opaque = (inflate(cutout(soft_disc(20), alpha), SIZE) for alpha in (0.4, 1.0))
    torch.testing.assert_close(clear.vertices, opaque.vertices, atol=1e-5, rtol=0)


def test_specks_and_pinholes_are_dropped():
    mask = SHAPES["disc"].clone()
    mask[5, 5] = True
    mask[32, 32] = False
    dirty, clean = inflate(cutout(mask), SIZE), inflate(cutout(SHAPES["disc"]), SIZE)
    assert torch.equal(dirty.faces, clean.faces)


def test_an_empty_picture_is_refused():
    with pytest.raises(BadInput, match="no subject"):
        inflate(cutout(X < 0), SIZE)


def test_a_picture_that_is_not_square_is_refused():
    with pytest.raises(BadInput, match="64 x 32"):
        inflate(cutout(SHAPES["disc"])[:32], SIZE)


def test_the_same_picture_gives_the_same_bytes():
    first, second = (inflate(cutout(SHAPES["hair"]), SIZE) for _ in range(2))
    assert torch.equal(first.vertices, second.vertices) and torch.equal(first.colors, second.colors)


def test_resampling_keeps_the_colors_of_a_subject_before_a_background_of_another_color():
    picture = torch.zeros(SIZE, SIZE, 4)
    picture[16:48, 16:48] = torch.tensor([0.2, 0.5, 0.9, 1.0])
    small = resample(picture, 21)
    covered = small[..., 3] > 0.1
    torch.testing.assert_close(small[covered][:, :3], picture[20, 20, :3].expand(int(covered.sum()), 3))
    assert small[..., 3].sum() / 21**2 == pytest.approx(0.25, rel=0.02)


def test_samples_lie_evenly_on_the_surface():
    surface = inflate(cutout(SHAPES["disc"]), SIZE)
    points, normals, colors, area = sample_surface(surface, 2000, torch.Generator().manual_seed(0))
    a, b, c = surface.vertices.double()[surface.faces].unbind(1)
    assert area == pytest.approx(torch.linalg.cross(b - a, c - a).norm(dim=-1).sum().item() / 2)
    assert (normals.norm(dim=-1) - 1).abs().max() < 1e-5
    assert (normals * points).sum(-1).mean() > 0.9 * points.norm(dim=-1).mean()
    assert colors.shape == points.shape
    distances = torch.cdist(points, points) + 10 * torch.eye(2000)
    nearest = distances.min(1).values / math.sqrt(area / 2000)
    assert nearest.mean() > 0.55  # 0.5 for points that do not know of each other
    assert torch.cdist(surface.vertices[::7], points).min(1).values.max() < 3 * math.sqrt(area / 2000)


def test_samples_depend_on_the_generator_alone():
    surface = inflate(cutout(SHAPES["donut"]), SIZE)
    first, same, other = (sample_surface(surface, 50, torch.Generator().manual_seed(seed))[0] for seed in (1, 1, 2))
    assert torch.equal(first, same)
    assert not torch.equal(first, other)
