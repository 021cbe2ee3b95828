"""Contract of all deformation models."""

from copy import deepcopy

import pytest
import torch

from dg4d_lib.deformation import hexplane
from dg4d_lib.deformation.factory import new_deformation
from dg4d_lib.deformation.framewise import Framewise
from dg4d_lib.deformation.hexplane import HexPlane, plane_features, time_lines
from dg4d_lib.deformation.interface import Deformation
from dg4d_lib.deformation.mlp import Mlp, encode
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.initialize import blob
from dg4d_lib.settings import FramewiseSettings, HexPlaneSettings, MlpSettings

COUNT, FRAMES = 60, 5
BOX = torch.tensor([[-0.6, -0.6, -0.6], [0.6, 0.6, 0.6]])
SMALL = HexPlaneSettings(spatial=8, temporal=6, features=8, hidden=16)


def make(kind: str) -> Deformation:
    generator = torch.Generator().manual_seed(0)
    match kind:
        case "hexplane":
            return HexPlane(SMALL, BOX, generator)
        case "two scales":
            return HexPlane(SMALL.model_copy(update={"scales": (1, 2)}), BOX, generator)
        case "mlp":
            return Mlp(MlpSettings(frequencies=3, hidden=16), BOX, generator)
        case _:
            return Framewise(FRAMES, COUNT)


KINDS = ["hexplane", "two scales", "mlp", "framewise"]


@pytest.fixture
def cloud():
    return blob(COUNT, 0.5, torch.Generator().manual_seed(1))


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_the_identity_at_the_start(kind: str, cloud):
    moved = make(kind).displace(cloud.means, torch.linspace(0, 1, FRAMES)).apply(cloud)
    assert moved.means.shape == (FRAMES, COUNT, 3)
    for name in ("means", "log_scales", "quats"):
        assert torch.equal(getattr(moved, name), getattr(cloud, name).expand_as(getattr(moved, name)))


@pytest.mark.parametrize("kind", KINDS)
def test_it_recovers_a_slide_along_x(kind: str, cloud):
    deformation, times = make(kind), torch.linspace(0, 1, FRAMES)
    slide = torch.stack([0.3 * times, torch.zeros(FRAMES), torch.zeros(FRAMES)], -1)[:, None]
    adam = torch.optim.Adam(deformation.parameters(), lr=0.01)
    for _ in range(300):
        adam.zero_grad()
        (deformation.displace(cloud.means, times).means - slide).square().mean().backward()
        adam.step()
    assert (deformation.displace(cloud.means, times).means - slide).abs().max() < 0.02


@pytest.mark.parametrize("kind", KINDS)
def test_planes_are_some_of_the_parameters(kind: str):
    deformation = make(kind)
    everything = {id(parameter) for parameter in deformation.parameters()}
    assert {id(parameter) for parameter in deformation.grid_parameters()} <= everything


def test_only_the_last_matrices_learn_at_the_first_step(cloud):
    deformation = HexPlane(SMALL, BOX, torch.Generator().manual_seed(0))
    deformation.displace(cloud.means, torch.tensor([0.5])).means.sum().backward()
    moved = {name for name, p in deformation.named_parameters() if p.grad is not None and p.grad.abs().max() > 0}
    assert moved == {"heads.means.outer.weight", "heads.means.outer.bias"}


def test_displacements_and_gradients_are_those_of_three_residual_heads(cloud, monkeypatch):
    monkeypatch.setattr(hexplane, "ROWS", 37)  # parts that end within a moment
    deformation = HexPlane(SMALL, BOX, torch.Generator().manual_seed(0))
    generator = torch.Generator().manual_seed(3)
    for parameter in deformation.heads.parameters():
        torch.nn.init.normal_(parameter, std=0.3, generator=generator)
    times, cotangents = torch.linspace(0, 1, 4), [torch.randn(4, COUNT, k, generator=generator) for k in (3, 3, 4)]
    moved = deformation.displace(cloud.means, times)
    found = torch.autograd.grad(
        [moved.means, moved.log_scales, moved.quats], list(deformation.parameters()), cotangents
    )

    exact = deepcopy(deformation).double()
    place = (cloud.means.double() - exact.bounds[0]) / (exact.bounds[1] - exact.bounds[0]) * 2 - 1
    features = plane_features(place.clamp(-1, 1), exact.space[0], time_lines(exact.time[0], times.double()))
    hidden = exact.trunk(features).relu()
    heads = (exact.heads.means, exact.heads.log_scales, exact.heads.quats)
    outputs = [head.outer(hidden + head.inner(hidden)) for head in heads]
    for output, name in zip(outputs, ("means", "log_scales", "quats"), strict=True):
        torch.testing.assert_close(getattr(moved, name).double(), output, rtol=1e-5, atol=1e-6)
    truth = torch.autograd.grad(outputs, list(exact.parameters()), [value.double() for value in cotangents])
    for gradient, true_gradient in zip(found, truth, strict=True):
        assert (gradient - true_gradient).norm() / true_gradient.norm() < 1e-5


