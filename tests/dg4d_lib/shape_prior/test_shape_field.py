"""Fields, expected volumes and surfaces of the shape prior."""

import math
from dataclasses import replace

import pytest
import torch
from tiny_shape_prior import tiny_network

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.inflation.hints import DepthHint
from dg4d_lib.inflation.render import render_surface
from dg4d_lib.shape_prior.decided import GENEROSITY, decide, matter_on, most_probable, smooth_logits
from dg4d_lib.shape_prior.expected import expected_volume
from dg4d_lib.shape_prior.field import (
    LARGEST_LOGIT,
    SMOOTHNESS,
    SURE,
    UNSURE,
    ShapeField,
    ShapeFields,
    as_bright_as,
    inflated_probability,
    inflated_share,
)
from dg4d_lib.shape_prior.frustum import BINS, FAR, NEAR, SIZE, TAN_HALF_FOV
from dg4d_lib.shape_prior.raymarch import render_volumes
from dg4d_lib.shape_prior.surface import decided_surface

RED, BLUE = torch.tensor([0.9, 0.1, 0.1]), torch.tensor([0.1, 0.1, 0.9])
RADIUS = 0.4
ROWS, COLUMNS = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")


def ball(center_z: float = 0.0, unsure: float = 0.0) -> ShapeField:
    """Return the field of a ball, red in front and blue behind; its logits are scaled by 1 - unsure."""
    distance = NEAR + (torch.arange(BINS) + 0.5) * (FAR - NEAR) / BINS
    x, y = (2 * COLUMNS / SIZE - 1) * TAN_HALF_FOV, (1 - 2 * ROWS / SIZE) * TAN_HALF_FOV
    points = torch.stack([x[..., None] * distance, y[..., None] * distance, (2 - distance).expand(SIZE, SIZE, -1)], -1)
    signed = RADIUS - (points - torch.tensor([0, 0, center_z])).norm(dim=-1)
    logits = (signed * 100 * (1 - unsure)).clamp(-LARGEST_LOGIT, LARGEST_LOGIT)
    mask = (signed > 0).any(-1)
    return ShapeField(logits, RED.expand(SIZE, SIZE, 3), BLUE.expand(SIZE, SIZE, BINS, 3), mask, 0.0)


def cutout(left: int = 40, right: int = 90) -> torch.Tensor:
    generator = torch.Generator().manual_seed(5)
    alpha = ((left < COLUMNS) & (right > COLUMNS) & (ROWS > 30) & (ROWS < 100)).float()
    return torch.cat([torch.rand(SIZE, SIZE, 3, generator=generator), alpha[..., None]], -1)


def test_the_input_view_of_the_expected_volume_shows_the_picture():
    field = ball()
    color, alpha = render_volumes([expected_volume(field, 1.2)], [OrbitCamera(width=SIZE, height=SIZE)])
    inner = (COLUMNS - SIZE / 2) ** 2 + (ROWS - SIZE / 2) ** 2 < (0.8 * RADIUS / 2 / TAN_HALF_FOV * SIZE / 2) ** 2
    assert alpha[0, ..., 0][inner].min() > 0.8
    straight = color[0][inner] / alpha[0][inner]
    assert (straight - RED).abs().max() < 0.12  # a trace of what lies behind it shines through
    assert not alpha[0, ..., 0][COLUMNS < 20].any()


def test_the_opposite_view_shows_hidden_colors():
    color, alpha = render_volumes([expected_volume(ball(), 1.2)], [OrbitCamera(0, 180, width=64, height=64)])
    assert (color[0, 32, 32] / alpha[0, 32, 32] - BLUE).abs().max() < 0.12


def test_unsure_depth_is_soft_from_the_side():
    side = OrbitCamera(0, 90, width=64, height=64)
    sharp, soft = (render_volumes([expected_volume(ball(0, u), 1.0)], [side])[1][0, ..., 0] for u in (0.0, 0.97))
    between = [float(((alpha > 0.1) & (alpha < 0.9)).float().mean()) for alpha in (sharp, soft)]
    assert between[1] > 2 * between[0]


def test_contrast_sharpens_unsure_depth():
    side = OrbitCamera(0, 90, width=64, height=64)
    soft, sharp = (render_volumes([expected_volume(ball(0, 0.97), c)], [side])[1][0, ..., 0] for c in (1.0, 8.0))
    between = [float(((alpha > 0.1) & (alpha < 0.9)).float().mean()) for alpha in (sharp, soft)]
    assert between[1] > 1.5 * between[0]


