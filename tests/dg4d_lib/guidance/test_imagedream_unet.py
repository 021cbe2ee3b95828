import math

import pytest
import tiny_imagedream
import torch

from dg4d_lib.guidance.imagedream_unet import MultiViewUnet, MultiViewUnetConfig

STABLE_DIFFUSION_2 = 865_910_724  # parameters of its U-Net
PUBLISHED = {  # unet/config.json of ashawkey/imagedream-ipmv-diffusers
    "attention_resolutions": [4, 2, 1],
    "camera_dim": 16,
    "channel_mult": [1, 2, 4, 4],
    "context_dim": 1024,
    "image_size": 32,
    "in_channels": 4,
    "ip_dim": 16,
    "model_channels": 320,
    "num_head_channels": 64,
    "num_res_blocks": 2,
    "out_channels": 4,
    "transformer_depth": 1,
    "use_checkpoint": False,
}


def published() -> dict[str, tuple[int, ...]]:
    with torch.device("meta"):
        network = MultiViewUnet(MultiViewUnetConfig.of(PUBLISHED))
    return {name: tuple(value.shape) for name, value in network.state_dict().items()}


def test_without_cameras_and_picture_it_has_the_parameters_of_stable_diffusion() -> None:
    shapes = published()
    added = [name for name in shapes if name.startswith(("camera_embed", "image_embed")) or "_ip." in name]
    assert sum(math.prod(shape) for name, shape in shapes.items() if name not in added) == STABLE_DIFFUSION_2
    assert sum(math.prod(shape) for shape in shapes.values()) == 941_672_900


def test_the_published_size_has_the_published_names() -> None:
    shapes = published()
    block = "transformer_blocks.0"
    expected = {
        "time_embed.0.weight": (1280, 320),
        "time_embed.2.bias": (1280,),
        "camera_embed.0.weight": (1280, 16),
        "camera_embed.2.weight": (1280, 1280),
        "image_embed.latents": (1, 16, 1024),
        "image_embed.proj_in.weight": (1024, 1280),
        "image_embed.layers.3.0.to_kv.weight": (1536, 1024),
        "image_embed.layers.3.1.1.weight": (4096, 1024),
        "image_embed.layers.0.1.3.weight": (1024, 4096),
        "image_embed.norm_out.bias": (1024,),
        "input_blocks.0.0.weight": (320, 4, 3, 3),
        "input_blocks.1.0.in_layers.2.weight": (320, 320, 3, 3),
        "input_blocks.1.0.emb_layers.1.weight": (320, 1280),
        "input_blocks.1.0.out_layers.3.weight": (320, 320, 3, 3),
        f"input_blocks.1.1.{block}.attn1.to_k.weight": (320, 320),
        f"input_blocks.1.1.{block}.attn2.to_k_ip.weight": (320, 1024),
        f"input_blocks.1.1.{block}.attn2.to_out.0.bias": (320,),
        f"input_blocks.1.1.{block}.ff.net.0.proj.weight": (2560, 320),
        f"input_blocks.1.1.{block}.ff.net.2.weight": (320, 1280),
        "input_blocks.3.0.op.weight": (320, 320, 3, 3),
        "input_blocks.4.0.skip_connection.weight": (640, 320, 1, 1),
        "input_blocks.11.0.in_layers.0.weight": (1280,),
        "middle_block.1.proj_in.weight": (1280, 1280),
        "middle_block.2.out_layers.0.weight": (1280,),
        "output_blocks.2.1.conv.weight": (1280, 1280, 3, 3),
        "output_blocks.3.1.proj_out.bias": (1280,),
        "output_blocks.5.2.conv.weight": (1280, 1280, 3, 3),
        f"output_blocks.8.1.{block}.norm3.weight": (640,),
        f"output_blocks.11.1.{block}.attn2.to_v_ip.weight": (320, 1024),
        "output_blocks.11.0.skip_connection.weight": (320, 640, 1, 1),
        "out.0.weight": (320,),
        "out.2.weight": (4, 320, 3, 3),
    }
    assert {name: shapes.get(name) for name in expected} == expected
    assert len(shapes) == 686 + 4 + (7 + 4 * 11) + 2 * 16
    assert not any(name.startswith(("input_blocks.10.1", "input_blocks.12", "output_blocks.12")) for name in shapes)


def inputs(dtype: torch.dtype) -> tuple[torch.Tensor, int, torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)

    def noise(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator).to(dtype)

    return noise(2, 5, 4, 8, 8), 250, noise(2, 5, 16), noise(2, 7, 32), noise(2, 17, 48)


def tiny() -> MultiViewUnet:
    with torch.random.fork_rng():
        torch.manual_seed(1)
        return tiny_imagedream.tiny_unet().eval()


def test_alone_and_without_camera_and_picture_a_view_is_stable_diffusions() -> None:
    """The twin is the U-Net of diffusers; its own converter renames the tensors."""
    from diffusers import UNet2DConditionModel
    from diffusers.loaders.single_file_utils import convert_ldm_unet_checkpoint

    ours = tiny().double()
    for name, value in ours.named_parameters():
        if "to_v_ip" in name or name.startswith("camera_embed.2"):
            value.data.zero_()
    twin = UNet2DConditionModel(
        block_out_channels=(32, 64),
        down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"),
        up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
        layers_per_block=1,
        cross_attention_dim=32,
        attention_head_dim=(1, 2),  # heads, in spite of the name
        use_linear_projection=True,
    ).double()
    shared = {name: value for name, value in ours.state_dict().items() if "_ip." not in name}
    shared = {name: value for name, value in shared.items() if not name.startswith(("camera_embed", "image_embed"))}
    prefixed = {f"model.diffusion_model.{name}": value for name, value in shared.items()}
    twin.load_state_dict(convert_ldm_unet_checkpoint(prefixed, twin.config))
    latents, timestep, cameras, text, image = inputs(torch.float64)
    found = ours(latents[:, :1], timestep, cameras[:, :1], text, image)[:, 0]
    expected = twin(latents[:, 0], timestep, text).sample
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=1e-6)  # time is embedded in single precision


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float64])
def test_it_computes_in_its_own_precision(dtype: torch.dtype) -> None:
    expected = tiny()(*inputs(torch.float32))
    found = tiny().to(dtype)(*inputs(dtype))
    assert found.dtype == dtype
    torch.testing.assert_close(found.float(), expected, atol=0.05, rtol=0.05)


def test_time_text_and_picture_matter() -> None:
    latents, timestep, cameras, text, image = inputs(torch.float32)
    noise = tiny()(latents, timestep, cameras, text, image)
    assert noise.shape == latents.shape
    for other in (
        (latents, 251, cameras, text, image),
        (latents, timestep, cameras, text + 1, image),
        (latents, timestep, cameras, text, image.flip(-1)),
    ):
        assert (tiny()(*other) - noise).abs().max() > 1e-5
