import math

import pytest
import torch

from dg4d_lib.cameras.orbit import RADIUS, OrbitCamera
from dg4d_lib.mesh_rasterizer import texture_cpu
from dg4d_lib.mesh_rasterizer.texture import (
    TextureLookup,
    build_lookup,
    sample_bilinear,
    sample_texture,
    texture_places,
)
from dg4d_lib.mesh_rasterizer.zbuffer import interpolate, rasterize_mesh

CAMERA = OrbitCamera(width=32, height=32)
FACES = torch.tensor([[0, 1, 2], [0, 2, 3]])
UVS = torch.tensor([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])


def board(pixels: float, camera: OrbitCamera = CAMERA) -> torch.Tensor:
    """A square that faces the input camera, so many pixels wide."""
    half = 0.5 * pixels * RADIUS / camera.focal
    return torch.tensor([[-half, -half, 0.0], [half, -half, 0.0], [half, half, 0.0], [-half, half, 0.0]])


def slanted() -> torch.Tensor:
    """A board that turns its right side away by 60 degrees and its top by some."""
    vertices = board(28)
    vertices[:, 2] = -1.7 * vertices[:, 0] - 0.4 * vertices[:, 1]
    return vertices


def look(vertices: torch.Tensor, size: int, uvs: torch.Tensor = UVS, faces: torch.Tensor = FACES) -> TextureLookup:
    return build_lookup(vertices, faces, uvs, (size, size), [CAMERA], rasterize_mesh(vertices, faces, [CAMERA]))


def level_of(lookup: TextureLookup) -> torch.Tensor:
    """Mip level of every pixel, h w; not a number where nothing is."""
    picture = torch.full(lookup.covered.shape, math.nan)
    levels = torch.zeros(int(lookup.covered.sum()))
    for level, taps in enumerate(lookup.levels):
        levels[taps.pixels] += level * taps.weights
    picture[lookup.covered] = levels
    return picture[0]


def noise(*shape: int) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("size", [8, 50, 256, 1024])
def test_one_color_is_read_as_it_is(size):
    color = torch.tensor([0.2, 0.5, 0.9])
    lookup = look(slanted(), size)
    torch.testing.assert_close(
        sample_texture(color.expand(size, size, 3), lookup), color.expand(int(lookup.covered.sum()), 3)
    )


def test_a_magnified_ramp_is_exact():
    ramp = torch.linspace(0, 1, 16)
    texture = torch.stack(torch.broadcast_tensors(ramp[:, None], ramp), -1)
    lookup = look(board(30), 16)
    u = ((torch.arange(32) + 0.5 - 16) / 30 + 0.5) * 16 - 0.5  # in texels
    expected = torch.stack(torch.broadcast_tensors(u[:, None], u), -1).clamp(0, 15)[1:31, 1:31] / 15
    torch.testing.assert_close(sample_texture(texture, lookup), expected.reshape(-1, 2), atol=1e-6, rtol=0)


@pytest.mark.parametrize(("pixels", "size"), [(30, 16), (30, 64), (12.5, 64), (4.7, 1024)])
def test_the_level_of_a_board_is_that_of_texels_of_a_pixels_variance(pixels, size):
    levels = level_of(look(board(pixels), size))
    expected = max(0.0, math.log2(size / pixels / math.sqrt(3)))
    seen = levels[~levels.isnan()]
    torch.testing.assert_close(seen, torch.full_like(seen, expected), atol=1e-4, rtol=0)


def test_the_level_is_that_of_the_slope_between_neighboring_samples():
    fine = OrbitCamera(width=33 * 32, height=33 * 32)  # sample 16 + 33 i of a line is the center of pixel i
    fragments = rasterize_mesh(slanted(), FACES, [fine])
    places = interpolate(fragments, FACES, UVS)[0].double()
    covered = fragments.faces[0, 15::33, 15::33] >= 0
    for shift in (15, 16, 17):
        covered &= (fragments.faces[0, shift::33, 16::33] >= 0) & (fragments.faces[0, 16::33, shift::33] >= 0)
    columns = places[16::33, 17::33] - places[16::33, 15::33]
    rows = places[17::33, 16::33] - places[15::33, 16::33]
    sides = torch.stack([columns, rows]) * 33 / 2 * 256  # texels per pixel
    expected = 0.5 * (sides.square().sum((0, -1)) / 6).log2()
    levels = level_of(look(slanted(), 256)).double()
    torch.testing.assert_close(levels[covered], expected[covered], atol=2e-3, rtol=0)
    assert covered.sum() > 300 and levels[covered].max() - levels[covered].min() > 0.5


def test_the_level_of_a_triangle_does_not_ask_its_neighbors():
    vertices, uvs = torch.cat([slanted(), slanted()]), torch.cat([UVS, 0.1 * UVS])
    faces = torch.stack([FACES[0], FACES[1] + 4])  # seams: the second has texels ten times as large
    both = level_of(look(vertices, 512, uvs, faces))
    alone = [level_of(look(vertices, 512, uvs, face[None])) for face in faces]
    expected = torch.where(alone[0].isnan(), alone[1], alone[0])
    torch.testing.assert_close(both, expected, equal_nan=True, atol=0, rtol=0)
    assert alone[0].nanmean() > alone[1].nanmean() + 2


