import dataclasses
import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest
import tiny_imagedream
import tiny_weights
import torch
from safetensors.torch import load_file, save_file

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.cameras.viewpoints import random_orbit, turntable
from dg4d_lib.diffusion.batching import MicroBatches
from dg4d_lib.diffusion.noise_schedule import alphas_cumprod, ddim_timesteps
from dg4d_lib.errors import BadInput
from dg4d_lib.guidance.distillation import TimestepSchedule
from dg4d_lib.guidance.imagedream import ImageDream, ImageDreamCondition, ImageDreamPrior, camera_to_world_rows
from dg4d_lib.guidance.interface import GuidancePrior, GuidanceView, ring_size
from dg4d_lib.settings import ImageDreamPriorSettings

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_imagedream.write_imagedream(tmp_path_factory.mktemp("imagedream") / "model")


@pytest.fixture(scope="module")
def model(folder: Path) -> ImageDream:
    return ImageDream.load(folder, "fp32", CPU)


@pytest.fixture(scope="module")
def condition(model: ImageDream) -> ImageDreamCondition:
    return model.conditioned_on(pictures(2))


def seeded(seed: int = 3) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def pictures(count: int, size: int = 64) -> torch.Tensor:
    return torch.rand(count, size, size, 3, generator=seeded(5))


def noisy(sets: int, views: int = 4) -> torch.Tensor:
    return torch.randn(sets, views, 4, 32, 32, generator=seeded(6))


def ring(elevation: float = 0.0, azimuth: float = 0.0) -> list[OrbitCamera]:
    return turntable(4, OrbitCamera(elevation, azimuth))


def test_a_folder_gives_back_the_network(folder: Path, model: ImageDream) -> None:
    saved = load_file(folder / "unet" / "diffusion_pytorch_model.safetensors")
    for name, value in model.unet.state_dict().items():
        assert torch.equal(value, saved[name])
    parts = (model.unet, model.vae, model.image_encoder, model.text_encoder)
    assert not any(parameter.requires_grad for part in parts for parameter in part.parameters())


def test_damaged_folders_are_refused_by_name(folder: Path, tmp_path: Path) -> None:
    def broken(part: str) -> Path:
        return shutil.copytree(folder, tmp_path / part.replace("/", "-"))

    copy = broken("unet")
    state = load_file(copy / "unet" / "diffusion_pytorch_model.safetensors")
    state.pop("image_embed.latents")
    save_file(state, copy / "unet" / "diffusion_pytorch_model.safetensors")
    with pytest.raises(BadInput, match=r"MultiViewUnet: 1 of its .* image_embed\.latents"):
        ImageDream.load(copy, "fp32", CPU)
    copy = broken("config")
    (copy / "unet" / "config.json").unlink()
    with pytest.raises(BadInput, match="holds no ImageDream model"):
        ImageDream.load(copy, "fp32", CPU)
    copy = broken("schedule")
    (copy / "scheduler" / "scheduler_config.json").write_text(
        json.dumps({**tiny_weights.SD_SCHEDULER, "beta_end": 0.02})
    )
    with pytest.raises(BadInput, match="scheduler"):
        ImageDream.load(copy, "fp32", CPU)


