import dataclasses
import json
import math
import operator
import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest
import tiny_weights
import torch
from safetensors.torch import load_file, save_file
from torch.nn import functional

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.diffusion.batching import MicroBatches
from dg4d_lib.diffusion.clip_images import clip_pixels
from dg4d_lib.diffusion.single_token_attention import SingleTokenProcessor
from dg4d_lib.errors import BadInput
from dg4d_lib.guidance.distillation import TimestepSchedule
from dg4d_lib.guidance.interface import GuidancePrior, GuidanceView
from dg4d_lib.guidance.zero123 import ConditionedZero123, Zero123, relative_pose
from dg4d_lib.settings import Zero123PriorSettings

CPU = torch.device("cpu")
SETTINGS = Zero123PriorSettings()
PAPER = TimestepSchedule(0.98)
VIEWS = tuple(
    GuidanceView(OrbitCamera(elevation, azimuth, radius, width=96, height=96), frame)
    for elevation, azimuth, radius, frame in ((20, 50, 2.3, 1), (-10, -130, 1.8, 0), (0, 180, 2.0, 1))
)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_weights.write_zero123(tmp_path_factory.mktemp("zero123") / "model")


@pytest.fixture(scope="module")
def networks(model: Path) -> Zero123:
    return Zero123.load(model, SETTINGS, CPU)


@pytest.fixture(scope="module")
def exact(model: Path) -> Zero123:
    """Return the networks in double precision."""
    z = Zero123.load(model, SETTINGS, CPU)
    parts = {name: getattr(z, name).double() for name in ("vae", "unet", "image_encoder", "camera_projection")}
    return dataclasses.replace(z, **parts)


