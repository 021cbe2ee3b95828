import math
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch.nn import functional

from dg4d_lib.cameras.orbit import RADIUS, OrbitCamera
from dg4d_lib.cameras.viewpoints import turntable
from dg4d_lib.diffusion.components import Placement
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.ply import read_ply, write_ply
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.reconstruction import lgm
from dg4d_lib.reconstruction.lgm import (
    LGM_RADIUS,
    Lgm,
    decode_gaussians,
    drop_faint,
    infer_unet_config,
    load_lgm,
    ray_embedding,
    reconstruct,
)
from dg4d_lib.reconstruction.lgm_unet import UnetConfig

TINY = UnetConfig((32, 32, 64), (False, True, True), (64, 32), (True, False))
CPU = Placement(torch.device("cpu"), torch.float32)


def tiny(seed: int = 0) -> Lgm:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return Lgm(TINY).eval()


def pictures(size: int = 32) -> torch.Tensor:
    return torch.rand(4, size, size, 3, generator=torch.Generator().manual_seed(1))


def raw(count: int = 500, spread: float = 3.0) -> torch.Tensor:
    return spread * torch.randn(count, 14, generator=torch.Generator().manual_seed(2))


def test_the_published_size_has_the_published_number_of_parameters_and_names():
    with torch.device("meta"):
        shapes = {name: tuple(value.shape) for name, value in Lgm(UnetConfig()).state_dict().items()}
    assert sum(torch.Size(shape).numel() for shape in shapes.values()) == 415_042_848  # "415M"
    expected = {
        "unet.conv_in.weight": (64, 9, 3, 3),
        "unet.down_blocks.0.nets.0.norm1.weight": (64,),
        "unet.down_blocks.1.nets.0.shortcut.weight": (128, 64, 1, 1),
        "unet.down_blocks.3.attns.0.norm.weight": (512,),
        "unet.down_blocks.3.attns.1.attn.qkv.weight": (1536, 512),
        "unet.down_blocks.3.attns.1.attn.proj.bias": (512,),
        "unet.down_blocks.4.downsample.weight": (1024, 1024, 3, 3),
        "unet.mid_block.nets.1.conv2.bias": (1024,),
        "unet.mid_block.attns.0.attn.qkv.weight": (3072, 1024),
        "unet.up_blocks.2.nets.2.conv1.weight": (512, 768, 3, 3),
        "unet.up_blocks.2.attns.2.attn.proj.weight": (512, 512),
        "unet.up_blocks.4.nets.0.conv1.weight": (128, 384, 3, 3),
        "unet.up_blocks.4.nets.2.shortcut.weight": (128, 192, 1, 1),
        "unet.up_blocks.3.upsample.weight": (256, 256, 3, 3),
        "unet.norm_out.weight": (128,),
        "unet.conv_out.weight": (14, 128, 3, 3),
        "conv.weight": (14, 14, 1, 1),
    }
    assert {name: shapes.get(name) for name in expected} == expected
    absent = {"unet.down_blocks.2.attns.0.norm.weight", "unet.down_blocks.3.attns.1.attn.qkv.bias"}
    absent |= {"unet.down_blocks.5.downsample.weight", "unet.up_blocks.4.upsample.weight"}
    assert not absent & set(shapes)


def test_four_views_of_256_pixels_make_65536_gaussians():
    with torch.device("meta"):
        model = Lgm(UnetConfig())
        assert model(torch.empty(4, 256, 256, 3)).shape == (65_536, 14)
    assert tiny()(pictures(32)).shape == (4 * 16 * 16, 14)


def test_a_file_gives_back_the_network(tmp_path: Path):
    model, file = tiny(), tmp_path / lgm.WEIGHTS_FILE
    save_file({**model.state_dict(), "lpips_loss.unused": torch.zeros(1)}, file)
    for path in (file, tmp_path):
        torch.testing.assert_close(load_lgm(path, CPU)(pictures()), model(pictures()), rtol=0, atol=0)
    halved = load_lgm(file, Placement(torch.device("cpu"), torch.float16))
    assert all(p.dtype == torch.float16 and not p.requires_grad for p in halved.parameters())


def test_a_file_that_does_not_fit_is_refused_by_name(tmp_path: Path):
    file = tmp_path / "weights.safetensors"
    save_file(tiny().state_dict(), file)
    state = load_file(file)
    save_file({name: value for name, value in state.items() if "up_blocks" not in name}, file)
    with pytest.raises(BadInput, match=r"not weights of LGM: found levels down \(32, 32, 64\), up \(\)"):
        load_lgm(file, CPU)
    del state["unet.mid_block.attns.0.attn.proj.bias"]
    save_file(state, file)
    with pytest.raises(BadInput, match=r"1 of its \d+ tensors .* unet\.mid_block\.attns\.0\.attn\.proj\.bias"):
        load_lgm(file, CPU)
    file.write_bytes(file.read_bytes()[:1000])
    with pytest.raises(BadInput, match="cannot be read"):
        load_lgm(file, CPU)
    with pytest.raises(BadInput, match="cannot be read"):
        load_lgm(tmp_path / "nowhere.safetensors", CPU)


