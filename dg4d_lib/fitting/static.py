"""The static stage: DreamGaussianHD (paper section 3.1)."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dg4d_lib.cameras.orbit import RADIUS, OrbitCamera
from dg4d_lib.cameras.viewpoints import random_orbit
from dg4d_lib.devices import to_device_async
from dg4d_lib.fitting.losses import WHITE, Diverged, check_finite, reference_loss, resize_cutouts
from dg4d_lib.fitting.schedules import log_linear, resolution_at
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.density_control import DensifyResult, Grad2dStats, densify, prune, reset_opacity
from dg4d_lib.guidance.interface import GuidancePrior, GuidanceView, ring_size
from dg4d_lib.rasterizer.interface import Rasterizer
from dg4d_lib.settings import FitSettings, StaticSettings

Report = Callable[[int, dict[str, float]], None]
ADVICE = "lower the learning rates (static.*_lr) or the weights"
RADIUS_JITTER = 0.5  # random views are at radius 2 +- this, world units (paper)
SPLIT_SCALE = 0.05  # world units: larger Gaussians split, smaller ones are cloned (DreamGaussian)
RESET_OPACITY_EVERY = 700  # iterations, never reached within 500 (DreamGaussian)
FEWEST = 8  # Gaussians; with fewer there is no object left


@dataclass
class _Cloud:
    """Gaussians under optimization: one Adam group per kind of parameter."""

    parameters: dict[str, nn.Parameter]
    adam: torch.optim.Adam

    @staticmethod
    def of(gaussians: Gaussians, rates: dict[str, float]) -> "_Cloud":
        parameters = {name: nn.Parameter(value.detach().clone()) for name, value in vars(gaussians).items()}
        groups = [{"params": [parameters[name]], "lr": rate, "name": name} for name, rate in rates.items()]
        return _Cloud(parameters, torch.optim.Adam(groups, betas=(0.9, 0.999), eps=1e-15, fused=True))

    @property
    def gaussians(self) -> Gaussians:
        return Gaussians(**self.parameters)

    def replace(self, grown: DensifyResult) -> None:
        """Take over a changed cloud; survivors keep their momentum, fresh Gaussians start without."""
        for group in self.adam.param_groups:
            name = group["name"]
            state = self.adam.state.pop(self.parameters[name], None)
            fresh = nn.Parameter(getattr(grown.gaussians, name).detach().clone())
            if state is not None:
                for key in ("exp_avg", "exp_avg_sq"):
                    momentum = state[key][grown.source]
                    momentum[grown.is_new] = 0
                    state[key] = momentum
                self.adam.state[fresh] = state
            group["params"] = [fresh]
            self.parameters[name] = fresh


def fit_gaussians(
    start: Gaussians,
    subject: Float[Tensor, "h w 4"],
    prior: GuidancePrior,
    rasterize: Rasterizer,
    settings: StaticSettings,
    generator: torch.Generator,
    report: Report = lambda iteration, values: None,
    input_camera: OrbitCamera | None = None,
) -> Gaussians:
    """Fit a cloud to one picture, with a prior for the sides nobody sees.

    Args:
        start: the cloud at iteration 0; the fit runs on its device.
        subject: the picture, straight alpha.
        prior: judges random views.
        rasterize: draws.
        settings: every number of the stage.
        generator: the source of all randomness.
        report: called after every iteration with (iterations done, named losses).
        input_camera: where the picture was taken from; the default is azimuth and elevation 0.

    Raises:
        FitDiverged: the loss became non-finite, or (almost) no Gaussian is left.
    """
    camera = replace(input_camera or OrbitCamera(), width=settings.reference_size, height=settings.reference_size)
    device = start.means.device
    color, alpha = resize_cutouts(subject[None].to(device), settings.reference_size)
    white = torch.tensor(WHITE, device=device)
    cloud = _Cloud.of(start, learning_rates(settings))
    gradients = Grad2dStats.zeros(len(start), device)
    for step in range(1, settings.iterations + 1):
        progress = step / settings.iterations
        cloud.adam.param_groups[0]["lr"] = log_linear(settings.means_lr, settings.means_lr_end, progress)
        gaussians = cloud.gaussians

        offsets = [torch.zeros(1, len(gaussians), 2, device=device, requires_grad=True)]
        rendering = rasterize(gaussians, [camera], white, offsets[0])
        seen = [(rendering.visible, settings.reference_size)]
        reference = reference_loss(
            rendering, color, alpha, settings.color_weight, settings.alpha_weight, settings.ssim_weight
        )
        loss = progress * reference
        guidance = torch.zeros((), device=device)
        if settings.views and settings.guidance_weight:
            size = resolution_at(settings.resolution_schedule, progress)
            views = [GuidanceView(c) for c in sample_cameras(prior, settings, size, generator)]
            offsets.append(torch.zeros(len(views), len(gaussians), 2, device=device, requires_grad=True))
            behind = to_device_async(background(settings, generator), device)
            rendering = rasterize(gaussians, [view.camera for view in views], behind, offsets[1])
            seen.append((rendering.visible, size))
            guidance = prior.loss(rendering.color, rendering.alpha, views, progress, generator)
            loss = loss + settings.guidance_weight * guidance
        cloud.adam.zero_grad(set_to_none=True)
        loss.backward()
        losses = {"loss": loss, "reference": reference, "guidance": guidance}
        slopes = [parameter.grad for parameter in cloud.parameters.values()]
        moment = f"iteration {step} of {settings.iterations}"
        numbers = check_finite("fit_gaussians", losses, slopes, moment, ADVICE, gaussians)
        for offset, (visible, size) in zip(offsets, seen, strict=True):
            if offset.grad is not None:
                gradients.add(offset.grad, visible, size)
        cloud.adam.step()
        if step % settings.densify_every == 0 and step < settings.iterations:
            control_density(cloud, gradients, settings, generator)
            gradients = Grad2dStats.zeros(len(cloud.gaussians), device)
            if len(cloud.gaussians) < FEWEST:
                raise Diverged(
                    f"fit_gaussians: {len(cloud.gaussians)} Gaussians are left at iteration {step} of "
                    f"{settings.iterations}; lower static.prune_opacity or raise static.prune_scale",
                    gaussians.detach(),
                )
        if step % RESET_OPACITY_EVERY == 0 and step < settings.iterations:
            cloud.parameters["opacity_logits"].data.copy_(reset_opacity(cloud.gaussians).opacity_logits)
        report(step, {**numbers, "Gaussians": len(cloud.gaussians)})
    return cloud.gaussians.detach()


def background(settings: StaticSettings, generator: torch.Generator) -> Float[Tensor, " 3"]:
    """What is behind the random views of one iteration; the generator is touched only where it is random."""
    black = settings.background == "random" and float(torch.rand((), generator=generator)) < 0.5
    return torch.zeros(3) if black else torch.tensor(WHITE)


def learning_rates(settings: FitSettings) -> dict[str, float]:
    """Return the learning rate of every field of the cloud at the start of a stage; the means come first."""
    return {
        "means": settings.means_lr,
        "harmonics": settings.color_lr,
        "opacity_logits": settings.opacity_lr,
        "log_scales": settings.scale_lr,
        "quats": settings.rotation_lr,
    }


def sample_cameras(
    prior: GuidancePrior, settings: StaticSettings, size: int, generator: torch.Generator
) -> list[OrbitCamera]:
    """The random views of one iteration: all around, or out of those the prior knows."""
    if prior.viewpoints is None:
        return random_orbit(
            settings.views,
            size,
            elevation_deg=(-settings.elevation_deg, settings.elevation_deg),
            radius=(RADIUS - RADIUS_JITTER, RADIUS + RADIUS_JITTER),
            generator=generator,
            ring=ring_size(prior),
        )
    choice = torch.randint(len(prior.viewpoints), (settings.views,), generator=generator).tolist()
    return [replace(prior.viewpoints[i], width=size, height=size) for i in choice]


def control_density(
    cloud: _Cloud, gradients: Grad2dStats, settings: StaticSettings, generator: torch.Generator
) -> None:
    """Grow where the views pull, then remove what is faint or too large."""
    with torch.no_grad():
        room = settings.max_points - len(cloud.gaussians)
        pull = gradients.mean
        grown = densify(cloud.gaussians, pull, settings.densify_gradient, SPLIT_SCALE, room, generator)
        cloud.replace(grown)
        cloud.replace(prune(cloud.gaussians, settings.prune_opacity, settings.prune_scale))