def test_the_encoding_doubles_its_frequency_from_octave_to_octave():
    x, y = values = torch.tensor([0.1, 0.7])
    angles = torch.pi * torch.stack([x, y, 2 * x, 2 * y, 4 * x, 4 * y])
    torch.testing.assert_close(encode(values, 3), torch.cat([values, angles.sin(), angles.cos()]))


def test_the_network_sees_positions_and_times_from_minus_one_to_one(cloud):
    field, times = make("mlp"), torch.tensor([0.0, 0.4, 1.0])
    for parameter in field.heads.parameters():
        torch.nn.init.normal_(parameter, std=0.3, generator=torch.Generator().manual_seed(2))
    places = torch.cat([(cloud.means / 0.6).expand(3, -1, -1), (2 * times - 1)[:, None, None].expand(3, COUNT, 1)], -1)
    expected = field.heads(field.second, field.first(encode(places, 3)).relu())
    torch.testing.assert_close(field.displace(cloud.means, times).means, expected.means)


@pytest.mark.parametrize("kind", ["hexplane", "mlp"])
def test_the_last_frame_lies_at_the_given_place_on_the_time_axis(kind: str, cloud):
    whole = make(kind)
    for parameter in whole.parameters():
        torch.nn.init.uniform_(parameter, 0.1, 0.5, generator=torch.Generator().manual_seed(2))
    part, times = deepcopy(whole), torch.tensor([0.0, 0.4, 1.0])
    part.last = 0.75
    found = part.displace(cloud.means, times).means
    torch.testing.assert_close(found, whole.displace(cloud.means, 0.75 * times).means)
    assert not torch.allclose(found[2], whole.displace(cloud.means, times).means[2])


@pytest.mark.parametrize("kind", KINDS)
def test_a_field_begins_the_same_for_the_same_seed(kind: str):
    torch.manual_seed(1)
    first = make(kind)
    torch.manual_seed(2)
    for ours, theirs in zip(first.parameters(), make(kind).parameters(), strict=True):
        assert torch.equal(ours, theirs)


def test_time_lines_are_exact_on_the_steps_and_linear_between():
    planes = torch.arange(6.0).reshape(1, 1, 3, 2).expand(3, 1, 3, 2)
    lines = time_lines(planes, torch.tensor([0.0, 0.25, 1.0]))
    assert lines[0, :, 0].tolist() == [[0.0, 1.0], [1.0, 2.0], [4.0, 5.0]]


def test_features_are_the_product_of_six_samples():
    generator = torch.Generator().manual_seed(0)
    planes = torch.rand(3, 4, 5, 5, generator=generator)
    lines = torch.rand(3, 2, 4, 5, generator=generator)
    corner = torch.tensor([[-1.0, 1.0, -1.0]])  # first cell in x and z, last in y
    expected = planes[0, :, 4, 0] * planes[1, :, 0, 0] * planes[2, :, 0, 4]
    expected = expected * lines[0, :, :, 0] * lines[1, :, :, 4] * lines[2, :, :, 0]
    torch.testing.assert_close(plane_features(corner, planes, lines)[:, 0], expected)


def test_regularizers_count_only_when_switched_on():
    assert HexPlane(SMALL, BOX, torch.Generator().manual_seed(0)).regularization_loss() == 0
    weights = {"variation_weight": 1.0, "smoothness_weight": 1.0, "sparsity_weight": 1.0}
    rough = HexPlane(SMALL.model_copy(update=weights), BOX, torch.Generator().manual_seed(0))
    assert rough.regularization_loss() > 0  # random spatial planes
    for plane in rough.space:
        plane.data.fill_(0.3)
    assert rough.regularization_loss() == 0  # constant planes, time planes at one


def public_smoothness(plane: torch.Tensor) -> torch.Tensor:
    """Mean squared second difference along the rows, as a loop."""
    rows = plane.shape[1]
    terms = [(plane[:, i + 2] - plane[:, i + 1]) - (plane[:, i + 1] - plane[:, i]) for i in range(rows - 2)]
    return torch.stack(terms).square().mean()