def test_the_picture_is_of_the_front_in_the_cameras_words() -> None:
    """Front: ImageDream's azimuth 90, that is on +x with z up; written out by hand."""
    front = torch.tensor([[0, 0, 1, 1], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(camera_to_world_rows(OrbitCamera()).reshape(4, 4), front, atol=1e-12, rtol=0)
    side = camera_to_world_rows(OrbitCamera(azimuth_deg=90, radius=3)).reshape(4, 4)[:3, 3]
    torch.testing.assert_close(side, torch.tensor([0, 1, 0]).double(), atol=1e-12, rtol=0)
    above = camera_to_world_rows(OrbitCamera(elevation_deg=30)).reshape(4, 4)[:3, 3]
    torch.testing.assert_close(above, torch.tensor([0.75**0.5, 0, 0.5], dtype=torch.float64), atol=1e-12, rtol=0)


def test_timesteps_are_those_of_the_usual_sampler(folder: Path) -> None:
    from diffusers import DDIMScheduler

    sampler = DDIMScheduler.from_pretrained(folder / "scheduler")
    for steps in (30, 50, 20, 10):
        sampler.set_timesteps(steps)
        assert list(ddim_timesteps(steps)) == sampler.timesteps.tolist()


def test_views_are_what_the_usual_sampler_makes_of_the_same_noise(
    folder: Path, model: ImageDream, condition: ImageDreamCondition, monkeypatch: pytest.MonkeyPatch
) -> None:
    from diffusers import DDIMScheduler

    def predict_noise(
        self: object, latents: torch.Tensor, timestep: int, rings: list[list[OrbitCamera]], told: object, scale: float
    ) -> torch.Tensor:
        return (0.1 * scale * latents + rings[0][0].elevation_deg / 100 + timestep / 1000).sin()

    one = condition.rows([1])
    sampler = DDIMScheduler.from_pretrained(folder / "scheduler")
    sampler.set_timesteps(10)
    latents = torch.randn(1, 4, 4, 32, 32, generator=seeded())
    for timestep in sampler.timesteps:
        noise = predict_noise(model, latents, int(timestep), [ring(10)], one, 5.0)
        latents = sampler.step(noise, timestep, latents, eta=0.0).prev_sample
    expected = (model.vae.decode(latents[0] / 0.18215).sample / 2 + 0.5).clamp(0, 1).permute(0, 2, 3, 1)
    with monkeypatch.context() as patch:
        patch.setattr(ImageDream, "predict_noise", predict_noise)
        views = model.views(one, seeded(), num_inference_steps=10, guidance_scale=5.0, elevation_deg=10.0)
    assert views.shape == (4, 256, 256, 3)
    torch.testing.assert_close(views, expected, atol=2e-4, rtol=0)


def test_views_depend_on_the_seed_alone(model: ImageDream, condition: ImageDreamCondition) -> None:
    one = condition.rows([1])
    views = model.views(one, seeded(), 1)
    assert torch.equal(views, model.views(one, seeded(), 1))
    assert not torch.equal(views, model.views(one, seeded(4), 1))


def test_sets_do_not_see_each_other(model: ImageDream, condition: ImageDreamCondition) -> None:
    rings = [ring(), ring(20, 45)]
    both = model.predict_noise(noisy(2), 500, rings, condition, 5.0)
    for i in range(2):
        alone = model.predict_noise(noisy(2)[i : i + 1], 500, rings[i : i + 1], condition.rows([i]), 5.0)
        torch.testing.assert_close(both[i : i + 1], alone, atol=1e-5, rtol=1e-4)


def test_views_of_a_set_see_each_other_and_know_their_cameras(
    model: ImageDream, condition: ImageDreamCondition
) -> None:
    one, latents = condition.rows([0]), noisy(1)
    noise = model.predict_noise(latents, 500, [ring()], one, 1.0)
    changed = latents.clone()
    changed[0, 3] += 1
    assert (model.predict_noise(changed, 500, [ring()], one, 1.0) - noise)[0, :3].abs().amax((1, 2, 3)).min() > 1e-6
    assert (model.predict_noise(latents, 500, [ring(30)], one, 1.0) - noise).abs().max() > 1e-5


def test_the_order_of_views_does_not_matter(model: ImageDream, condition: ImageDreamCondition) -> None:
    one, order = condition.rows([0]), [2, 0, 3, 1]
    noise = model.predict_noise(noisy(1), 300, [ring()], one, 5.0)
    turned = model.predict_noise(noisy(1)[:, order], 300, [[ring()[i] for i in order]], one, 5.0)
    torch.testing.assert_close(turned, noise[:, order], atol=1e-5, rtol=1e-4)


def test_guidance_goes_from_what_is_believed_without_the_picture(
    model: ImageDream, condition: ImageDreamCondition
) -> None:
    one = condition.rows([0])
    without, told, strong = (model.predict_noise(noisy(1), 300, [ring()], one, scale) for scale in (0.0, 1.0, 5.0))
    torch.testing.assert_close(strong, without + 5 * (told - without), atol=1e-5, rtol=1e-4)
    silence = model.conditioned_on(pictures(1)).prompt_embeds
    blank = ImageDreamCondition(silence, silence, one.image_embeds * 0, one.image_latents * 0)
    torch.testing.assert_close(without, model.predict_noise(noisy(1), 300, [ring()], blank, 3.0), atol=1e-5, rtol=1e-4)


def test_text_is_heard(model: ImageDream) -> None:
    told, untold = model.conditioned_on(pictures(1), "a cat"), model.conditioned_on(pictures(1))
    assert not torch.equal(told.prompt_embeds, untold.prompt_embeds)
    assert torch.equal(told.negative_prompt_embeds, untold.prompt_embeds)
    noise = model.predict_noise(noisy(1), 300, [ring()], untold, 5.0)
    assert not torch.equal(model.predict_noise(noisy(1), 300, [ring()], told, 5.0), noise)


def test_many_frames_are_encoded_a_few_at_a_time(model: ImageDream, monkeypatch: pytest.MonkeyPatch) -> None:
    encode, sizes = model.vae.encode, []

    def tight(pixels: torch.Tensor) -> object:
        sizes.append(len(pixels))
        if len(pixels) > 2:
            raise torch.OutOfMemoryError("no room")
        return encode(pixels)

    monkeypatch.setattr(model.vae, "encode", tight)
    every, last = model.conditioned_on(pictures(5)), model.conditioned_on(pictures(5)[4:])
    assert sizes == [4, 2, 2, 1, 1] and len(every.image_latents) == len(every.prompt_embeds) == 5
    torch.testing.assert_close(every.image_latents[4:], last.image_latents)
    torch.testing.assert_close(every.image_embeds[4:], last.image_embeds)


def test_images_on_which_the_networks_overflow_are_named(model: ImageDream, monkeypatch: pytest.MonkeyPatch) -> None:
    encode = model.encode

    def overflow(images: torch.Tensor) -> torch.Tensor:
        latents = encode(images)
        latents[0] = torch.inf
        return latents

    monkeypatch.setattr(model, "encode", overflow)
    with pytest.raises(BadInput, match=r"of 1 of 2 frames is not finite \(frame 0\).* to bf16 or fp32"):
        model.conditioned_on(pictures(2))


def views_of(rings: Sequence[Sequence[OrbitCamera]], frames: Sequence[int]) -> list[GuidanceView]:
    return [
        GuidanceView(dataclasses.replace(camera, width=48, height=48), frame)
        for cameras, frame in zip(rings, frames, strict=True)
        for camera in cameras
    ]


VIEWS = views_of([ring(0, 20), ring(15, -100)], [1, 0])


def prior(model: ImageDream, condition: ImageDreamCondition, rings_at_once: int = 9) -> ImageDreamPrior:
    made = ImageDreamPrior(model, condition, TimestepSchedule(0.98), ImageDreamPriorSettings())
    made.__dict__["batches"] = MicroBatches("rings", rings_at_once)
    return made


def judged(judge: ImageDreamPrior, images: torch.Tensor, progress: float = 0.5) -> tuple[torch.Tensor, torch.Tensor]:
    images = images.clone().requires_grad_()
    loss = judge.loss(images, images[..., :1], VIEWS, progress, seeded())
    loss.backward()
    assert images.grad is not None
    return loss.detach(), images.grad


def test_it_is_a_prior_that_wants_rings(model: ImageDream, condition: ImageDreamCondition) -> None:
    judge = prior(model, condition)
    assert isinstance(judge, GuidancePrior)
    assert ring_size(judge) == 4
    for views in (
        VIEWS[:6],
        VIEWS[1:5],
        [GuidanceView(c) for c in random_orbit(4, 48, elevation_deg=(0, 9), radius=(2, 2), generator=seeded())],
    ):
        with pytest.raises(BadInput, match="multiples of 4"):
            judge.loss(pictures(len(views), 48), pictures(len(views), 48)[..., :1], views, 0.5, seeded())


def test_loss_and_gradient_are_those_of_the_formulas_in_double_precision(folder: Path) -> None:
    exact = ImageDream.load(folder, "fp32", CPU)
    for part in (exact.unet, exact.vae, exact.image_encoder, exact.text_encoder):
        part.double()
    condition, images = exact.conditioned_on(pictures(2).double()), pictures(8, 48).double()
    loss, gradient = judged(prior(exact, condition), images)

    alphabar = alphas_cumprod()[500]
    e = torch.randn(2, 16, 32, 32, generator=seeded(), dtype=torch.float64).reshape(2, 4, 4, 32, 32)
    expected = torch.zeros(8, 48, 48, 3).double()
    total = 0.0
    for i, frame in enumerate((1, 0)):
        pixels = images[4 * i : 4 * i + 4].clone().requires_grad_()
        planes = torch.nn.functional.interpolate(
            pixels.permute(0, 3, 1, 2), (256, 256), mode="bilinear", antialias=True
        )
        z = 0.18215 * exact.vae.encode(2 * planes - 1).latent_dist.mean
        told = condition.rows([frame])
        with torch.no_grad():
            x = alphabar.sqrt() * z + (1 - alphabar).sqrt() * e[i]
            five = torch.cat([torch.stack([x, x]), torch.cat([0 * told.image_latents, told.image_latents])[:, None]], 1)
            poses = torch.stack(
                [*(camera_to_world_rows(view.camera) for view in VIEWS[4 * i : 4 * i + 4]), torch.zeros(16)]
            )
            text = torch.cat([exact.conditioned_on(pictures(1).double()).prompt_embeds, told.prompt_embeds])
            features = torch.cat([0 * told.image_embeds, told.image_embeds])
            free, conditional = exact.unet(five, 500, torch.stack([poses, poses]), text, features)[:, :4]
            slope = (1 - alphabar) * (free + 5 * (conditional - free) - e[i])
        total += 0.5 * float(slope.square().sum()) / 8
        expected[4 * i : 4 * i + 4] = torch.autograd.grad((z * slope).sum() / 8, pixels)[0]
    assert float(loss) == pytest.approx(total, rel=1e-5)
    torch.testing.assert_close(gradient, expected, rtol=1e-5, atol=1e-5 * float(expected.abs().max()))


def test_rings_one_by_one_or_together_are_judged_the_same(model: ImageDream, condition: ImageDreamCondition) -> None:
    loss, gradient = judged(prior(model, condition), pictures(8, 48))
    one, other = judged(prior(model, condition, rings_at_once=1), pictures(8, 48))
    torch.testing.assert_close(one, loss, rtol=1e-4, atol=0)
    torch.testing.assert_close(other, gradient, rtol=1e-3, atol=1e-3 * float(gradient.abs().max()))
