"""Network of the shape prior: shapes, weights files, rays one by one and all at once."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from dg4d_lib.errors import BadInput
from dg4d_lib.shape_prior.frustum import BINS, KNOTS, SIZE
from dg4d_lib.shape_prior.network import ShapePriorConfig, ShapePriorNetwork, coordinates, load_network, save_network

TINY = ShapePriorConfig(widths=(8, 16, 32, 32), blocks=(1, 1, 1), layers=1, head=32)


@pytest.fixture
def network() -> ShapePriorNetwork:
    torch.manual_seed(0)
    made = ShapePriorNetwork(TINY)
    for parameter in made.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    return made.eval()


@pytest.fixture
def picture() -> torch.Tensor:
    torch.manual_seed(1)
    alpha = torch.zeros(2, 1, SIZE, SIZE)
    alpha[:, :, 30:90, 40:70] = 1
    return torch.cat([torch.rand(2, 3, SIZE, SIZE) * alpha, alpha], 1)


def whole_picture(
    network: ShapePriorNetwork, picture: torch.Tensor, code: torch.Tensor | None = None
) -> tuple[torch.Tensor, ...]:
    """Return occupancy, colors and their scale on all rays, by batch, row and column."""
    features = network.encode(picture)
    found = network.rays(network.decode(features, code), features.picture, torch.arange(len(picture) * SIZE**2))
    return tuple(part.unflatten(0, (-1, SIZE, SIZE)) for part in found)


def test_every_ray_gets_occupancy_colors_and_a_scale(network: ShapePriorNetwork, picture: torch.Tensor) -> None:
    occupancy, colors, scale = whole_picture(network, picture)
    assert occupancy.shape == (2, SIZE, SIZE, BINS)
    assert colors.shape == (2, SIZE, SIZE, KNOTS, 3)
    assert ((colors >= 0) & (colors <= 1)).all()
    assert (scale > 0).all()


def test_the_moment_of_the_mirror_plane_is_symmetric(network: ShapePriorNetwork, picture: torch.Tensor) -> None:
    moment, _, _ = network.mirror(network.encode(picture).code)
    assert torch.equal(moment, moment.transpose(1, 2))


def test_chosen_rays_are_the_same_as_in_the_whole_picture(network: ShapePriorNetwork, picture: torch.Tensor) -> None:
    places = [(0, 31, 42), (1, 64, 64), (1, 55, 41), (0, 80, 69)]
    pixels = torch.tensor([(batch * SIZE + row) * SIZE + column for batch, row, column in places])
    features = network.encode(picture)
    chosen = network.rays(network.decode(features), features.picture, pixels)
    for some, every in zip(chosen, whole_picture(network, picture), strict=True):
        for ray, place in zip(some, places, strict=True):
            torch.testing.assert_close(ray, every[place])


def test_rays_read_features_as_linear_interpolation_does(network: ShapePriorNetwork, picture: torch.Tensor) -> None:
    decoded = torch.rand(2, TINY.widths[0], SIZE // 2, SIZE // 2)
    planes = torch.zeros(2, 8, SIZE, SIZE)
    network.refine.weight.data = torch.eye(TINY.head, TINY.widths[0] + 8)
    network.refine.bias.data.zero_()
    network.head.weight.data = torch.eye(*network.head.weight.shape)
    network.head.bias.data.zero_()
    found, _, _ = network.rays(decoded, planes, torch.arange(2 * SIZE**2))
    expected = torch.nn.functional.interpolate(decoded, scale_factor=2, mode="bilinear", align_corners=False)
    expected = torch.nn.functional.silu(expected).permute(0, 2, 3, 1).flatten(0, 2)
    torch.testing.assert_close(found[:, : TINY.widths[0]], expected)


def test_frames_can_share_the_code_of_their_subject(network: ShapePriorNetwork, picture: torch.Tensor) -> None:
    code = network.encode(picture).code.mean(0, keepdim=True).expand(2, -1)
    moment, _, _ = network.mirror(code)
    assert torch.equal(moment[0], moment[1])
    shared, _, _ = whole_picture(network, picture, code)
    assert not torch.equal(shared[0], shared[1])
    assert not torch.allclose(shared, whole_picture(network, picture)[0])


def test_coordinates_inside_the_subject_run_from_minus_one_to_one() -> None:
    alpha = torch.zeros(1, SIZE, SIZE)
    alpha[0, 20:60, 50:111] = 1
    x, x_inside, y, y_inside = coordinates(alpha)[0]
    assert x[0, 0] == pytest.approx(-1 + 1 / SIZE)
    assert y[-1, 0] == pytest.approx(1 - 1 / SIZE)
    assert (x_inside[0, 50], x_inside[0, 110]) == (-1, 1)
    assert (y_inside[20, 0], y_inside[59, 0]) == (-1, 1)


def test_an_empty_picture_gives_finite_numbers(network: ShapePriorNetwork) -> None:
    occupancy, _, _ = whole_picture(network, torch.zeros(1, 4, SIZE, SIZE))
    assert occupancy.isfinite().all()


def test_weights_survive_their_file(network: ShapePriorNetwork, picture: torch.Tensor, tmp_path: Path) -> None:
    save_network(network, tmp_path / "n.safetensors")
    again = load_network(tmp_path / "n.safetensors")
    assert again.config == TINY
    # float16 keeps eleven bits
    stored, exact = (whole_picture(made, picture)[0] for made in (again, network))
    torch.testing.assert_close(stored, exact, rtol=0.02, atol=0.02)


def test_other_files_are_refused(tmp_path: Path) -> None:
    save_file({"a": torch.zeros(1)}, tmp_path / "n.safetensors", {"format": "other"})
    with pytest.raises(BadInput, match="format 'other' is not"):
        load_network(tmp_path / "n.safetensors")


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_weights_that_are_not_finite_are_refused(value: float, network: ShapePriorNetwork, tmp_path: Path) -> None:
    with torch.no_grad():
        network.stem.bias[3] = value
    save_network(network, tmp_path / "n.safetensors")
    with pytest.raises(BadInput, match=r"n\.safetensors is damaged: stem\.bias has values that are not finite"):
        load_network(tmp_path / "n.safetensors")


def test_weights_that_cannot_be_read_are_named(network: ShapePriorNetwork, tmp_path: Path) -> None:
    file = tmp_path / "n.safetensors"
    with pytest.raises(BadInput, match=r"n\.safetensors cannot be read as weights of the shape prior"):
        load_network(file)
    save_network(network, file)
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(BadInput, match=r"n\.safetensors cannot be read as weights of the shape prior"):
        load_network(file)


@pytest.mark.parametrize("widths", [(8, 8, 8, 8), (12, 16, 32, 32), (8, 16, 32, 48), (0, 8, 8, 32)])
def test_widths_that_do_not_fit_are_refused(widths: tuple[int, int, int, int]) -> None:
    with pytest.raises(BadInput, match=f"widths {' '.join(map(str, widths))} do not fit .* 8 .* 32 "):
        ShapePriorConfig(widths)


def test_the_shipped_size_is_at_most_eight_megabytes() -> None:
    assert 2 * sum(value.numel() for value in ShapePriorNetwork().parameters()) <= 8e6
