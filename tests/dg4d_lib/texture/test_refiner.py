import math
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from tiny_svd import tiny_svd
from tiny_weights import write_zero123
from torch import Tensor
from torch.nn.functional import interpolate

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.diffusion.clip_images import svd_clip_pixels
from dg4d_lib.diffusion.latents import encode_images
from dg4d_lib.diffusion.noise_schedule import ddim_timesteps
from dg4d_lib.diffusion.video_model import VideoModel, karras_sigmas
from dg4d_lib.guidance.distillation import TimestepSchedule
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.guidance.zero123 import Zero123
from dg4d_lib.refiner_settings import ImageToImageSettings, VideoToVideoSettings
from dg4d_lib.settings import VideoModelSettings, Zero123PriorSettings
from dg4d_lib.texture.refiner import ImageToImage, Refiner, VideoToVideo, noise_levels

CPU = torch.device("cpu")
FRAMES, SIDE = 3, 32
CAMERAS = [OrbitCamera(azimuth_deg=10.0 * frame, width=SIDE, height=SIDE) for frame in range(FRAMES)]


def rng(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def video(seed: int = 1) -> Tensor:
    return torch.rand(FRAMES, SIDE, SIDE, 3, generator=rng(seed), dtype=torch.float64)


def by_the_formulas(
    parts: object, pictures: Tensor, picture: Tensor, sigmas: Tensor, generator: torch.Generator
) -> Tensor:
    """The refinement in the preconditioning of Karras et al. (2022), float64, written out frame by frame."""
    unet, vae, eye = parts.unet, parts.vae, parts.image_encoder
    seen = 2 * picture.permute(2, 0, 1)[None] - 1
    clip = interpolate(seen, (224, 224), mode="bicubic", align_corners=True)  # enlarged: the blur is none
    mean = torch.tensor([0.48145466, 0.4578275, 0.40821073], dtype=torch.float64)[:, None, None]
    deviation = torch.tensor([0.26862954, 0.26130258, 0.27577711], dtype=torch.float64)[:, None, None]
    embedding = eye(((clip + 1) / 2 - mean) / deviation).image_embeds[None]
    augmented = seen + 0.02 * torch.randn(seen.shape, generator=generator, dtype=torch.float64)
    known = vae.encode(augmented).latent_dist.mean.repeat(FRAMES, 1, 1, 1)[None]
    x = torch.stack([vae.encode(2 * p.permute(2, 0, 1)[None] - 1).latent_dist.mean[0] for p in pictures])[None]
    x = x * vae.config.scaling_factor
    x = x + sigmas[0] * torch.randn(x.shape, generator=generator, dtype=torch.float64)
    ids = torch.tensor([[6, 127, 0.02]], dtype=torch.float64)
    for sigma, following in pairwise(sigmas):
        c_skip, c_out = 1 / (sigma**2 + 1), -sigma / (sigma**2 + 1) ** 0.5
        c_in, c_noise = 1 / (sigma**2 + 1) ** 0.5, sigma.log() / 4
        believed = []
        for context, image in ((0 * embedding, 0 * known), (embedding, known)):
            v = unet(torch.cat([c_in * x, image], 2), c_noise, context, ids).sample
            believed.append(c_skip * x + c_out * v)
        x0 = torch.stack(
            [
                believed[0][0, k] + (1 + 2 * k / (FRAMES - 1)) * (believed[1][0, k] - believed[0][0, k])
                for k in range(FRAMES)
            ]
        )[None]
        x = x0 + (x - x0) * following / sigma
    decoded = vae.decode(x[0] / vae.config.scaling_factor, num_frames=FRAMES).sample
    return ((decoded + 1) / 2).clamp(0, 1).permute(0, 2, 3, 1)


@torch.no_grad()
def test_one_pass_is_what_the_formulas_say_with_the_same_noise() -> None:
    parts = tiny_svd()
    for part in (parts.unet, parts.vae, parts.image_encoder):
        part.double()
    settings = VideoToVideoSettings(model=VideoModelSettings(decode_chunk_size=FRAMES))
    model = VideoModel(parts.unet, parts.vae, parts.image_encoder, settings.model, CPU)
    refiner, picture = VideoToVideo(settings, model, video(2)[0]), video(2)[0]
    refined = refiner.refine(video(), CAMERAS, 0.5, rng(7))
    ramp = torch.linspace(0, 1, 25, dtype=torch.float64)
    levels = (700 ** (1 / 7) + ramp * (0.002 ** (1 / 7) - 700 ** (1 / 7))) ** 7
    sigmas = torch.cat([levels[17:], torch.zeros(1, dtype=torch.float64)])
    expected = by_the_formulas(parts, video(), picture, sigmas, rng(7))
    assert expected.std() > 0.05
    torch.testing.assert_close(refined, expected, rtol=1e-9, atol=1e-9)


@torch.no_grad()
def test_the_picture_is_conditioned_on_at_the_size_of_the_video() -> None:
    """512 pixels with the paper's settings; the public code's 256 give CLIP nearly the same picture."""
    parts = tiny_svd()
    settings = VideoToVideoSettings(model=VideoModelSettings(decode_chunk_size=FRAMES))
    model = VideoModel(parts.unet, parts.vae, parts.image_encoder, settings.model, CPU)
    sizes, encode = [], model.encode_condition
    model.encode_condition = lambda image, generators: sizes.append(image.shape) or encode(image, generators)
    picture = torch.rand(2 * SIDE, 2 * SIDE, 3, generator=rng(2))
    VideoToVideo(settings, model, picture).refine(video().float(), CAMERAS, 0.5, rng(7))
    assert sizes == [(SIDE, SIDE, 3)] and VideoToVideoSettings().texture.size == 512
    ramp = torch.linspace(0, 1, 512)
    smooth = torch.stack([ramp[:, None] * ramp, (6 * ramp).sin()[:, None] * ramp, ramp.expand(512, 512)])[None]
    half = interpolate(smooth, (256, 256), mode="bilinear", align_corners=False)
    inner = (slice(None), slice(None), slice(8, -8), slice(8, -8))  # without the borders of the blur
    assert (svd_clip_pixels(smooth) - svd_clip_pixels(half))[inner].abs().max() < 0.03


def test_it_starts_at_the_level_of_the_paper_and_takes_eight_steps() -> None:
    parts = tiny_svd()
    settings = VideoToVideoSettings()
    model = VideoModel(parts.unet, parts.vae, parts.image_encoder, settings.model, CPU)
    refiner = VideoToVideo(settings, model, video()[0])
    assert isinstance(refiner, Refiner)
    sigmas = noise_levels(settings, 0.0)
    assert sigmas == noise_levels(settings, 1.0)
    assert len(sigmas) == 9 and sigmas[0] == pytest.approx(1.2732, abs=1e-4)


@torch.no_grad()
def test_noise_can_be_annealed_as_in_the_ablation_of_the_paper() -> None:
    """T from 0.7 to 0.95 of the schedule is skipped, so that 8 to 2 of 25 steps are left."""
    parts = tiny_svd()
    settings = VideoToVideoSettings(strength_end=0.05, model=VideoModelSettings(decode_chunk_size=FRAMES))
    model = VideoModel(parts.unet, parts.vae, parts.image_encoder, settings.model, CPU)
    refiner, denoise, used = VideoToVideo(settings, model, video().float()[0]), model.denoise, []
    model.denoise = lambda noisy, condition, sigmas: used.append(sigmas) or denoise(noisy, condition, sigmas)
    for progress in (0.0, 0.5, 1.0):
        refiner.refine(video().float(), CAMERAS, progress, rng(7))
    levels = karras_sigmas(25)
    assert used == [levels[start:] for start in (17, 20, 23)]


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")
@pytest.mark.parametrize("steps", [50, 20])
def test_timesteps_are_those_of_the_ddim_scheduler(steps: int) -> None:
    from diffusers import DDIMScheduler

    scheduler = DDIMScheduler(num_train_timesteps=1000, steps_offset=1)
    scheduler.set_timesteps(steps)
    assert list(ddim_timesteps(steps)) == scheduler.timesteps.tolist()


@pytest.fixture(scope="module")
def zero123(tmp_path_factory: pytest.TempPathFactory) -> Zero123:
    folder: Path = write_zero123(tmp_path_factory.mktemp("zero123"))
    return Zero123.load(folder, Zero123PriorSettings(precision="fp32"), CPU)


@torch.no_grad()
@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")
@pytest.mark.parametrize(("progress", "steps_left"), [(0.0, 10), (1.0, 1)])
def test_pictures_are_denoised_as_the_ddim_scheduler_does_it(
    zero123: Zero123, progress: float, steps_left: int
) -> None:
    from diffusers import DDIMScheduler

    frames = video(3).float()
    prior = zero123.conditioned_on(frames, TimestepSchedule(1.0))
    settings = ImageToImageSettings(num_inference_steps=20)
    refiner = ImageToImage(settings, prior)
    assert isinstance(refiner, Refiner)
    refined = refiner.refine(video().float(), CAMERAS, progress, rng(7))

    scheduler = DDIMScheduler(
        beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", clip_sample=False, set_alpha_to_one=False,
        steps_offset=1,
    )  # fmt: skip
    scheduler.set_timesteps(20)
    timesteps = scheduler.timesteps[math.floor(20 * (0.5 + 0.45 * progress)) :]
    assert len(timesteps) == steps_left
    scale = zero123.vae.config.scaling_factor
    noise = torch.randn((FRAMES, 4, 32, 32), generator=rng(7))
    latents = scheduler.add_noise(scale * encode_images(prior.vae, video().float()), noise, timesteps[:1])
    tokens = prior.tokens([GuidanceView(camera, frame) for frame, camera in enumerate(CAMERAS)])
    for timestep in timesteps:
        believed = prior.predict_noise(latents, int(timestep), prior.latents, tokens)
        latents = scheduler.step(believed, timestep, latents).prev_sample
    decoded = (zero123.vae.decode(latents / scale).sample / 2 + 0.5).clamp(0, 1)
    expected = interpolate(decoded, (SIDE, SIDE), mode="bilinear", antialias=True).movedim(1, -1)
    assert expected.std() > 0.01
    torch.testing.assert_close(refined, expected, rtol=0, atol=2e-5)
