import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image
from tiny_svd import SCHEDULE, save_tiny_svd, tiny_svd

from dg4d_lib.diffusion import video_model
from dg4d_lib.diffusion.single_token_attention import SingleTokenProcessor
from dg4d_lib.diffusion.video_model import VideoModel, karras_sigmas, pred_original_sample, start_index
from dg4d_lib.errors import BadInput, is_out_of_memory
from dg4d_lib.settings import VideoModelSettings

CPU = torch.device("cpu")
STEPS, FRAMES, SIDE = 3, 3, 32
SCHEDULERS_OWN = pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")
SETTINGS = VideoModelSettings(num_inference_steps=STEPS, decode_chunk_size=2)


def rng(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_tiny_svd(tmp_path_factory.mktemp("svd"))


@pytest.fixture(scope="module")
def model(folder: Path) -> VideoModel:
    return VideoModel.load(folder, SETTINGS, CPU)


@pytest.fixture(scope="module")
def pixels() -> torch.Tensor:
    return (256 * torch.rand(SIDE, SIDE, 3, generator=rng(1))).byte()


def generated(model: VideoModel, picture: torch.Tensor, *seeds: int) -> torch.Tensor:
    generators = [rng(seed) for seed in seeds]
    condition = model.encode_condition(picture, generators)
    start = math.sqrt(700**2 + 1) * model.sample_noise(model.latent_shape(len(seeds), FRAMES, SIDE, SIDE), generators)
    videos = model.denoise(start, condition, karras_sigmas(model.settings.num_inference_steps))
    return torch.stack([model.decode(latents) for latents in videos])


@SCHEDULERS_OWN
def test_the_noise_levels_are_those_of_the_real_scheduler() -> None:
    from diffusers import EulerDiscreteScheduler

    scheduler = EulerDiscreteScheduler(**SCHEDULE)
    scheduler.set_timesteps(25)
    torch.testing.assert_close(torch.tensor(karras_sigmas(25)), scheduler.sigmas, rtol=1e-5, atol=0)
    times = torch.tensor([0.25 * math.log(sigma) for sigma in karras_sigmas(25)[:-1]])
    torch.testing.assert_close(times, scheduler.timesteps, rtol=1e-5, atol=1e-6)


def test_a_single_noise_level_is_the_largest() -> None:
    assert karras_sigmas(1) == pytest.approx((700, 0))


@pytest.mark.parametrize(
    ("strength", "index", "sigma"), [(0.4, 15, 3.870), (0.3, 17, 1.2732), (0.25, 18, 0.678), (0.2, 20, 0.157)]
)
def test_the_strength_gives_the_known_start(strength: float, index: int, sigma: float) -> None:
    assert start_index(25, strength) == index
    assert karras_sigmas(25)[index] == pytest.approx(sigma, abs=5.1e-4)


def test_eight_steps_are_left_of_25_at_the_paper_s_strength() -> None:
    sigmas = karras_sigmas(25)
    assert sigmas[0] == pytest.approx(700) and sigmas[24] == pytest.approx(0.002) and sigmas[25] == 0
    assert len(sigmas[start_index(25, 0.3) :]) - 1 == 8


@pytest.mark.parametrize("sigma", [0.01, 1.0, 500.0])
def test_the_clean_video_comes_out_of_the_true_velocity(sigma: float) -> None:
    """v of (x0, e) at the angle arctan(sigma) is cos e - sin x0 (Salimans and Ho 2022)."""
    x0, noise = torch.randn(2, 5, generator=rng(0), dtype=torch.float64)
    angle = math.atan(sigma)
    velocity = math.cos(angle) * noise - math.sin(angle) * x0
    torch.testing.assert_close(pred_original_sample(x0 + sigma * noise, velocity, sigma), x0, rtol=1e-9, atol=1e-9)


@SCHEDULERS_OWN
def test_a_video_is_what_diffusers_makes_of_the_same_noise(model: VideoModel, pixels: torch.Tensor) -> None:
    pipeline = tiny_svd()
    pipeline.set_progress_bar_config(disable=True)
    theirs = pipeline(
        Image.fromarray(pixels.numpy()),
        height=SIDE,
        width=SIDE,
        num_frames=FRAMES,
        num_inference_steps=STEPS,
        fps=7,
        decode_chunk_size=SETTINGS.decode_chunk_size,
        generator=rng(5),
        output_type="pt",
    ).frames[0]
    ours = generated(model, pixels / 255, 5)[0]
    assert ours.std() > 0.05  # otherwise equality would say little
    torch.testing.assert_close(ours, theirs.movedim(1, -1), rtol=0, atol=2e-5)


def test_several_seeds_at_once_are_the_same_seeds_one_by_one(model: VideoModel, pixels: torch.Tensor) -> None:
    both = generated(model, pixels / 255, 5, 6)
    torch.testing.assert_close(both[1], generated(model, pixels / 255, 6)[0], rtol=0, atol=2e-5)
    assert (both[0] - both[1]).abs().max() > 0.1


def test_equal_seeds_give_equal_bits_and_low_memory_changes_none(
    folder: Path, model: VideoModel, pixels: torch.Tensor
) -> None:
    frugal = VideoModel.load(folder, SETTINGS.model_copy(update={"low_memory": True}), CPU)
    assert torch.equal(generated(model, pixels / 255, 5), generated(frugal, pixels / 255, 5))


def test_where_memory_runs_out_less_is_done_at_once_and_said(
    folder: Path, model: VideoModel, pixels: torch.Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    tight = VideoModel.load(folder, SETTINGS, CPU)
    whole = tight.unet.forward

    def forward(sample: torch.Tensor, *others: object, **named: object) -> object:
        if len(sample) > 1:
            raise torch.OutOfMemoryError("no room")
        return whole(sample, *others, **named)

    monkeypatch.setattr(tight.unet, "forward", forward)
    video = generated(tight, pixels / 255, 5)
    torch.testing.assert_close(video, generated(model, pixels / 255, 5), rtol=0, atol=2e-5)
    assert any("memory ran out with 2 videos" in note for note in tight.notes())
    assert not model.notes()
    assert is_out_of_memory(torch.OutOfMemoryError("no room"))


def test_a_budget_says_how_much_goes_through_at_once(
    folder: Path, pixels: torch.Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In float32, of what is left: two frames to the encoder, one to the decoder, three videos to the network."""
    model = VideoModel.load(folder, VideoModelSettings(num_inference_steps=STEPS, memory_gb=6, videos_at_once=9), CPU)
    weights = [part.parameters() for part in (model.unet, model.vae, model.image_encoder)]
    taken = sum(4 * value.numel() for part in weights for value in part) / 2**30
    picture = 4 * SIDE**2 / 1e6
    monkeypatch.setattr(video_model, "OVERHEAD_GB", 6 - taken - 1)
    monkeypatch.setattr(video_model, "ENCODER_GB", 0.4 / picture)
    monkeypatch.setattr(video_model, "DECODER_GB", 0.7 / picture)
    monkeypatch.setattr(video_model, "UNET_GB", 0.3 / picture / FRAMES)
    frugal = VideoModel(model.unet, model.vae, model.image_encoder, model.settings, CPU)
    counts: dict[str, list[int]] = {"encode": [], "decode": [], "unet": []}

    def counting(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda given, *rest, **named: (counts[name].append(len(given)), function(given, *rest, **named))[1]

    for name in ("encode", "decode"):
        monkeypatch.setattr(model.vae, name, counting(name, getattr(model.vae, name)))
    monkeypatch.setattr(model.unet, "forward", counting("unet", model.unet.forward))
    frugal.encode(pixels.expand(5, -1, -1, -1) / 255)
    assert counts["encode"] == [2, 2, 1]
    generated(frugal, pixels / 255, 1, 2)
    assert counts["decode"] == [1] * 2 * FRAMES and counts["unet"] == [3, 1] * STEPS


def test_in_half_precision_the_encoder_alone_is_wider_and_its_weights_are_never_copied(
    pixels: torch.Tensor, folder: Path
) -> None:
    pipeline = tiny_svd().to(torch.float16)
    half = VideoModel(pipeline.unet, pipeline.vae, pipeline.image_encoder, SETTINGS, CPU)
    lie = [parameter.data_ptr() for parameter in half.vae.parameters()]
    latents = half.encode(pixels[None] / 255)
    assert half.decode(latents).shape == (1, SIDE, SIDE, 3)
    assert [parameter.data_ptr() for parameter in half.vae.parameters()] == lie
    assert {parameter.dtype for parameter in half.vae.decoder.parameters()} == {torch.float16}
    assert {parameter.dtype for parameter in half.vae.encoder.parameters()} == {torch.float32} == {latents.dtype}
    exact = VideoModel.load(folder, SETTINGS, CPU).encode(pixels[None] / 255)
    torch.testing.assert_close(latents, exact, rtol=0, atol=5e-3)


def test_the_one_token_is_not_attended_to_at_length(model: VideoModel) -> None:
    processors = model.unet.attn_processors
    shortened = {name for name, processor in processors.items() if isinstance(processor, SingleTokenProcessor)}
    assert shortened == {name for name in processors if ".attn2." in name}
    assert any("temporal_transformer_blocks" in name for name in shortened)


def test_images_that_are_not_finite_are_refused(model: VideoModel) -> None:
    latents = torch.full(model.latent_shape(1, 2, SIDE, SIDE)[1:], torch.nan)
    with pytest.raises(BadInput, match=r"overflowed.*driving\.model\.precision=bf16.*refiner\.model\.precision"):
        model.decode(latents)


def test_a_missing_part_is_named(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "unet").symlink_to(folder / "unet")
    with pytest.raises(BadInput, match="vae"):
        VideoModel.load(tmp_path, SETTINGS, CPU)