@pytest.mark.parametrize("shape", [UnetConfig(), TINY, UnetConfig(up_channels=(1024, 512), up_attention=(True, False))])
def test_weights_tell_the_size_of_their_network(shape: UnetConfig):
    with torch.device("meta"):
        assert infer_unet_config(Lgm(shape).state_dict()) == shape


def written_out(state: dict[str, torch.Tensor], x: torch.Tensor) -> torch.Tensor:
    """The U-Net of TINY by the names of its tensors, in a row, one operation a line."""

    def norm(name: str, x: torch.Tensor) -> torch.Tensor:
        return functional.group_norm(x, 32, state[f"{name}.weight"], state[f"{name}.bias"], 1e-5)

    def conv(name: str, x: torch.Tensor, stride: int = 1) -> torch.Tensor:
        weight = state[f"{name}.weight"]
        return functional.conv2d(x, weight, state[f"{name}.bias"], stride, weight.shape[-1] // 2)

    def residual(name: str, x: torch.Tensor) -> torch.Tensor:
        h = conv(f"{name}.conv1", functional.silu(norm(f"{name}.norm1", x)))
        h = conv(f"{name}.conv2", functional.silu(norm(f"{name}.norm2", h)))
        return (h + (conv(f"{name}.shortcut", x) if f"{name}.shortcut.weight" in state else x)) * math.sqrt(0.5)

    def attention(name: str, x: torch.Tensor) -> torch.Tensor:
        views, channels, height, width = x.shape
        tokens = norm(f"{name}.norm", x).permute(0, 2, 3, 1).reshape(-1, channels)
        q, k, v = (tokens @ state[f"{name}.attn.qkv.weight"].T).reshape(-1, 3, 16, channels // 16).permute(1, 2, 0, 3)
        seen = ((q @ k.mT / math.sqrt(channels // 16)).softmax(-1) @ v).permute(1, 0, 2).reshape(-1, channels)
        seen = seen @ state[f"{name}.attn.proj.weight"].T + state[f"{name}.attn.proj.bias"]
        return (seen.reshape(views, height, width, channels).permute(0, 3, 1, 2) + x) * math.sqrt(0.5)

    x = conv("conv_in", x)
    kept = [x]
    for i in range(3):
        for j in range(2):
            x = residual(f"down_blocks.{i}.nets.{j}", x)
            x = attention(f"down_blocks.{i}.attns.{j}", x) if i else x
            kept.append(x)
        if i < 2:
            x = conv(f"down_blocks.{i}.downsample", x, 2)
            kept.append(x)
    x = residual("mid_block.nets.0", x)
    x = attention("mid_block.attns.0", x)
    x = residual("mid_block.nets.1", x)
    for i in range(2):
        for j in range(3):
            x = residual(f"up_blocks.{i}.nets.{j}", torch.cat([x, kept.pop()], 1))
            x = attention(f"up_blocks.{i}.attns.{j}", x) if i == 0 else x
        if i == 0:
            x = conv("up_blocks.0.upsample", x.repeat_interleave(2, -1).repeat_interleave(2, -2))
    return conv("conv_out", functional.silu(norm("norm_out", x)))


def test_the_network_is_the_one_its_tensors_are_named_for():
    unet = tiny().unet.double()
    features = torch.randn(4, 9, 32, 32, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    expected = written_out(dict(unet.state_dict()), features)
    torch.testing.assert_close(unet(features), expected, atol=1e-10, rtol=1e-8)


def test_views_exchange_what_they_see():
    model = tiny()
    one, other = pictures(), pictures()
    other[3] = 1 - other[3]
    change = (model(one) - model(other)).reshape(4, -1).abs().amax(1)
    assert (change > 1e-6).all()


def test_the_ray_through_the_middle_goes_from_the_camera_to_the_origin():
    camera = OrbitCamera(0, 90, LGM_RADIUS, width=1, height=1)
    moment, direction = ray_embedding([camera])[0, :, 0, 0].split(3)
    torch.testing.assert_close(direction, torch.tensor([-1.0, 0, 0]).double(), atol=1e-12, rtol=0)
    torch.testing.assert_close(moment, torch.zeros(3).double(), atol=1e-12, rtol=0)


def test_rays_are_their_closed_form():
    size, tangent = 8, math.tan(math.radians(49.1 / 2))
    embedding = ray_embedding(turntable(4, OrbitCamera(radius=LGM_RADIUS, width=size, height=size)))
    assert embedding.shape == (4, 6, size, size)
    for row, column in ((0, 0), (3, 6), (7, 2)):
        x, y = (2 * column + 1 - size) / size * tangent, -(2 * row + 1 - size) / size * tangent
        front = torch.tensor([x, y, -1], dtype=torch.float64) / (1 + x * x + y * y) ** 0.5  # right is +x
        right = torch.tensor([-1, y, -x], dtype=torch.float64) / (1 + x * x + y * y) ** 0.5  # right is -z
        for view, origin, direction in ((0, (0, 0, 1.5), front), (1, (1.5, 0, 0), right)):
            moment = torch.linalg.cross(torch.tensor(origin).double(), direction)
            expected = torch.cat([moment, direction])
            torch.testing.assert_close(embedding[view, :, row, column], expected, atol=1e-7, rtol=0)


def test_activations_stay_in_their_ranges():
    gaussians = decode_gaussians(raw(spread=20.0))
    assert gaussians.means.abs().max() <= 4 / 3 + 1e-6
    assert gaussians.scales.min() > 0
    assert gaussians.opacities.min() >= 0
    assert gaussians.opacities.max() <= 1
    torch.testing.assert_close(gaussians.quats.norm(dim=-1), torch.ones(500))
    assert gaussians.colors.min() >= 0
    assert gaussians.colors.max() <= 1
    assert all(value.isfinite().all() for value in vars(gaussians).values())


def test_activations_are_their_closed_form():
    numbers = torch.tensor([[0.3, -0.6, 3.0, 0.4, 0.0, 1.0, -2.0, 0.0, 3.0, 0.0, 4.0, 0.0, 0.5, -30.0]])
    gaussians = decode_gaussians(numbers)
    torch.testing.assert_close(gaussians.means, torch.tensor([[0.4, -0.8, 4 / 3]]))
    softplus = torch.tensor([[2.0, 1 + torch.e, 1 + torch.e**-2]]).log()
    torch.testing.assert_close(gaussians.scales, 0.1 * softplus / 0.75)
    torch.testing.assert_close(gaussians.opacities, torch.tensor([0.4]).sigmoid())
    torch.testing.assert_close(gaussians.quats, torch.tensor([[0, 0.6, 0, 0.8]]))
    colors = torch.tensor([[0.5, 0.5 + 0.5 * torch.tanh(torch.tensor(0.5)), 0.0]])
    torch.testing.assert_close(gaussians.colors, colors, atol=1e-6, rtol=0)


def test_a_ply_holds_a_reconstruction(tmp_path: Path):
    gaussians = decode_gaussians(raw())
    write_ply(tmp_path / "object.ply", gaussians)
    again = read_ply(tmp_path / "object.ply")
    for name, value in vars(gaussians).items():
        torch.testing.assert_close(getattr(again, name), value, rtol=0, atol=0)


def test_the_picture_at_our_radius_is_lgms_own():
    ours = decode_gaussians(raw(200, 1.0))
    factor = LGM_RADIUS / RADIUS
    theirs = Gaussians(
        ours.means * factor, (ours.scales * factor).log(), ours.quats, ours.opacity_logits, ours.harmonics
    )
    rasterize, white = get_rasterizer("reference"), torch.ones(3)
    size = {"width": 48, "height": 48}
    near = rasterize(theirs, [OrbitCamera(10, 30, LGM_RADIUS, **size)], white)
    far = rasterize(ours, [OrbitCamera(10, 30, RADIUS, **size)], white)
    assert far.alpha.max() > 0.5
    torch.testing.assert_close(far.color, near.color, atol=1e-4, rtol=0)
    torch.testing.assert_close(far.alpha, near.alpha, atol=1e-4, rtol=0)


def test_the_faintest_are_left_out():
    numbers = raw(100)
    kept = drop_faint(decode_gaussians(numbers))
    assert 0 < len(kept) == int((numbers[:, 3].sigmoid() >= 0.005).sum()) < 100


def test_the_second_pass_sees_the_first_from_the_side_of_the_picture(monkeypatch: pytest.MonkeyPatch):
    model, seen = tiny(), []
    rasterize = get_rasterizer("cpu")
    monkeypatch.setattr(lgm, "best_azimuth", lambda gaussians, picture, rasterize: 37.0)
    model.register_forward_pre_hook(lambda module, given: seen.append(given[0]))
    result = reconstruct(model, pictures(), torch.ones(32, 32, 3), rasterize)
    first = drop_faint(decode_gaussians(model(pictures())))
    cameras = [OrbitCamera(0, 37.0 + turn, width=32, height=32) for turn in (0, 90, 180, 270)]
    torch.testing.assert_close(seen[1], rasterize(first, cameras, torch.ones(3)).color)
    torch.testing.assert_close(result.means, drop_faint(decode_gaussians(model(seen[1]))).means, rtol=0, atol=0)
