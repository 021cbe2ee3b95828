"""Static stage: optimization of canonical Gaussians, DreamGaussianHD (paper section 3.1)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dg4d_lib.adam import Adam
from dg4d_lib.cameras.orbit import RADIUS, OrbitCamera
from dg4d_lib.cameras.viewpoints import random_orbit
from dg4d_lib.devices import to_device_async
from dg4d_lib.fitting.losses import WHITE, Diverged, check_finite, reference_loss, resize_cutouts
from dg4d_lib.fitting.schedules import late_decay, log_linear, reference_size_at, resolution_at
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.density_control import DensifyResult, Grad2dStats, densify, prune, reset_opacity
from dg4d_lib.guidance.interface import GuidancePrior, GuidanceView, ring_size
from dg4d_lib.rasterizer.interface import Rasterizer
from dg4d_lib.settings import FitSettings, StaticSettings
from dg4d_lib.visual_hull.known import KnownView

Report = Callable[[int, dict[str, float]], None]
ADVICE = "lower the learning rates (static.*_lr) or the weights"
RADIUS_JITTER = 0.5  # world units; random views are at radius 2 +- 0.5 (paper)
SPLIT_SCALE = 0.05  # world units; larger Gaussians are split, smaller ones cloned (DreamGaussian)
RESET_OPACITY_EVERY = 700  # iterations (DreamGaussian); not reached with the default of 500
LAST_PRUNE = 2.0  # factor on the largest scale in the prune after the last iteration (DreamGaussian: extent 1 for 0.5)
MIN_GAUSSIANS = 8  # with fewer the fit counts as diverged (ours)
FARTHEST = 100.0  # world units from the origin; with a mean beyond, the fit counts as diverged (ours; subjects have 1)


@dataclass
class _Cloud:
    """Gaussians under optimization, one Adam parameter group per field."""

    parameters: dict[str, nn.Parameter]
    adam: Adam

    @staticmethod
    def of(gaussians: Gaussians, rates: dict[str, float]) -> "_Cloud":
        parameters = {name: nn.Parameter(value.detach().clone()) for name, value in vars(gaussians).items()}
        groups = [{"params": [parameters[name]], "lr": rate, "name": name} for name, rate in rates.items()]
        return _Cloud(parameters, Adam(groups, eps=1e-15))

    @property
    def gaussians(self) -> Gaussians:
        return Gaussians(**self.parameters)

    def reset_opacity(self) -> None:
        """Clamp the opacities and clear their Adam moments, as 3DGS: old ones would carry on in the old direction."""
        parameter = self.parameters["opacity_logits"]
        parameter.data.copy_(reset_opacity(self.gaussians).opacity_logits)
        state = self.adam.state.get(parameter, {})
        for key in ("exp_avg", "exp_avg_sq"):
            if key in state:
                state[key].zero_()

    def replace(self, grown: DensifyResult) -> None:
        """Replace the cloud after density control; kept Gaussians keep their Adam state, new ones start at zero."""
        for group in self.adam.param_groups:
            name = group["name"]
            state = self.adam.state.pop(self.parameters[name], None)
            parameter = nn.Parameter(getattr(grown.gaussians, name).detach().clone())
            if state is not None:
                for key in ("exp_avg", "exp_avg_sq"):
                    momentum = state[key][grown.source]
                    momentum[grown.is_new] = 0
                    state[key] = momentum
                self.adam.state[parameter] = state
            group["params"] = [parameter]
            self.parameters[name] = parameter


def fit_gaussians(
    start: Gaussians,
    subject: Float[Tensor, "h w 4"],
    prior: GuidancePrior,
    rasterize: Rasterizer,
    settings: StaticSettings,
    generator: torch.Generator,
    report: Report = lambda iteration, values: None,
    known: Sequence[KnownView] = (),
    watch: Callable[[Gaussians], None] = lambda gaussians: None,
) -> Gaussians:
    """Fit a cloud to one image, with a guidance prior for unseen views.

    Args:
        start: the cloud at iteration 0, of which the most opaque `settings.max_points` are fitted; the fit runs on its
            device.
        subject: the cut-out, straight alpha, seen at azimuth and elevation 0.
        prior: scores random views.
        rasterize: rasterizer.
        settings: of the stage.
        generator: source of all randomness.
        report: called after every iteration with (iterations done, named losses).
        known: further images and their cameras; an iteration compares one of them, drawn by their weights, with the
            weight of the image.
        watch: called after every iteration with the cloud as it is then.

    Raises:
        FitDiverged: the loss became non-finite, (almost) no Gaussian is left, or one is more than 100 world units away.
    """
    device = start.means.device
    white = torch.tensor(WHITE, device=device)

    @cache
    def references(size: int) -> list[tuple[OrbitCamera, Tensor, Tensor]]:
        """Return camera, color and alpha of the image and of the known views."""
        views = [(OrbitCamera(), subject), *((view.camera, view.cutout) for view in known)]
        return [
            (replace(camera, width=size, height=size), *resize_cutouts(cutout[None].to(device), size))
            for camera, cutout in views
        ]

    rates = learning_rates(settings)
    start = most_opaque(start, settings.max_points, generator)
    cloud = _Cloud.of(start, rates)
    grad2d = Grad2dStats.zeros(len(start), device)
    for step in range(1, settings.iterations + 1):
        progress = step / settings.iterations
        for group in cloud.adam.param_groups:
            group["lr"] = rates[group["name"]] * late_decay(settings.lr_end, progress)
        cloud.adam.param_groups[0]["lr"] = log_linear(settings.means_lr, settings.means_lr_end, progress)
        gaussians = cloud.gaussians

        side = reference_size_at(settings, progress)
        first, *others = references(side)
        cameras, colors, alphas = zip(first, *([others[draw_view(known, generator)]] if known else []), strict=True)
        offsets = [torch.zeros(len(cameras), len(gaussians), 2, device=device, requires_grad=True)]
        rendering = rasterize(gaussians, cameras, white, offsets[0])
        rendered = [(rendering.visible, side)]
        reference = len(cameras) * reference_loss(
            rendering,
            torch.cat(colors),
            torch.cat(alphas),
            settings.color_weight,
            settings.alpha_weight,
            settings.ssim_weight,
        )
        loss = progress * reference
        guidance = torch.zeros((), device=device)
        if settings.views and settings.guidance_weight:
            size = resolution_at(settings.resolution_schedule, progress)
            views = [GuidanceView(c) for c in sample_cameras(prior, settings, size, generator)]
            offsets.append(torch.zeros(len(views), len(gaussians), 2, device=device, requires_grad=True))
            color_behind = to_device_async(background(settings, generator), device)
            rendering = rasterize(gaussians, [view.camera for view in views], color_behind, offsets[1])
            rendered.append((rendering.visible, size))
            guidance = prior.loss(rendering.color, rendering.alpha, views, progress, generator)
            loss = loss + settings.guidance_weight * guidance
        cloud.adam.zero_grad()
        loss.backward()
        losses = {"loss": loss, "reference": reference, "guidance": guidance}
        gradients = [parameter.grad for parameter in cloud.parameters.values()]
        iteration = f"iteration {step} of {settings.iterations}"
        numbers = check_finite("fit_gaussians", losses, gradients, iteration, ADVICE, gaussians)
        for offset, (visible, size) in zip(offsets, rendered, strict=True):
            if offset.grad is not None:
                grad2d.add(offset.grad, visible, size)
        cloud.adam.step()
        if adapt_density(cloud, grad2d, step, settings, generator):
            grad2d = Grad2dStats.zeros(len(cloud.gaussians), device)
            require_enough(cloud, step, settings, gaussians)
        if step % RESET_OPACITY_EVERY == 0 and step < settings.iterations:
            cloud.reset_opacity()
        report(step, {**numbers, "Gaussians": len(cloud.gaussians)})
        watch(cloud.gaussians)
    require_near(cloud.gaussians)
    return cloud.gaussians.detach()


def most_opaque(gaussians: Gaussians, count: int, generator: torch.Generator) -> Gaussians:
    """Return at most `count` Gaussians, the most opaque; among equal ones a random choice, as they may lie in order."""
    if len(gaussians) <= count:
        return gaussians
    shuffled = torch.randperm(len(gaussians), generator=generator).to(gaussians.means.device)
    order = gaussians.opacity_logits.detach()[shuffled].argsort(descending=True, stable=True)
    return gaussians.subset(shuffled[order[:count]].sort().values)


def draw_view(known: Sequence[KnownView], generator: torch.Generator) -> int:
    """Draw one of the views: uniformly, or in proportion to their weights where these differ."""
    weights = torch.tensor([view.weight for view in known])
    if bool((weights == weights[0]).all()):
        return int(torch.randint(len(known), (), generator=generator))
    return int(torch.multinomial(weights, 1, generator=generator))


def adapt_density(
    cloud: _Cloud, grad2d: Grad2dStats, step: int, settings: StaticSettings, generator: torch.Generator
) -> bool:
    """Densify and prune if it is time to, and only prune after the last iteration; return whether the cloud changed."""
    if step == settings.iterations >= settings.densify_every:  # new Gaussians would not be optimized any more
        cloud.replace(prune(cloud.gaussians, settings.prune_opacity, LAST_PRUNE * settings.prune_scale))
        return True
    if step < settings.iterations and step % settings.densify_every == 0:
        control_density(cloud, grad2d, settings, generator)
        return True
    return False


def background(settings: StaticSettings, generator: torch.Generator) -> Float[Tensor, " 3"]:
    """Return the background color of an iteration's random views; draw from the generator only if it is random."""
    black = settings.background == "random" and float(torch.rand((), generator=generator)) < 0.5
    return torch.zeros(3) if black else torch.tensor(WHITE)