@pytest.mark.parametrize("center_z", [0.0, 0.3, -0.2])
def test_the_surface_of_a_ball_is_the_ball(center_z):
    surface = decided_surface(ball(center_z))
    radii = (surface.vertices - torch.tensor([0, 0, center_z])).norm(dim=1)
    assert (radii - RADIUS).abs().mean() < 0.015  # half a cell
    corners = surface.vertices[surface.faces].double()
    volume = (corners[:, 0] * torch.linalg.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert volume == pytest.approx(4 / 3 * math.pi * RADIUS**3, rel=0.12)  # the rim is unsure, so it gets more matter
    edges = torch.cat([surface.faces[:, [i, (i + 1) % 3]] for i in range(3)])
    assert (torch.unique(edges.sort(1)[0], dim=0, return_counts=True)[1] == 2).all()
    front = surface.vertices[:, 2] - center_z > 0.8 * RADIUS
    back = surface.vertices[:, 2] - center_z < -0.8 * RADIUS
    assert (surface.colors[front] - RED).abs().max() < 0.05 and surface.seen[front].all()
    assert (surface.colors[back] - BLUE).abs().max() < 0.05 and not surface.seen[back].any()


def test_matter_whose_depth_is_unsure_is_put_in_one_place():
    field = ball()
    spread = torch.where(field.mask[..., None], torch.full_like(field.logits, -1.4), field.logits)  # a fifth each
    spread[..., 40:44] += 0.2
    surface = decided_surface(replace(field, logits=spread))
    depth = surface.vertices[:, 2].max() - surface.vertices[:, 2].min()
    matter = float(matter_on(spread[64, 64][None], GENEROSITY)) * (FAR - NEAR) / BINS
    assert depth == pytest.approx(matter, rel=0.15) and matter < 0.65
    middle = 2 - (NEAR + 42 * (FAR - NEAR) / BINS)
    assert surface.vertices[:, 2].mean() == pytest.approx(middle, abs=0.1)  # equal cells: those near the middle first


def test_every_pixel_of_the_subject_has_matter():
    field = ball(unsure=0.99)
    faint = replace(field, logits=field.logits - 4)
    _, alpha = render_surface(decided_surface(faint), [OrbitCamera(width=SIZE, height=SIZE)])
    inside = (alpha[0, ..., 0] > 0.5) & field.mask
    assert inside.sum() > 0.97 * field.mask.sum()


@pytest.mark.parametrize("contrast", [0.5, 1.0, 4.0, 16.0])
def test_contrast_keeps_the_matter_of_every_ray(contrast):
    field = ball(unsure=0.9)
    before, after = (
        each.sigmoid().sum(-1)[field.mask] for each in (field.logits, decide(field.logits, field.mask, contrast))
    )
    torch.testing.assert_close(after, before.clamp(min=1), atol=0.01, rtol=0.001)


def test_unsure_matter_counts_for_more():
    rays = torch.stack([torch.full((BINS,), -1.4), torch.full((BINS,), -LARGEST_LOGIT)])
    rays[1, 20:30] = LARGEST_LOGIT
    p = float(torch.sigmoid(torch.tensor(-1.4)))
    unsure, sure = matter_on(rays, 0.5)[:, 0].tolist()
    assert unsure == pytest.approx(BINS * (p + 0.5 * p * (1 - p)), rel=1e-4)
    assert sure == pytest.approx(10, abs=0.5)


def test_smooth_logits_keep_the_outline_and_a_plane():
    field = ball()
    level = torch.where(field.mask[..., None], torch.tensor(2.0), torch.tensor(-LARGEST_LOGIT)).expand(SIZE, SIZE, BINS)
    torch.testing.assert_close(smooth_logits(level, field.mask, SMOOTHNESS), level, atol=1e-4, rtol=0)


def test_a_mirrored_picture_has_the_mirrored_field():
    network, picture = tiny_network(), cutout()
    here, there = (ShapeFields(network, [each]).predict(0) for each in (picture, picture.flip(1)))
    torch.testing.assert_close(here.logits.flip(1), there.logits, atol=1e-4, rtol=0)
    torch.testing.assert_close(here.hidden.flip(1), there.hidden, atol=1e-4, rtol=0)


def test_frames_share_the_code_of_their_subject():
    network, pictures = tiny_network(), [cutout(), cutout(20, 70)]
    both, alone = ShapeFields(network, pictures), ShapeFields(network, pictures[:1])
    twice = ShapeFields(network, pictures[:1] * 2)
    torch.testing.assert_close(twice.predict(1).logits, alone.predict(0).logits)
    assert (both.predict(0).logits - alone.predict(0).logits).abs().max() > 1e-4


def test_a_single_picture_is_encoded_once_and_only_if_it_is_asked_for(monkeypatch):
    network, encoded = tiny_network(), []
    encode = network.encode
    monkeypatch.setattr(network, "encode", lambda picture: encoded.append(picture) or encode(picture))
    fields = ShapeFields(network, [cutout()])
    assert not encoded
    assert torch.equal(fields.logits(0), fields.predict(0).logits)
    fields.mirror_plane(0)
    assert len(encoded) == 1


def test_matter_is_inside_the_silhouette_alone():
    field = ShapeFields(tiny_network(), [cutout()]).predict(0)
    assert (field.logits[~field.mask] == -LARGEST_LOGIT).all()
    assert torch.equal(field.mask, cutout()[..., 3] > 0.5)


def test_the_inflation_takes_over_as_the_network_gets_unsure():
    mask = cutout()[..., 3] > 0.5
    shares = [inflated_share(torch.full((SIZE, SIZE, BINS), 1 - unsure), mask) for unsure in (0.2, SURE, 0.9, UNSURE)]
    assert shares[:2] == pytest.approx([0, 0], abs=1e-5) and shares[3] == pytest.approx(1, abs=1e-4)
    assert 0.5 < shares[2] < 0.8


def test_an_unsure_network_gives_the_inflated_shape():
    network = tiny_network()
    with torch.no_grad():
        network.head.weight.zero_()
        network.head.bias.fill_(-4.0)
    field = ShapeFields(network, [cutout()]).predict(0)
    assert field.inflated_share == 1
    inflated = inflated_probability(field.mask)
    assert (field.logits.sigmoid() - inflated).abs().max() < 0.02
    assert (inflated[64, 65].argmax() + 0.5) == pytest.approx(BINS / 2, abs=6)


def test_a_hint_brings_the_right_side_nearer_and_mirrors():
    network, picture = tiny_network(), cutout(20, 110)
    near = torch.linspace(1, -1, BINS)
    sides = []
    for turn_deg in (0.0, 30.0, -30.0):
        matter = ShapeFields(network, [picture], DepthHint(turn_deg)).predict(0).logits[60].sigmoid()
        depth = (matter * near).sum(1) / matter.sum(1)
        sides.append(float(depth[95:105].mean() - depth[25:35].mean()))
    assert sides[1] - sides[0] > 0.05 and sides[2] - sides[0] < -0.05


def test_a_ray_whose_cells_are_all_equal_has_matter_in_its_middle():
    mask = torch.ones(SIZE, SIZE, dtype=torch.bool)
    chosen = most_probable(torch.full((SIZE, SIZE, BINS), -LARGEST_LOGIT), mask)
    assert chosen.isfinite().all()
    assert (chosen.argmax(-1) - BINS / 2).abs().max() <= 1 and (chosen.amax(-1) == 1).all()


def test_oblong_pictures_are_refused():
    with pytest.raises(BadInput, match="square"):
        ShapeFields(tiny_network(), [cutout()[:64]])


@pytest.mark.parametrize(
    ("seen", "guessed", "expected"),
    [(0.5, 0.3, 0.435), (0.2, 0.3, 0.174), (0.9, 0.1, 0.2), (0.1, 0.9, 0.45), (0.9, 0.6, 0.783), (0.0, 0.0, 0.0)],
)
def test_hidden_colors_have_the_brightness_that_follows_from_the_picture(
    seen: float, guessed: float, expected: float
) -> None:
    """Of twice or half the brightness at most; where there is no matter, colors do not count."""
    picture = torch.zeros(4, SIZE, SIZE)
    picture[:, 40:80] = torch.tensor([seen, seen, seen, 1.0])[:, None, None]
    probability, hidden = torch.zeros(SIZE, SIZE, BINS), torch.rand(SIZE, SIZE, BINS, 3)
    probability[40:80, :, 20:30], hidden[40:80, :, 20:30] = 0.7, guessed
    found = as_bright_as(hidden, probability, picture)[40:80, :, 20:30]
    torch.testing.assert_close(found, torch.full_like(found, expected))