def test_a_checkerboard_far_away_is_gray():
    index = torch.arange(256)
    checkers = ((index[:, None] + index) % 2)[..., None].float()
    gray = sample_texture(checkers, look(board(24), 256))
    torch.testing.assert_close(gray, torch.full_like(gray, 0.5))


@pytest.mark.parametrize("size", [64, 75])
def test_a_texture_in_one_pixel_is_its_mean(size):
    texture, shift = noise(size, size, 3), torch.tensor([0.5, 0.5, 0.0]) * RADIUS / CAMERA.focal
    point = look(board(0.9 / size) + shift, size)  # in the middle of a pixel
    tolerance = 1e-5 if size == 64 else 0.05  # halves of odd sides weigh some texels twice
    torch.testing.assert_close(sample_texture(texture, point), texture.mean((0, 1))[None], atol=tolerance, rtol=0)


@pytest.mark.parametrize("size", [6, 12])
def test_gradients_of_the_texture_are_finite_differences(size):
    lookup = look(slanted(), 16 * size)  # the levels of a larger texture: several are read
    assert 3 <= len(lookup.levels) <= (size - 1).bit_length() + 1
    texture = noise(size, size, 2).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda value: sample_texture(value, lookup), texture)


@pytest.mark.parametrize("size", [16, 300])
def test_every_pixel_hands_one_gradient_to_the_texture(size):
    texture = noise(size, size, 3).double().requires_grad_()
    seen = sample_texture(texture, look(slanted(), size))
    seen.sum().backward()
    assert texture.grad.sum() == pytest.approx(seen.numel(), rel=1e-6)


def test_states_and_cameras_belong_together():
    cameras = [CAMERA, OrbitCamera(30, 40, width=32, height=32)]
    states, texture = torch.stack([board(20), slanted()]), noise(128, 128, 3)
    both = build_lookup(states, FACES, UVS, (128, 128), cameras, rasterize_mesh(states, FACES, cameras))
    parts = [
        build_lookup(state, FACES, UVS, (128, 128), [camera], rasterize_mesh(state, FACES, [camera]))
        for state, camera in zip(states, cameras, strict=True)
    ]
    alone = torch.cat([sample_texture(texture, part) for part in parts])
    torch.testing.assert_close(sample_texture(texture, both), alone, atol=1e-6, rtol=0)


@pytest.mark.parametrize("shared", [True, False])
def test_kernels_and_operators_find_the_same_places(shared: bool):
    cameras = [OrbitCamera(-20, -30, width=64, height=48), OrbitCamera(30, 40, width=64, height=48)]
    states = slanted() if shared else torch.stack([board(20), slanted()])
    fragments = rasterize_mesh(states, FACES, cameras)
    rasterized = texture_cpu.Rasterized(states, FACES, UVS, cameras, fragments)
    uvs, levels = texture_cpu.texture_places(rasterized, (128, 300))
    expected = texture_places(rasterized, (128, 300))
    assert len(uvs) == (fragments.faces >= 0).sum() > 500
    torch.testing.assert_close(uvs, expected[0], atol=1e-7, rtol=0)
    torch.testing.assert_close(levels, expected[1], atol=1e-6, rtol=0)


def test_nothing_seen_is_nothing_read():
    assert sample_texture(noise(8, 8, 3), look(board(20) + 10, 8)).shape == (0, 3)


def test_a_triangle_seen_edge_on_is_no_trouble():
    fragments = rasterize_mesh(board(20), FACES, [CAMERA])
    edge_on = board(20)[:, [2, 1, 0]]
    lookup = build_lookup(edge_on, FACES, UVS, (64, 64), [CAMERA], fragments)
    assert sample_texture(noise(64, 64, 3), lookup).isfinite().all()


def test_the_border_goes_on_outside():
    picture = noise(4, 6, 3)
    corners = sample_bilinear(picture, torch.tensor([[-0.5, -0.5], [2.0, 0.0], [0.0, 1.0], [1.5, 1.5]]))
    torch.testing.assert_close(corners, picture[[0, 0, -1, -1], [0, -1, 0, -1]])


def test_nothing_is_made_on_another_device(monkeypatch):
    """The default device holds no numbers: whatever is made there cannot be computed with."""
    vertices, texture = slanted(), noise(64, 64, 3)
    fragments, pose = rasterize_mesh(vertices, FACES, [CAMERA]), CAMERA.viewmat()
    monkeypatch.setattr(OrbitCamera, "viewmat", lambda _: pose)
    with torch.device("meta"):
        seen = sample_texture(texture, build_lookup(vertices, FACES, UVS, (64, 64), [CAMERA], fragments))
    assert seen.device.type == "cpu"


@pytest.mark.gpu
def test_a_gpu_reads_what_the_processor_reads():
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    pictures = []
    for device in ("cpu", "cuda"):
        vertices, faces, uvs, texture = (value.to(device) for value in (slanted(), FACES, UVS, noise(256, 256, 3)))
        texture.requires_grad_()
        fragments = rasterize_mesh(vertices, faces, [CAMERA])
        seen = sample_texture(texture, build_lookup(vertices, faces, uvs, (256, 256), [CAMERA], fragments))
        seen.square().sum().backward()
        pictures.append((seen.detach().cpu(), texture.grad.cpu()))
    for here, there in zip(*pictures, strict=True):
        torch.testing.assert_close(here, there, atol=1e-4, rtol=0)