def learning_rates(settings: FitSettings) -> dict[str, float]:
    """Return the initial learning rate of every field of the cloud; the means come first."""
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
    """Draw the random cameras of one iteration, from the prior's viewpoints if it has only some."""
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


def control_density(cloud: _Cloud, grad2d: Grad2dStats, settings: StaticSettings, generator: torch.Generator) -> None:
    """Densify Gaussians with a large screen-space gradient, then prune transparent and too large ones."""
    with torch.no_grad():
        room = settings.max_points - len(cloud.gaussians)
        grown = densify(cloud.gaussians, grad2d.mean, settings.densify_gradient, SPLIT_SCALE, room, generator)
        cloud.replace(grown)
        cloud.replace(prune(cloud.gaussians, settings.prune_opacity, settings.prune_scale))


def require_near(gaussians: Gaussians) -> None:
    """Refuse a cloud with means far away, from which later stages would diverge.

    Raises:
        Diverged: names the settings to lower.
    """
    farthest = float(gaussians.means.detach().abs().max())
    if not farthest <= FARTHEST:
        raise Diverged(
            f"fit_gaussians: a Gaussian has a coordinate of {farthest:.3g} world units, at most {FARTHEST:g} are "
            f"allowed; {ADVICE}",
            gaussians.detach(),
        )


def require_enough(cloud: _Cloud, step: int, settings: StaticSettings, before: Gaussians) -> None:
    """Refuse a cloud of which pruning left (almost) nothing.

    Args:
        cloud: after pruning.
        step: iterations done.
        settings: of the stage.
        before: the cloud before this iteration.

    Raises:
        Diverged: names the settings that keep more.
    """
    if len(cloud.gaussians) < MIN_GAUSSIANS:
        raise Diverged(
            f"fit_gaussians: {len(cloud.gaussians)} Gaussians are left at iteration {step} of "
            f"{settings.iterations}, at least {MIN_GAUSSIANS} are needed; lower static.prune_opacity or "
            "raise static.prune_scale",
            before.detach(),
        )