def test_regularizers_are_the_public_codes_sums_over_planes():
    weights = {"variation_weight": 2.0, "smoothness_weight": 3.0, "sparsity_weight": 5.0, "scales": (1, 2)}
    field = HexPlane(SMALL.model_copy(update=weights), BOX, torch.Generator().manual_seed(0)).double()
    for plane in field.time:
        plane.data += 0.1 * torch.randn(plane.shape, generator=torch.Generator().manual_seed(1)).double()
    expected = torch.zeros((), dtype=torch.float64)
    for space, time in zip(field.space, field.time, strict=True):
        expected += 2.0 * sum(public_smoothness(p) + public_smoothness(p.mT) for p in space)  # public: rows only
        expected += 3.0 * sum(public_smoothness(p) for p in time)
        expected += 5.0 * sum((1 - p).abs().mean() for p in time)
    torch.testing.assert_close(field.regularization_loss(), expected)


def test_planes_that_change_evenly_cost_nothing():
    field = HexPlane(SMALL.model_copy(update={"variation_weight": 1.0}), BOX, torch.Generator().manual_seed(0))
    ramp = torch.linspace(0, 1, 8)
    for plane in field.space:
        plane.data.copy_((ramp[:, None] - 2 * ramp).expand_as(plane))
    assert field.regularization_loss() < 1e-12  # a first difference would see the slope


@pytest.mark.parametrize("temporal", [2, 3])
@pytest.mark.parametrize("spatial", [2, 3])
def test_the_regularizers_of_the_smallest_planes_are_finite(spatial: int, temporal: int):
    weights = dict.fromkeys(("variation_weight", "smoothness_weight", "sparsity_weight"), 1.0)
    settings = HexPlaneSettings(spatial=spatial, temporal=temporal, features=2, hidden=4, **weights)
    field = HexPlane(settings, BOX, torch.Generator().manual_seed(0))
    loss = field.regularization_loss()
    loss.backward()
    assert torch.isfinite(loss)
    assert all(plane.grad is None or torch.isfinite(plane.grad).all() for plane in field.grid_parameters())
    assert (loss > 0) == (spatial > 2)  # two steps have no second difference


@pytest.mark.parametrize("kind", ["hexplane", "mlp"])
def test_the_last_layer_of_the_means_carries_the_unit_of_length(kind: str, cloud):
    deformation = make(kind)
    for parameter in deformation.heads.parameters():
        torch.nn.init.normal_(parameter, generator=torch.Generator().manual_seed(2))
    before = deformation.displace(cloud.means, torch.tensor([0.5]))
    for parameter in deformation.length_parameters():
        parameter.data *= 3
    after = deformation.displace(cloud.means, torch.tensor([0.5]))
    torch.testing.assert_close(after.means, 3 * before.means)
    assert torch.equal(after.quats, before.quats) and torch.equal(after.log_scales, before.log_scales)


def test_random_heads_move_the_cloud_before_the_first_step(cloud):
    random = HexPlane(SMALL.model_copy(update={"zero_start": False}), BOX, torch.Generator().manual_seed(0))
    moved = random.displace(cloud.means, torch.linspace(0, 1, FRAMES))
    assert all((part != 0).any(-1).all() for part in (moved.means, moved.log_scales, moved.quats))
    random.displace(cloud.means, torch.tensor([0.5])).means.sum().backward()
    assert random.space[0].grad.abs().max() > 0  # everything learns at once


def test_scattered_gaussians_begin_anywhere_within_the_radius_and_elsewhere_in_every_frame():
    box = torch.tensor([[-0.6, -0.2, -0.2], [0.6, 0.2, 0.2]])
    scattered = new_deformation(
        FramewiseSettings(start="scattered"), box, FRAMES, 2000, torch.Generator().manual_seed(0)
    )
    start = scattered.displace(torch.zeros(2000, 3), torch.linspace(0, 1, FRAMES))
    distances = start.means.norm(dim=-1)
    assert 0.59 < distances.max() < 0.6 + 1e-6
    assert distances.mean().item() == pytest.approx(0.75 * 0.6, rel=0.02)  # evenly over the ball
    assert torch.corrcoef(start.means[:2, :, 0])[0, 1].abs() < 0.1
    assert not start.log_scales.any() and not start.quats.any()


def test_a_framewise_table_refuses_another_cloud():
    with pytest.raises(BadInput, match="has 60 Gaussians; given 3"):
        Framewise(FRAMES, COUNT).displace(torch.zeros(3, 3), torch.tensor([0.0]))