def pictures(count: int, size: int, dtype: torch.dtype = torch.float32, seed: int = 5) -> torch.Tensor:
    return torch.rand(count, size, size, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(
        dtype
    )


def seeded(seed: int = 11) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def judged(
    prior: ConditionedZero123, images: torch.Tensor, views: Sequence[GuidanceView] = VIEWS, progress: float = 0.5
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return loss and gradient."""
    images = images.clone().requires_grad_()
    loss = prior.loss(images, torch.ones_like(images[..., :1]), views, progress, seeded())
    loss.backward()
    return loss.detach(), images.grad


def by_the_formulas(
    z: Zero123, frames: torch.Tensor, images: torch.Tensor, timestep: int, polar: float | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return loss and gradient of SDS written out per image, with the networks of the product.

    `polar` is the angle of the input camera from the pole, which Stable-Zero123 is told.
    """
    beta = torch.linspace(math.sqrt(0.00085), math.sqrt(0.012), 1000, dtype=torch.float64) ** 2
    alphabar = torch.cumprod(1 - beta, 0)[timestep]
    noise = torch.randn((len(images), 4, 32, 32), generator=seeded(), dtype=images.dtype)
    total, gradients = torch.zeros((), dtype=torch.float64), []
    for image, view, e in zip(images, VIEWS, noise, strict=True):
        frame = frames[view.frame].permute(2, 0, 1)[None]
        seen = functional.interpolate(frame, (224, 224), mode="bicubic", antialias=True, align_corners=False).clamp(
            0, 1
        )
        mean = torch.tensor([0.48145466, 0.4578275, 0.40821073], dtype=torch.float64).reshape(1, 3, 1, 1)
        deviation = torch.tensor([0.26862954, 0.26130258, 0.27577711], dtype=torch.float64).reshape(1, 3, 1, 1)
        c = z.image_encoder(pixel_values=(seen - mean) / deviation).image_embeds
        small = functional.interpolate(frame, (256, 256), mode="bilinear", antialias=True, align_corners=False)
        v = z.vae.encode(small * 2 - 1).latent_dist.mean
        azimuth = math.radians(view.camera.azimuth_deg)
        fourth = view.camera.radius - 2.0 if polar is None else polar
        moved = math.radians(90 - view.camera.elevation_deg) - (math.pi / 2 if polar is None else polar)
        camera = [moved, math.sin(azimuth), math.cos(azimuth), fourth]
        w, b = z.camera_projection.weight, z.camera_projection.bias
        token = (w @ torch.cat([c[0], torch.tensor(camera, dtype=torch.float64)]) + b)[None, None]

        pixels = image.clone().requires_grad_()
        render = functional.interpolate(
            pixels.permute(2, 0, 1)[None], (256, 256), mode="bilinear", antialias=True, align_corners=False
        )
        latent = 0.18215 * z.vae.encode(render * 2 - 1).latent_dist.mean
        with torch.no_grad():
            noisy = alphabar.sqrt() * latent + (1 - alphabar).sqrt() * e
            free = z.unet(torch.cat([noisy, 0 * v], 1), timestep, 0 * token).sample
            conditional = z.unet(torch.cat([noisy, v], 1), timestep, token).sample
            slope = (1 - alphabar) * (free + 5 * (conditional - free) - e)
        total += 0.5 * slope.square().sum() / len(images)
        gradients.append(torch.autograd.grad((latent * slope).sum() / len(images), pixels)[0])
    return total, torch.stack(gradients)


@pytest.mark.parametrize(("progress", "timestep"), [(0.0, 980), (0.5, 500), (1.0, 20)])
def test_loss_and_gradient_are_those_of_the_formulas(exact: Zero123, progress: float, timestep: int) -> None:
    frames, images = pictures(2, 120, torch.float64), pictures(3, 96, torch.float64, seed=6)
    loss, gradient = judged(exact.conditioned_on(frames, PAPER), images, progress=progress)
    expected, slope = by_the_formulas(exact, frames, images, timestep)
    torch.testing.assert_close(loss, expected, rtol=1e-9, atol=0)
    torch.testing.assert_close(gradient, slope, rtol=1e-7, atol=1e-12)


def test_single_precision_loses_few_digits(networks: Zero123, exact: Zero123) -> None:
    frames, images = pictures(2, 120), pictures(3, 96, seed=6)
    prior = networks.conditioned_on(frames, PAPER)
    noise = torch.randn((3, 4, 32, 32), generator=seeded())
    loss, gradient = judged(prior, images)
    wide = exact.conditioned_on(frames.double(), PAPER)
    with pytest.MonkeyPatch.context() as patch:  # the same noise: draws of doubles differ from draws of floats
        patch.setattr(torch, "randn", lambda *shape, **options: noise.double())
        expected, slope = judged(wide, images.double())
    assert float((loss - expected).abs() / expected) < 1e-5
    assert float((gradient - slope).norm() / slope.norm()) < 5e-5  # rounding in some forty layers: measured 1.3e-5


def test_stable_zero123_is_told_the_angle_of_the_input_from_the_pole(exact: Zero123) -> None:
    frames, images = pictures(2, 120, torch.float64), pictures(3, 96, torch.float64, seed=6)
    stable = dataclasses.replace(exact, settings=Zero123PriorSettings(variant="stable"))
    prior = stable.conditioned_on(frames, PAPER, OrbitCamera(elevation_deg=25))
    loss, _ = judged(prior, images)
    expected, _ = by_the_formulas(exact, frames, images, 500, polar=math.radians(65))
    torch.testing.assert_close(loss, expected, rtol=1e-9, atol=0)


def trained_numbers(condition: torch.Tensor, target: torch.Tensor) -> list[float]:
    """Return the pose as in the training code of Zero-1-to-3, from two camera positions with z up.

    Theta is the angle from the pole (arctan2 of the distance from the axis and z), azimuth arctan2 of y and x.
    """
    (theta, azimuth, radius), (theta0, azimuth0, radius0) = (
        (math.atan2(math.hypot(x, y), z), math.atan2(y, x), math.sqrt(x * x + y * y + z * z))
        for x, y, z in (target.tolist(), condition.tolist())
    )
    turn = azimuth - azimuth0
    return [theta - theta0, math.sin(turn), math.cos(turn), radius - radius0]


@pytest.mark.parametrize("seed", range(4))
def test_cameras_are_told_as_the_model_was_trained(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    draws = torch.rand(2, 3, generator=generator, dtype=torch.float64).tolist()
    known, new = (OrbitCamera(160 * e - 80, 360 * a - 180, 1.5 + r) for e, a, r in draws)
    z_up = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)  # our z, x, y: right-handed as well
    assert z_up.det() == 1
    expected = trained_numbers(z_up @ known.position(), z_up @ new.position())
    assert relative_pose(new, known).tolist() == pytest.approx(expected, abs=1e-12)


def test_a_camera_that_moves_above_the_object_comes_nearer_to_the_pole() -> None:
    above = OrbitCamera(elevation_deg=30)
    assert above.position()[1] > 0
    polar, sine, cosine, last = relative_pose(above, OrbitCamera()).tolist()
    assert polar == pytest.approx(-math.pi / 6)
    assert (sine, cosine, last) == (0, 1, 0)


def test_a_camera_that_moves_to_the_right_grows_in_azimuth() -> None:
    right = OrbitCamera(azimuth_deg=90)
    assert right.position()[0] > 0
    assert relative_pose(right, OrbitCamera()).tolist() == pytest.approx([0, 1, 0, 0])


def test_the_input_view_is_no_move_wherever_it_was_taken() -> None:
    camera = OrbitCamera(17, 40, 1.5)
    assert relative_pose(camera, camera).tolist() == [0, 0, 1, 0]
    assert relative_pose(camera, camera, "stable")[3] == pytest.approx(math.radians(73))


def test_the_token_is_the_projection_of_embedding_and_camera(networks: Zero123) -> None:
    prior = networks.conditioned_on(pictures(2, 64), PAPER, OrbitCamera(10, 20))
    tokens = prior.tokens(VIEWS)
    assert tokens.shape == (3, 1, tiny_weights.TOKEN)
    for token, view in zip(tokens, VIEWS, strict=True):
        camera = relative_pose(view.camera, OrbitCamera(10, 20)).float()
        expected = networks.camera_projection(torch.cat([prior.embeddings[view.frame], camera]))
        torch.testing.assert_close(token[0], expected, atol=1e-6, rtol=1e-5)


def test_it_is_a_guidance_prior_for_every_view_and_frame(networks: Zero123) -> None:
    prior = networks.conditioned_on(pictures(2, 64), PAPER)
    assert isinstance(prior, GuidancePrior)
    assert prior.viewpoints is None and prior.frames is None


def test_a_batch_of_views_is_the_mean_of_its_views(exact: Zero123) -> None:
    prior, images = exact.conditioned_on(pictures(2, 64, torch.float64), PAPER), pictures(3, 96, torch.float64)
    loss, gradient = judged(prior, images)
    noise = torch.randn((3, 4, 32, 32), generator=seeded(), dtype=torch.float64)
    alone = []
    for row in range(3):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(torch, "randn", lambda *shape, row=row, **options: noise[row : row + 1])
            alone.append(judged(prior, images[row : row + 1], VIEWS[row : row + 1]))
    torch.testing.assert_close(loss, torch.stack([each for each, _ in alone]).mean(), rtol=1e-9, atol=0)
    torch.testing.assert_close(gradient, torch.cat([each for _, each in alone]) / 3, rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("size", [1, 2])
def test_micro_batches_are_one_batch(exact: Zero123, size: int) -> None:
    whole, images = exact.conditioned_on(pictures(2, 64, torch.float64), PAPER), pictures(3, 96, torch.float64)
    pieces = dataclasses.replace(whole, batches=MicroBatches("views", size))
    for expected, found in zip(judged(whole, images), judged(pieces, images), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-7, atol=1e-12)


def test_out_of_memory_halves_the_batch_and_changes_nothing_else(exact: Zero123) -> None:
    prior, images = exact.conditioned_on(pictures(2, 64, torch.float64), PAPER), pictures(3, 96, torch.float64)
    expected = judged(prior, images)
    attempts = []

    def forward(sample: torch.Tensor, *others: object) -> object:
        attempts.append(len(sample) // 2)
        if len(sample) > 2:
            raise torch.OutOfMemoryError("simulated")
        return exact.unet(sample, *others)

    narrow = dataclasses.replace(prior, unet=forward, batches=MicroBatches("views for the prior", 24))
    found = judged(narrow, images)
    assert attempts == [3, 1, 1, 1]
    assert narrow.batches.size == 1 and "3 views for the prior" in narrow.batches.notes()[0]
    for a, b in zip(expected, found, strict=True):
        torch.testing.assert_close(b, a, rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize(("memory_gb", "views"), [(12, 14), (24, 38), (80, 150)])
def test_the_budget_says_how_many_views_go_through(networks: Zero123, memory_gb: float, views: int) -> None:
    settings = Zero123PriorSettings(memory_gb=memory_gb)
    prior = dataclasses.replace(networks, settings=settings).conditioned_on(pictures(1, 64), PAPER)
    assert prior.batches.size == views


def test_the_gradient_reaches_pixels_only_and_through_further_operations(networks: Zero123) -> None:
    prior = networks.conditioned_on(pictures(2, 64), PAPER)
    images = pictures(3, 96)
    _, gradient = judged(prior, images)
    brightness = torch.ones((), requires_grad=True)
    (2 * prior.loss(images * brightness, torch.ones_like(images[..., :1]), VIEWS, 0.5, seeded())).backward()
    torch.testing.assert_close(brightness.grad, 2 * (gradient * images).sum(), rtol=1e-4, atol=1e-5)
    for network in (prior.vae, prior.unet, prior.camera_projection):
        assert all(value.grad is None and not value.requires_grad for value in network.parameters())


def test_the_same_seed_gives_the_same_bytes(networks: Zero123) -> None:
    prior, images = networks.conditioned_on(pictures(2, 64), PAPER), pictures(3, 96)
    first, second = judged(prior, images), judged(prior, images)
    assert torch.equal(first[0], second[0]) and torch.equal(first[1], second[1])


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_near_and_keeps_pictures_in_single(
    networks: Zero123, model: Path, dtype: torch.dtype
) -> None:
    z = Zero123.load(model, SETTINGS, CPU)
    halves = {name: getattr(z, name).to(dtype) for name in ("vae", "unet", "image_encoder", "camera_projection")}
    frames, images = pictures(2, 64), pictures(3, 96)
    loss, gradient = judged(networks.conditioned_on(frames, PAPER), images)
    near, slope = judged(dataclasses.replace(z, **halves).conditioned_on(frames, PAPER), images)
    assert near.dtype == slope.dtype == torch.float32
    assert near == pytest.approx(float(loss), rel=0.03)
    assert functional.cosine_similarity(slope.flatten(), gradient.flatten(), 0) > 0.97


def test_another_frame_is_another_condition(networks: Zero123) -> None:
    prior, images = networks.conditioned_on(pictures(2, 64), PAPER), pictures(1, 96)
    camera = OrbitCamera(10, 40)
    assert judged(prior, images, [GuidanceView(camera, 0)])[0] != judged(prior, images, [GuidanceView(camera, 1)])[0]


@pytest.mark.parametrize("part", ["vae.encoder", "image_encoder"])
def test_frames_on_which_the_networks_overflow_are_named(
    part: str, networks: Zero123, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = operator.attrgetter(part)(networks)
    forward = network.forward

    def overflow(pixels: torch.Tensor) -> object:
        found = forward(pixels)
        (found if isinstance(found, torch.Tensor) else found.image_embeds)[1] = torch.nan
        return found

    monkeypatch.setattr(network, "forward", overflow)
    with pytest.raises(BadInput, match=r"of 1 of 3 frames is not finite \(frame 1\).* to bf16 or fp32"):
        networks.conditioned_on(pictures(3, 64), PAPER)


@pytest.mark.parametrize("frame", [-1, 2])
def test_a_frame_that_is_not_there_is_refused(networks: Zero123, frame: int) -> None:
    prior = networks.conditioned_on(pictures(2, 64), PAPER)
    with pytest.raises(BadInput, match="it has frames 0 to 1"):
        judged(prior, pictures(1, 96), [GuidanceView(OrbitCamera(), frame)])


def test_clip_sees_the_colors_it_was_trained_on() -> None:
    gray = torch.tensor([0.48145466, 0.4578275, 0.40821073]).expand(1, 300, 300, 3)
    assert clip_pixels(gray).abs().max() < 1e-5
    assert clip_pixels(torch.ones(1, 50, 50, 3)).shape == (1, 3, 224, 224)


def test_conditioning_leaves_the_image_encoder_behind(networks: Zero123) -> None:
    prior = networks.conditioned_on(pictures(1, 64), PAPER)
    assert networks.image_encoder not in vars(prior).values()


def test_networks_of_something_else_are_refused(model: Path, tmp_path: Path) -> None:
    other = Path(shutil.copytree(model, tmp_path / "model"))
    shutil.rmtree(other / "unet")
    tiny_weights.tiny_unet(in_channels=4).save_pretrained(other / "unet")
    with pytest.raises(BadInput, match="inputs of the UNet: 4, expected 8"):
        Zero123.load(other, SETTINGS, CPU)


def test_the_one_token_is_not_attended_to_at_length(networks: Zero123) -> None:
    processors = networks.unet.attn_processors
    shortened = {name for name, processor in processors.items() if isinstance(processor, SingleTokenProcessor)}
    assert shortened == {name for name in processors if ".attn2." in name} != set()


def test_a_projection_of_another_width_is_refused(model: Path, tmp_path: Path) -> None:
    other = Path(shutil.copytree(model, tmp_path / "model"))
    file = other / "clip_camera_projection" / "diffusion_pytorch_model.safetensors"
    tensors = load_file(file)
    save_file({**tensors, "proj.weight": tensors["proj.weight"][:, :-1].contiguous()}, file)
    with pytest.raises(BadInput, match="inputs of the projection: 27, expected 28"):
        Zero123.load(other, SETTINGS, CPU)


def test_nothing_is_taken_from_the_index_of_the_folder(model: Path, tmp_path: Path) -> None:
    other = Path(shutil.copytree(model, tmp_path / "model"))
    (other / "model_index.json").write_text(json.dumps({"_class_name": ["os", "system"]}))
    assert isinstance(Zero123.load(other, SETTINGS, CPU), Zero123)


@pytest.mark.filterwarnings("ignore:`torch.jit.script_method`:DeprecationWarning")  # of torch's own compiler
def test_compiling_is_asked_of_the_networks_and_of_nothing_else(model: Path) -> None:
    compiled = Zero123.load(model, Zero123PriorSettings(compiled=True), CPU)
    assert all(part._compiled_call_impl is not None for part in (compiled.unet, compiled.vae.encoder))
    assert Zero123.load(model, SETTINGS, CPU).unet._compiled_call_impl is None
